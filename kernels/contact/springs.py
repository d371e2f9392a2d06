"""The force of a contact in an implicit step: a spring with a multiplier, the same for obstacles and soft surfaces.

A contact pushes with p = max(l - k (g - t), 0): its gap g at the end of the step, where that must come to, t, a
stiffness k, and a multiplier l. Friction is the same across the normal, bounded by Coulomb's law. Each time the step
has been solved for, forces become the multipliers, so that gaps close whatever k is (augmented Lagrangians, Alart and
Curnier 1991).
"""

import warp as wp

from .law import Law
from .vertices import across

wp.set_module_options({"enable_backward": False})

#: Number of solves after which the bounds of friction follow the push only by half of the change in each solve, then by
#: a quarter. Friction may pull a place off the obstacle; then it would have a push and no friction in turns.
HALVED, QUARTERED = wp.constant(6), wp.constant(16)
#: What slides has no stiffness in the direction in which it slides. The matrix has only this share of the change: with
#: all of it, places that start to slide in turns let a line search take only small parts of solves.
LOOSE = wp.constant(0.9)
#: The stiffness of friction over that of the push: what sticks and slips in turns takes fewer solves with less.
SIDEWAYS = wp.constant(0.25)


@wp.struct
class SpringState:
    """The force of a contact on its first side [N], the derivative of that [N/m], and its push along the normal [N]."""

    force: wp.vec3
    derivative: wp.mat33
    push: float


@wp.func
def least_gap(gap: float, law: Law, dt: float):
    """Where a gap must be at the end of the step; overlaps open slowly."""
    if gap > -law.tolerance:
        return 0.0
    return gap + wp.min(-law.settling * gap, law.recovery * dt)


@wp.func
def kept_gap(gap: float, pushed: bool, law: Law, dt: float):
    """The same where a contact that pushed in the last step may have left a gap or an overlap of up to the law's slack:
    that stays, so that what rests is at rest.
    """
    if pushed and wp.abs(gap) <= law.slack:
        return gap
    if pushed and gap < 0.0:
        # What the slack lets pass in each step of a tool's way would add up.
        opening = wp.max(-law.settling * gap, wp.min(-0.5 * gap, law.slack))
        return gap + wp.min(opening, law.recovery * dt)
    return least_gap(gap, law, dt)


@wp.func
def bound_of(most: float, push: float, friction: float, is_solved: bool, solves: int):
    """The bound of friction that belongs to a push, or the last one for the time of a solve, see ``HALVED`` [N]."""
    if solves > 0 and not is_solved:
        return most
    if solves < HALVED:
        # Exactly, so that a resumed run, which does not know the last bound, is the same.
        return friction * push
    return most + wp.where(solves < QUARTERED, 0.5, 0.25) * (friction * push - most)


@wp.func
def spring_state(short: float, slip: wp.vec3, k: float, multiplier: wp.vec3, n: wp.vec3, most: float):
    """The state of a contact.

    Args:
        short: How far the gap is from where it must come to, g - t [m].
        slip: The motion of the first side beyond the second in the step [m].
        k: The stiffness [N/m].
        multiplier: [N].
        n: The normal, to the first side.
        most: The most of friction [N].
    """
    made = SpringState()
    whole = wp.outer(n, n)
    made.push = wp.max(wp.dot(multiplier, n) - k * short, 0.0)
    if made.push > 0.0:
        made.force = made.push * n
        made.derivative = k * whole
    if most > 0.0:
        sideways = across(multiplier - SIDEWAYS * k * slip, n)
        size = wp.length(sideways)
        plane = wp.identity(3, dtype=wp.float32) - whole
        share = float(1.0)
        if size > most:
            share = most / size
            plane -= (LOOSE / (size * size)) * wp.outer(sideways, sideways)
        made.force += share * sideways
        made.derivative += (SIDEWAYS * k * share) * plane
    return made
