"""The cycle: smoothing, transfers, and the conversion of its input and output.

Smoothing is Chebyshev's iteration with the inverse diagonal blocks. It needs a bound on the largest eigenvalue of
D^-1 A. The matrix of each element, and of each ancestor, is positive semidefinite and couples four nodes, so it is at
most four times its own diagonal blocks: 4 is a bound on all levels.

On a CPU one thread computes a row of a matrix. On CUDA several lanes share it: they read neighbouring entries together,
and a small level takes no longer than its longest sum.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.elements.lanes import COMPILER_FLAGS

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": COMPILER_FLAGS})


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int first = threadIdx.x & 31 & ~(lanes - 1);
    const unsigned int together = (lanes < 32 ? (1u << lanes) - 1u : ~0u) << first;
    for (int step = lanes / 2; step > 0; step /= 2)
        for (int a = 0; a < 3; ++a) part[a] += __shfl_xor_sync(together, part[a], step);
#endif
    return part;
""")
def sum_over_lanes(part: wp.vec3, lanes: int) -> wp.vec3:
    """The sum of the parts of ``lanes`` neighbouring threads, a power of two up to 32; each of them gets the sum. On a
    CPU there is one.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    wp::vec_t<3, wp::float32> total;
    for (int p = begin + lane; p < end; p += lanes) {
        const float* m = &wp::index(blocks, first_entry + p).data[0][0];
        const float4 v = *reinterpret_cast<const float4*>(&wp::index(x, first_node + wp::index(columns, p)));
        total[0] += m[0] * v.x + m[3] * v.y + m[6] * v.z;
        total[1] += m[1] * v.x + m[4] * v.y + m[7] * v.z;
        total[2] += m[2] * v.x + m[5] * v.y + m[8] * v.z;
    }
    return total;
#else
    typedef float float4 __attribute__((vector_size(16)));
    typedef float float4u __attribute__((vector_size(16), aligned(4)));
    // Sums that do not wait for one another.
    float4 a = {0.0f, 0.0f, 0.0f, 0.0f}, b = a, c = a;
    const float* m = &wp::index(blocks, first_entry + begin).data[0][0];
    const int* column = &wp::index(columns, begin);
    const float* values = &wp::index(x, first_node)[0];
    for (int p = begin; p < end; ++p, m += 9, ++column) {
        const float* v = values + 4 * *column;
        a += *reinterpret_cast<const float4u*>(m) * v[0];
        b += *reinterpret_cast<const float4u*>(m + 3) * v[1];
        c += *reinterpret_cast<const float4u*>(m + 6) * v[2];
    }
    a += b + c;
    return wp::vec_t<3, wp::float32>(a[0], a[1], a[2]);
#endif
""")
def row_product(
    lane: int,
    lanes: int,
    begin: int,
    end: int,
    first_entry: int,
    first_node: int,
    columns: wp.array[wp.int32],
    blocks: wp.array[wp.mat33],
    x: wp.array[wp.vec4],
) -> wp.vec3:
    """The product of a row with x; on CUDA each of ``lanes`` neighbouring threads returns a part.

    Entries are transposed, so that on a CPU four lanes of a vector add columns; for the last column they read one
    number past its end.
    """
    ...


@wp.struct
class Rows:
    """A level's matrix; all worlds share the pattern."""

    starts: wp.array[wp.int32]
    columns: wp.array[wp.int32]
    blocks: wp.array[wp.mat33]  # transposed


@wp.func
def product_of(rows: Rows, world: int, i: int, lane: int, lanes: int, count: int, entries: int, z: wp.array[wp.vec4]):
    """Row i of A z, in the first lane."""
    begin, end, first, first_node = rows.starts[i], rows.starts[i + 1], world * entries, world * count
    part = row_product(lane, lanes, begin, end, first, first_node, rows.columns, rows.blocks, z)
    return sum_over_lanes(part, lanes)


@wp.kernel(enable_backward=False)
def take_in(
    # In
    ranks: int,
    mesh_nodes: int,
    alpha: float,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    inverses: wp.array[wp.mat33],
    given: wp.array[wp.vec4],
    # Out
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
):
    """Sort the residual by rank, zero at held nodes, and make the first step from zero."""
    world, i = wp.tid()
    node = nodes[i]
    at = world * ranks + i
    value = wp.vec3()
    if node < mesh_nodes and free[at] != wp.uint8(0):
        value = load_node(given, world * mesh_nodes + node)
    store_node(r, at, value)
    store_node(z, at, alpha * (inverses[at] * value))


@wp.kernel(enable_backward=False)
def hand_out(
    # In
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    # Out
    result: wp.array[wp.vec4],
):
    """Sort the result by node; held nodes have the identity."""
    world, i = wp.tid()
    node = nodes[i]
    if node >= mesh_nodes:
        return
    at = world * ranks + i
    to = world * mesh_nodes + node
    if free[at] != wp.uint8(0):
        store_node(result, to, load_node(z, at))
    else:
        store_node(result, to, load_node(given, to))


@wp.kernel(enable_backward=False)
def smooth(
    # In
    lanes: int,
    count: int,
    entries: int,
    alpha: float,
    beta: float,
    from_zero: bool,
    rows: Rows,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    # In and out
    other: wp.array[wp.vec4],
):
    """Make one step: ``other`` has the values before z, or zero if the flag says so, and receives the values after
    it.
    """
    world, thread = wp.tid()
    i, lane = thread / lanes, thread % lanes
    at = world * count + i
    product = product_of(rows, world, i, lane, lanes, count, entries, z)
    if lane > 0:
        return
    now = load_node(z, at)
    step = alpha * (inverses[at] * (load_node(r, at) - product))
    if beta != 0.0:
        before = wp.vec3()
        if not from_zero:
            before = load_node(other, at)
        step += beta * (now - before)
    store_node(other, at, now + step)


@wp.kernel(enable_backward=False)
def find_residual(
    # In
    lanes: int,
    count: int,
    entries: int,
    rows: Rows,
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    # Out
    residual: wp.array[wp.vec4],
):
    """r - A z."""
    world, thread = wp.tid()
    i, lane = thread / lanes, thread % lanes
    at = world * count + i
    product = product_of(rows, world, i, lane, lanes, count, entries, z)
    if lane > 0:
        return
    store_node(residual, at, load_node(r, at) - product)


@wp.kernel(enable_backward=False)
def restrict_residual(
    # In
    ranks: int,
    coarse: int,
    fine: int,
    alpha: float,
    free: wp.array[wp.uint8],
    starts: wp.array[wp.int32],
    midpoints: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    residual: wp.array[wp.vec4],
    # Out
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
):
    """P^T of the finer level's residual, zero at held nodes, and the first step from zero."""
    world, i = wp.tid()
    at = world * coarse + i
    total = wp.vec3()
    if free[world * ranks + i] != wp.uint8(0):
        for p in range(starts[i], starts[i + 1]):
            total += load_node(residual, world * fine + midpoints[p])
        total = 0.5 * total + load_node(residual, world * fine + i)
    store_node(r, at, total)
    store_node(z, at, alpha * (inverses[at] * total))


@wp.kernel(enable_backward=False)
def prolongate_correction(
    # In
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    ends: wp.array[wp.vec2i],
    correction: wp.array[wp.vec4],
    # In and out
    z: wp.array[wp.vec4],
):
    """z += P of the coarser level's correction, at free nodes."""
    world, i = wp.tid()
    if free[world * ranks + i] == wp.uint8(0):
        return
    first = world * coarse
    value = wp.vec3()
    if i < coarse:
        value = load_node(correction, first + i)
    else:
        pair = ends[i]
        value = 0.5 * (load_node(correction, first + pair[0]) + load_node(correction, first + pair[1]))
    at = world * fine + i
    store_node(z, at, load_node(z, at) + value)
