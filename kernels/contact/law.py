"""The contact law: how far two touching surfaces may approach each other in a step, and the bound on friction.

A contact force is the force with which the step ends with the surfaces side by side. It follows from the nodes' motion
without contact and from their lumped masses. So it has no stiffness and does not change the highest frequency, and no
surface passes another at any speed, provided that the step ends before it reaches the far side. Velocities are
corrected at once and positions slowly, because rounding errors of positions would otherwise act as forces.

After Carpenter, Taylor and Katona, Lagrange constraints for transient finite element surface contact (1991).

In an implicit step a contact, of an obstacle or of soft surfaces, is a spring with a multiplier. It pushes with
p = max(l - k (g - t), 0): its gap g at the end of the step, where that must come to, t, a stiffness k, and a multiplier
l. Friction is the same across the normal, bounded by Coulomb's law. Each time the step has been solved for, forces
become the multipliers, so that gaps close whatever k is (augmented Lagrangians, Alart and Curnier 1991).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Fraction of the remaining gap, or of the distance to an anchor, that closes in a step; see ``settled``.
SETTLING = wp.constant(0.1)
#: Places and triangles of a mesh that has just changed may begin inside obstacles, because the mesh hung through
#: between its former places. They may stay as deep, by an allowance of which this fraction is lost in each step.
LOST = wp.constant(1.0 / 256.0)


@wp.struct
class Law:
    tolerance: float  # gaps of the size of rounding errors [m]
    recovery: float  # speed at which overlapping surfaces are pushed apart [m/s]
    settling: float  # share of an overlap by which they are pushed apart in a step at most
    whole: float  # steps that are shorter than this close less of a gap, so that they throw nothing [s]
    slack: float  # gaps at own surfaces of up to this size may stay as they are in implicit steps [m]
    closing: (
        float  # gaps at own surfaces of more than this, besides their own motion, do not close in an explicit step [m]
    )
    grain: float  # forces on nodes are summed in multiples of this, so that the order does not matter [N]


@wp.func
def settled(law: Law, dt: float):
    """The share of a gap, or of the distance to an anchor, that closes in this step."""
    return law.settling * wp.where(dt < law.whole, dt / law.whole, 1.0)


@wp.func
def least_motion(gap: float, law: Law, dt: float):
    """How far a contact must open in this step [m]; if negative, how far it may close."""
    share = settled(law, dt)
    if gap > law.tolerance:
        return -(gap - (1.0 - share) * law.tolerance)
    return wp.min(-share * gap, law.recovery * dt)


@wp.func
def allowed(allowance: float, gap: float):
    """How deep something may be [m]: as deep as it is if that is not known yet, which a negative number says."""
    if allowance < 0.0:
        return wp.max(-gap, 0.0)
    return allowance


@wp.func
def left_to_held(demand: float, share: float):
    """The part of a demanded motion that belongs to held nodes, if nodes with this share of the weights give way.

    It is left undone. If the others made up for it, they would go by the demand over their share, and a tool that
    presses on the edge of a support would throw them away.
    """
    return wp.max(1.0 - share, 0.0) * wp.max(demand, 0.0)


@wp.func
def held_back(force: wp.vec3, normal_force: float, friction: float):
    """Coulomb's bound on a force across the contact."""
    most = friction * normal_force
    size = wp.length(force)
    if size > most:
        return force * (most / size)
    return force


@wp.func
def across(a: wp.vec3, normal: wp.vec3):
    return a - wp.dot(a, normal) * normal


# --- in implicit steps: springs with multipliers ----------------------------------------------------------------------

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
