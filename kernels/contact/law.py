"""How far two things that touch may come nearer in a step, and what holds them back across it.

A contact force is what it takes for the step to end with the surfaces side by side: it follows from where the nodes
would go without it and from their lumped masses. So it has no stiffness, adds nothing to the largest frequency, and
nothing passes, however fast it comes, as long as the step ends before the other side is reached. Position is followed
slowly, velocity at once: what rounding leaves of positions would otherwise be felt as force.

After Carpenter, Taylor and Katona, Lagrange constraints for transient finite element surface contact (1991).
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Share of what is left of a gap, or of a way to an anchor, that is closed in a step.
SETTLING = wp.constant(0.1)


@wp.struct
class Law:
    tolerance: float  # gaps that rounding leaves [m]
    recovery: float  # speed at which things that overlap are pushed apart [m/s]
    grain: float  # forces on nodes are added up in multiples of this, so that no order matters [N]


@wp.func
def least_motion(gap: float, law: Law, dt: float):
    """How far a contact must open in this step; negative: how far it may close [m]."""
    if gap > law.tolerance:
        return -(gap - (1.0 - SETTLING) * law.tolerance)
    return wp.min(-SETTLING * gap, law.recovery * dt)


@wp.func
def held_back(force: wp.vec3, normal_force: float, friction: float):
    """Coulomb's bound on a force across the contact."""
    most = friction * normal_force
    size = wp.length(force)
    if size > most:
        return force * (most / size)
    return force
