"""Increments of an implicit step from linear solves, and when they are good enough."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

from .conjugate_gradients import BROKEN, CONVERGED, LIMIT

wp.set_module_options({"enable_backward": False})

#: Columns of sizes: the largest change of an increment, and the largest displacement [m].
CHANGE, REACH = (wp.constant(k) for k in range(2))
COLUMNS = 2


@wp.kernel(enable_backward=False)
def take_free(
    inverse_mass: wp.array[wp.float32],
    share: wp.array[wp.float32],
    increment: wp.array[wp.vec4],
    d: wp.array[wp.vec4],
):
    """d = the whole motion at free nodes, of which the increment is a share, and zero at the others."""
    i = wp.tid()
    free = wp.vec3()
    if inverse_mass[i] > 0.0:
        free = load_node(increment, i) / share[0]
    store_node(d, i, free)


@wp.kernel(enable_backward=False)
def move_held(
    # In
    inverse_mass: wp.array[wp.float32],
    base: wp.array[wp.vec4],
    share: wp.array[wp.float32],
    to_end: int,
    # In and out
    increment: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
):
    """Move held nodes from the stage to the end of the step, or back."""
    i = wp.tid()
    if inverse_mass[i] == 0.0:
        factor = share[0]
        if to_end != 0:
            factor = 1.0 / share[0]
        moved = factor * load_node(increment, i)
        store_node(increment, i, moved)
        store_node(u, i, load_node(base, i) + moved)


@wp.kernel(enable_backward=False)
def add_product(product: wp.array[wp.vec4], r: wp.array[wp.vec4]):
    """r += A d."""
    i = wp.tid()
    store_node(r, i, load_node(r, i) + load_node(product, i))


@wp.kernel(enable_backward=False)
def take_increments(
    # In
    adds: int,
    count: int,
    inverse_mass: wp.array[wp.float32],
    base: wp.array[wp.vec4],
    share: wp.array[wp.float32],
    d: wp.array[wp.vec4],
    # In and out
    increment: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
    sizes: wp.array2d[wp.float32],
):
    """Take a share of d as the increment of free nodes, or add it with ``adds``, and find the largest change and
    displacement of each world; all are one if ``sizes`` has one row."""
    i = wp.tid()
    if inverse_mass[i] > 0.0:
        after = share[0] * load_node(d, i)
        if adds != 0:
            after += load_node(increment, i)
        place = load_node(base, i) + after
        if sizes.shape[0] > 0:
            world = wp.min(i / count, sizes.shape[0] - 1)
            wp.atomic_max(sizes, world, CHANGE, wp.length(after - load_node(increment, i)))
            wp.atomic_max(sizes, world, REACH, wp.length(place))
        store_node(increment, i, after)
        store_node(u, i, place)


@wp.kernel(enable_backward=False)
def judge_increments(
    # In
    sizes: wp.array2d[wp.float32],
    linear: wp.array[wp.int32],
    solved: wp.array[wp.int32],
    tolerance: float,
    most: int,
    # In and out
    iterations: wp.array[wp.int32],
    total: wp.array[wp.int32],
    # Out
    status: wp.array[wp.int32],
    going: wp.array[wp.int32],
):
    """Count a linearisation; another one follows if increments of a world still change."""
    world = wp.tid()
    total[world] = total[world] + linear[world]
    iterations[world] = iterations[world] + 1
    status[world] = CONVERGED
    if solved[world] == BROKEN:
        status[world] = BROKEN
    elif solved[world] == LIMIT:
        status[world] = LIMIT
    if status[world] != BROKEN and sizes[world, CHANGE] > tolerance * sizes[world, REACH]:
        status[world] = LIMIT
        if iterations[world] < most:
            going[0] = 1
