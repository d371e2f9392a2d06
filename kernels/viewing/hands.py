"""Hands: springs between places that a person moves and points of a shown surface, which is bound to a body's nodes.

One thread a hand loops over its patch. So the cost depends on the patch only, sums have one order, and force and place
are known in the same launch. Patches are small, and there are few hands. In implicit steps the forces are those at the
end of a step, and the matrix has the springs' stiffness.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node

wp.set_module_options({"enable_backward": False})


@wp.struct
class Spring:
    """The spring of a hand.

    Attributes:
        motion: How far the hand has moved since it took hold [m].
        stiffness: Of the whole patch [N/m].
        damping: The same [N s/m].
        limit: The largest force [N].
        rigid: Whether the hand holds every point at its place relative to the hand; otherwise it holds only their mean.
        count: Points of the patch; 0 while the hand holds nothing.
    """

    motion: wp.vec3
    stiffness: float
    damping: float
    limit: float
    rigid: int
    count: int


@wp.func
def at_point(values: wp.array[wp.vec4], nodes: wp.vec4i, weights: wp.vec4):
    """Nodal vectors at a point that is bound to four nodes."""
    return (
        weights[0] * load_node(values, nodes[0])
        + weights[1] * load_node(values, nodes[1])
        + weights[2] * load_node(values, nodes[2])
        + weights[3] * load_node(values, nodes[3])
    )


@wp.func
def spring_force(spring: Spring, stretch: wp.vec3, velocity: wp.vec3):
    """k stretch - c velocity, no larger than the limit [N]."""
    force = spring.stiffness * stretch - spring.damping * velocity
    size = wp.length(force)
    if size > spring.limit:
        force *= spring.limit / size
    return force


@wp.func
def softened_by_limit(spring: Spring, stretch: wp.vec3):
    """The stiffness [N/m] that gives the force at this stretch, which is no larger than the limit."""
    size = spring.stiffness * wp.length(stretch)
    if size > spring.limit:
        return spring.stiffness * spring.limit / size
    return spring.stiffness


@wp.func
def add_force(forces: wp.array[wp.vec4], nodes: wp.vec4i, weights: wp.vec4, force: wp.vec3):
    for n in range(4):
        wp.atomic_add(forces, nodes[n], weights[n] * wp.vec4(force[0], force[1], force[2], 0.0))


@wp.kernel(enable_backward=False)
def take_hold(
    # In
    patch: wp.array[wp.int32],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    start: wp.array[wp.vec3],
):
    """Remember the displacements of the points of a patch [m]."""
    i = wp.tid()
    start[i] = at_point(u, nodes[patch[i]], weights[patch[i]])


@wp.kernel(enable_backward=False)
def pull(
    # In
    springs: wp.array[Spring],
    patches: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    starts: wp.array2d[wp.vec3],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    # In and out
    f: wp.array[wp.vec4],
    # Out
    found: wp.array2d[wp.vec3],
    softened: wp.array2d[wp.float32],
):
    """Add the forces of all hands to the nodes.

    ``found`` is each hand's force on the body [N] and the mean displacement of its patch [m], ``softened`` the
    stiffness of the spring of each point, or of the patch in the first place [N/m].
    """
    hand = wp.tid()
    spring = springs[hand]
    mean = wp.vec3(0.0)
    velocity = wp.vec3(0.0)
    start = wp.vec3(0.0)
    for k in range(spring.count):
        point = patches[hand, k]
        mean += shares[hand, k] * at_point(u, nodes[point], weights[point])
        velocity += shares[hand, k] * at_point(v, nodes[point], weights[point])
        start += shares[hand, k] * starts[hand, k]
    stretch = start + spring.motion - mean
    force = spring_force(spring, stretch, velocity)
    softened[hand, 0] = softened_by_limit(spring, stretch)
    total = wp.vec3(0.0)
    for k in range(spring.count):
        point = patches[hand, k]
        if spring.rigid != 0:
            stretch = starts[hand, k] + spring.motion - at_point(u, nodes[point], weights[point])
            force = spring_force(spring, stretch, at_point(v, nodes[point], weights[point]))
            softened[hand, k] = softened_by_limit(spring, stretch)
        total += shares[hand, k] * force
        add_force(f, nodes[point], weights[point], shares[hand, k] * force)
    found[hand, 0] = total
    found[hand, 1] = mean


@wp.kernel(enable_backward=False)
def add_products(
    # In
    springs: wp.array[Spring],
    patches: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    softened: wp.array2d[wp.float32],
    p: wp.array[wp.vec4],
    # In and out
    y: wp.array[wp.vec4],
):
    """y += K p."""
    hand = wp.tid()
    spring = springs[hand]
    mean = wp.vec3(0.0)
    if spring.rigid == 0:
        for k in range(spring.count):
            point = patches[hand, k]
            mean += shares[hand, k] * at_point(p, nodes[point], weights[point])
        mean *= softened[hand, 0]
    for k in range(spring.count):
        point = patches[hand, k]
        force = mean
        if spring.rigid != 0:
            force = softened[hand, k] * at_point(p, nodes[point], weights[point])
        add_force(y, nodes[point], weights[point], shares[hand, k] * force)


@wp.kernel(enable_backward=False)
def add_blocks(
    # In
    springs: wp.array[Spring],
    patches: wp.array2d[wp.int32],
    shares: wp.array2d[wp.float32],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    softened: wp.array2d[wp.float32],
    # In and out
    blocks: wp.array[wp.mat33],
):
    """Add the blocks on K's diagonal, or a part of them where points of a patch share nodes and their mean is held."""
    hand = wp.tid()
    spring = springs[hand]
    for k in range(spring.count):
        point = patches[hand, k]
        stiffness = shares[hand, k] * softened[hand, k]
        if spring.rigid == 0:
            stiffness = shares[hand, k] * shares[hand, k] * softened[hand, 0]
        for n in range(4):
            w = weights[point][n]
            wp.atomic_add(blocks, nodes[point][n], (stiffness * w * w) * wp.identity(n=3, dtype=float))
