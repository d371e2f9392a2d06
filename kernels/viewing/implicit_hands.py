"""Hands in implicit steps: the forces of their springs at the end of a step, and the springs' stiffness.

One thread a hand loops over its patch; see ``hands``.
"""

import warp as wp

from .hands import Spring, add_force, at_point, spring_force

wp.set_module_options({"enable_backward": False})


@wp.func
def softened_by_limit(spring: Spring, stretch: wp.vec3):
    """The stiffness [N/m] that gives the force at this stretch, which is no larger than the limit."""
    size = spring.stiffness * wp.length(stretch)
    if size > spring.limit:
        return spring.stiffness * spring.limit / size
    return spring.stiffness


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
    start = wp.vec3(0.0)
    for k in range(spring.count):
        point = patches[hand, k]
        mean += shares[hand, k] * at_point(u, nodes[point], weights[point])
        start += shares[hand, k] * starts[hand, k]
    stretch = start + spring.motion - mean
    force = spring_force(spring, stretch, wp.vec3(0.0))
    softened[hand, 0] = softened_by_limit(spring, stretch)
    total = wp.vec3(0.0)
    for k in range(spring.count):
        point = patches[hand, k]
        if spring.rigid != 0:
            stretch = starts[hand, k] + spring.motion - at_point(u, nodes[point], weights[point])
            force = spring_force(spring, stretch, wp.vec3(0.0))
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
