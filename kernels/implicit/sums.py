"""Sums over the nodes of each world, in float64 and in a fixed order: first parts, which the next kernel adds up.

A launch has ``threads`` threads for each world; ``lanes`` of them, a warp on CUDA and one on a CPU, compute a part.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.stepping.balance import sum_of_lanes

wp.set_module_options({"enable_backward": False})


@wp.func
def dot64(a: wp.vec3, b: wp.vec3):
    """a . b in float64, because the products may exceed the range of float32."""
    return wp.dot(wp.vec3d(a), wp.vec3d(b))


@wp.func
def add_up(parts: wp.array3d[wp.float64], world: int, lane: int, lanes: int, column: int):
    """The sum of a world's parts, in the first lane."""
    total = wp.float64(0.0)
    k = lane
    while k < parts.shape[1]:
        total += parts[world, k, column]
        k += lanes
    return sum_of_lanes(total)


@wp.kernel(enable_backward=False)
def sum_products(
    # In
    a: wp.array[wp.vec4],
    b: wp.array[wp.vec4],
    count: int,
    threads: int,
    lanes: int,
    column: int,
    # Out
    parts: wp.array3d[wp.float64],
):
    """Parts of a . b for each world of ``count`` nodes."""
    world, thread = wp.tid()
    total = wp.float64(0.0)
    k = thread
    while k < count:
        i = world * count + k
        total += dot64(load_node(a, i), load_node(b, i))
        k += threads
    total = sum_of_lanes(total)
    if thread % lanes == 0:
        parts[world, thread / lanes, column] = total
