"""Sums over the nodes of each world, in float64 and in a fixed order: first parts, which another kernel adds up."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Sums:
    """A launch has ``threads`` threads for each world; ``lanes`` of them, a warp or one, compute a part."""

    count: int  # nodes of a world
    threads: int
    lanes: int
    parts: wp.array3d[wp.float64]  # [worlds, parts, columns]


_OVER_LANES = """
#if defined(__CUDA_ARCH__)
    if (lanes > 1) for (int k = 16; k > 0; k >>= 1) {{
        const wp::float64 other = __shfl_down_sync(0xffffffffu, value, k);
        value = {0};
    }}
#endif
    return value;
"""


@wp.func_native(_OVER_LANES.format("value + other"))
def sum_of_lanes(value: wp.float64, lanes: int) -> wp.float64:
    """The sum over the lanes, in a fixed order, in the first one."""
    ...


@wp.func_native(_OVER_LANES.format("fmax(value, other)"))
def most_of_lanes(value: wp.float64, lanes: int) -> wp.float64:
    """The largest value of the lanes, in the first one."""
    ...


@wp.func
def dot64(a: wp.vec3, b: wp.vec3):
    """a . b in float64, because the products may exceed the range of float32."""
    return wp.dot(wp.vec3d(a), wp.vec3d(b))


@wp.func
def store_sum(sums: Sums, world: int, thread: int, column: int, value: wp.float64):
    """Write the sum of the values of a part's threads."""
    total = sum_of_lanes(value, sums.lanes)
    if thread % sums.lanes == 0:
        sums.parts[world, thread / sums.lanes, column] = total


@wp.func
def add_sum(sums: Sums, world: int, thread: int, column: int, value: wp.float64):
    """Add the sum of the values of a part's threads to the part."""
    total = sum_of_lanes(value, sums.lanes)
    if thread % sums.lanes == 0:
        part = thread / sums.lanes
        sums.parts[world, part, column] = sums.parts[world, part, column] + total


@wp.func
def store_most(sums: Sums, world: int, thread: int, column: int, value: wp.float64):
    """Write the largest of the values of a part's threads."""
    most = most_of_lanes(value, sums.lanes)
    if thread % sums.lanes == 0:
        sums.parts[world, thread / sums.lanes, column] = most


@wp.func
def add_most(sums: Sums, world: int, thread: int, column: int, value: wp.float64):
    """Let the part be the largest of these values and its own."""
    most = most_of_lanes(value, sums.lanes)
    if thread % sums.lanes == 0:
        part = thread / sums.lanes
        sums.parts[world, part, column] = wp.max(sums.parts[world, part, column], most)


@wp.func
def add_up(sums: Sums, world: int, lane: int, column: int):
    """The sum of a world's parts, in the first of ``lanes`` threads."""
    total = wp.float64(0.0)
    for k in range(lane, sums.parts.shape[1], sums.lanes):
        total += sums.parts[world, k, column]
    return sum_of_lanes(total, sums.lanes)


@wp.func
def largest(sums: Sums, world: int, lane: int, column: int):
    """The largest of a world's parts, at least zero, in the first of ``lanes`` threads."""
    most = wp.float64(0.0)
    for k in range(lane, sums.parts.shape[1], sums.lanes):
        most = wp.max(most, sums.parts[world, k, column])
    return most_of_lanes(most, sums.lanes)
