"""The contact law: how far two touching surfaces may approach each other in a step, and the bound on friction.

A contact force is the force with which the step ends with the surfaces side by side. It follows from the nodes' motion
without contact and from their lumped masses. So it has no stiffness and does not change the highest frequency, and no
surface passes another at any speed, provided that the step ends before it reaches the far side. Velocities are
corrected at once and positions slowly, because rounding errors of positions would otherwise act as forces.

After Carpenter, Taylor and Katona, Lagrange constraints for transient finite element surface contact (1991).
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
