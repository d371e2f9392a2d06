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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const auto f = [](unsigned int bits) {
        float value;
        asm("cvt.f32.f16 %0, %1;" : "=f"(value) : "h"((unsigned short)(bits & 0xffffu)));
        return value;
    };
    const float4* values = reinterpret_cast<const float4*>(&wp::index(x, first_node));
    const uint2* m = reinterpret_cast<const uint2*>(&wp::index(packed, 12 * (first_entry + begin)));
    const float4 own = values[row];
    wp::vec_t<3, wp::float32> total;
    for (int p = lane; p < end - begin; p += lanes) {
        const uint2 a = m[3 * p], b = m[3 * p + 1], c = m[3 * p + 2];
        const float4 other = values[(a.y >> 16) | (b.y & 0xffff0000u)];
        const float v0 = other.x - own.x, v1 = other.y - own.y, v2 = other.z - own.z;
        total[0] += f(a.x) * v0 + f(b.x) * v1 + f(c.x) * v2;
        total[1] += f(a.x >> 16) * v0 + f(b.x >> 16) * v1 + f(c.x >> 16) * v2;
        total[2] += f(a.y) * v0 + f(b.y) * v1 + f(c.y) * v2;
    }
    return total;
#else
    typedef _Float16 half4 __attribute__((vector_size(8), aligned(8)));
    typedef float float4 __attribute__((vector_size(16)));
    const float4* values = reinterpret_cast<const float4*>(x.data) + first_node;
    const unsigned short* m = packed.data + 12 * (first_entry + begin);
    const float4 own = values[row];
    // Sums that do not wait for one another.
    float4 a = {0.0f, 0.0f, 0.0f, 0.0f}, b = a, c = a;
    for (int p = begin; p < end; ++p, m += 12) {
        const float4 v = values[m[3] | (m[7] << 16)] - own;
        a += __builtin_convertvector(*reinterpret_cast<const half4*>(m), float4) * v[0];
        b += __builtin_convertvector(*reinterpret_cast<const half4*>(m + 4), float4) * v[1];
        c += __builtin_convertvector(*reinterpret_cast<const half4*>(m + 8), float4) * v[2];
    }
    a += b + c;
    return wp::vec_t<3, wp::float32>(a[0], a[1], a[2]);
#endif
""")
def row_differences(
    row: int,
    lane: int,
    lanes: int,
    begin: int,
    end: int,
    first_entry: int,
    first_node: int,
    packed: wp.array[wp.uint16],
    x: wp.array[wp.vec4],
) -> wp.vec3:
    """Multiply each block of a row by the difference between its x and the row's own x, and add these up. On CUDA each
    of ``lanes`` neighbouring threads returns a part of the sum; see ``pack_rows``."""
    ...


@wp.func_native("""
    const int numbers[3] = {column & 0xffff, (column >> 16) & 0xffff, 0};
    unsigned short* to = &wp::index(packed, 12 * entry);
    for (int j = 0; j < 3; ++j) {
        for (int i = 0; i < 3; ++i) to[4 * j + i] = wp::half(block.data[j][i]).u;
        to[4 * j + 3] = (unsigned short)numbers[j];
    }
""")
def pack_entry(packed: wp.array[wp.uint16], entry: int, column: int, block: wp.mat33):
    """Pack an entry as three columns of four 16-bit numbers: the transposed block, and its column index in the fourth
    numbers.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const unsigned int first = threadIdx.x & 31 & ~(lanes - 1);
    const unsigned int together = (lanes < 32 ? (1u << lanes) - 1u : ~0u) << first;
    for (int step = lanes / 2; step > 0; step /= 2) value = fmaxf(value, __shfl_xor_sync(together, value, step));
#endif
    return value;
""")
def most_over_lanes(value: float, lanes: int) -> float:
    """The largest value of neighbouring threads; see ``sum_over_lanes``."""
    ...


@wp.kernel(enable_backward=False)
def pack_rows(
    # In
    lanes: int,
    count: int,
    entries: int,
    starts: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    blocks: wp.array[wp.mat33],
    # Out
    packed: wp.array[wp.uint16],
    sums: wp.array[wp.mat33],
    units: wp.array[float],
):
    """Write rows in the form for smoothing: blocks in half precision, in a unit for each row, and the sum of the row's
    blocks.

    (A x)_i = sum of A_ij (x_j - x_i) + (sum of A_ij) x_i. So rounding of blocks acts only on differences, and a
    translation has no error. Units are powers of two, so a block and its mirror image are rounded alike. Only the sum
    of rounding errors on the diagonal is not symmetric, some ten-thousandths of it.
    """
    world, thread = wp.tid()
    i, lane = thread / lanes, thread % lanes
    first = world * entries
    # Entries are transposed: the sum of their rows is that of the blocks' columns.
    column0 = wp.vec3()
    column1 = wp.vec3()
    column2 = wp.vec3()
    largest = float(0.0)
    for p in range(starts[i] + lane, starts[i + 1], lanes):
        block = blocks[first + p]
        column0 += block[0]
        column1 += block[1]
        column2 += block[2]
        if columns[p] != i:
            for a in range(3):
                row = wp.abs(block[a])
                largest = wp.max(largest, wp.max(row[0], wp.max(row[1], row[2])))
    column0 = sum_over_lanes(column0, lanes)
    column1 = sum_over_lanes(column1, lanes)
    column2 = sum_over_lanes(column2, lanes)
    largest = most_over_lanes(largest, lanes)
    unit = float(0.0)
    inverse = float(0.0)
    if largest > 1.0e-30:
        unit = wp.pow(2.0, wp.floor(wp.log2(largest)) - 12.0)
        inverse = 1.0 / unit
    for p in range(starts[i] + lane, starts[i + 1], lanes):
        block = inverse * blocks[first + p]
        if columns[p] == i:
            block = wp.mat33()
        pack_entry(packed, first + p, columns[p], block)
    if lane == 0:
        sums[world * count + i] = wp.matrix_from_cols(column0, column1, column2)
        units[world * count + i] = unit


@wp.struct
class Rows:
    """A level's matrix; all worlds share the pattern. ``packed``, ``sums`` and ``units`` are empty if blocks are read
    instead.
    """

    starts: wp.array[wp.int32]
    columns: wp.array[wp.int32]
    blocks: wp.array[wp.mat33]  # transposed
    packed: wp.array[wp.uint16]  # as ``pack_rows`` writes these
    sums: wp.array[wp.mat33]
    units: wp.array[float]


@wp.func
def product_of(rows: Rows, world: int, i: int, lane: int, lanes: int, count: int, entries: int, z: wp.array[wp.vec4]):
    """Row i of A z, in the first lane."""
    begin, end, first, first_node = rows.starts[i], rows.starts[i + 1], world * entries, world * count
    part = wp.vec3()
    if rows.packed.shape[0] > 0:
        part = row_differences(i, lane, lanes, begin, end, first, first_node, rows.packed, z)
    else:
        part = row_product(lane, lanes, begin, end, first, first_node, rows.columns, rows.blocks, z)
    part = sum_over_lanes(part, lanes)
    if rows.packed.shape[0] > 0:
        part = rows.units[first_node + i] * part + rows.sums[first_node + i] * load_node(z, first_node + i)
    return part


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
