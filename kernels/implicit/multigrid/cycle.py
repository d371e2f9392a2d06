"""The cycle: smoothing, transfers, and the conversion of its input and output.

Smoothing is Chebyshev's iteration with the inverse diagonal blocks. It needs a bound on the largest eigenvalue of
D^-1 A. The matrix of each element, and of each ancestor, is positive semidefinite and couples four nodes, so it is at
most four times its own diagonal blocks: 4 is a bound on all levels.

On a CPU one thread of each world moves values between levels, because a launch over all nodes takes longer to count
them, and one thread computes a row of a matrix. On CUDA several lanes share a row: they read neighbouring entries
together, and a small level takes no longer than its longest sum.

A forward sweep from zero reads the lower half of the matrix, and its residual needs only the upper half. So one sweep
before the coarser level and its mirror image after it cost as much as two products, and smooth as well as Chebyshev's
iteration of degree 2, which costs four.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.elements.simd8 import on_cpu

wp.set_module_options({"enable_backward": False})


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
    #pragma clang fp contract(fast)
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


#: Native code of transfers: the vectors of one world, and its flags of free nodes. Warp's own loops over vec4 arrays
#: take two to three times as long on a CPU.
_MOVES = """
#if defined(__CUDA_ARCH__)
    struct alignas(16) four {
        float x, y, z, w;
        __device__ four operator+(const four& b) const { return {x + b.x, y + b.y, z + b.z, w + b.w}; }
        __device__ four operator*(float s) const { return {s * x, s * y, s * z, s * w}; }
    };
#else
    typedef float four __attribute__((vector_size(16)));
#endif
    const auto vectors = [&](const auto& all, int nodes) {
        return reinterpret_cast<four*>(all.data) + (long long)world * nodes;
    };
    const unsigned char* is_free = free.data + (long long)world * ranks;
    const four zero = {0.0f, 0.0f, 0.0f, 0.0f};
"""


@wp.func_native(
    _MOVES
    + """
    const four* from = vectors(given, mesh_nodes);
    four* to = vectors(r, ranks);
    for (int i = thread; i < ranks; i += threads) {
        const int node = nodes.data[i];
        to[i] = node < mesh_nodes && is_free[i] ? from[node] : zero;
    }
"""
)
def take_nodes(
    world: int,
    thread: int,
    threads: int,
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
): ...


@wp.func_native(
    _MOVES
    + """
    const four *from = vectors(z, ranks), *held = vectors(given, mesh_nodes);
    four* to = vectors(result, mesh_nodes);
    for (int i = thread; i < ranks; i += threads) {
        const int node = nodes.data[i];
        if (node < mesh_nodes) to[node] = is_free[i] ? from[i] : held[node];
    }
"""
)
def hand_nodes(
    world: int,
    thread: int,
    threads: int,
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    given: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    result: wp.array[wp.vec4],
): ...


@wp.func_native(
    _MOVES
    + """
    const four* from = vectors(residual, fine);
    four* to = vectors(r, coarse);
    for (int i = thread; i < coarse; i += threads) {
        four total = zero;
        if (is_free[i]) {
            for (int p = starts.data[i]; p < starts.data[i + 1]; ++p) total = total + from[midpoints.data[p]];
            total = total * 0.5f + from[i];
        }
        to[i] = total;
    }
"""
)
def restrict_nodes(
    world: int,
    thread: int,
    threads: int,
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    starts: wp.array[wp.int32],
    midpoints: wp.array[wp.int32],
    residual: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
): ...


@wp.func_native(
    _MOVES
    + """
    const four* from = vectors(correction, coarse);
    four* to = vectors(z, fine);
    for (int i = thread; i < fine; i += threads)
        if (is_free[i]) to[i] = to[i] + (i < coarse ? from[i] : (from[ends.data[i][0]] + from[ends.data[i][1]]) * 0.5f);
"""
)
def prolongate_nodes(
    world: int,
    thread: int,
    threads: int,
    ranks: int,
    coarse: int,
    fine: int,
    free: wp.array[wp.uint8],
    ends: wp.array[wp.vec2i],
    correction: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
): ...


@wp.func
def make_first_step(
    world: int,
    thread: int,
    threads: int,
    count: int,
    alpha: float,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
):
    """The smoother's first step from zero, unless alpha is zero."""
    if alpha != 0.0:
        for i in range(thread, count, threads):
            at = world * count + i
            store_node(z, at, alpha * (inverses[at] * load_node(r, at)))


@wp.kernel(enable_backward=False)
def take_in(
    # In
    threads: int,
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
    world, thread = wp.tid()
    take_nodes(world, thread, threads, ranks, mesh_nodes, nodes, free, given, r)
    make_first_step(world, thread, threads, ranks, alpha, inverses, r, z)


@wp.kernel(enable_backward=False)
def hand_out(
    # In
    threads: int,
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
    world, thread = wp.tid()
    hand_nodes(world, thread, threads, ranks, mesh_nodes, nodes, free, given, z, result)


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
    threads: int,
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
    world, thread = wp.tid()
    restrict_nodes(world, thread, threads, ranks, coarse, fine, free, starts, midpoints, residual, r)
    make_first_step(world, thread, threads, coarse, alpha, inverses, r, z)


@wp.kernel(enable_backward=False)
def prolongate_correction(
    # In
    threads: int,
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
    world, thread = wp.tid()
    prolongate_nodes(world, thread, threads, ranks, coarse, fine, free, ends, correction, z)


#: Shared code: the sum of a range of a row's blocks times x, and the product of an inverse and a vector.
_ROWS = """
    const int* starts = rows.starts.data;
    const int* columns = rows.columns.data;
    const float* blocks = &rows.blocks.data[(long long)world * entries].data[0][0];
    const float* inverse = &inverses.data[(long long)world * count].data[0][0];
    const four* right = reinterpret_cast<const four*>(r.data) + (long long)world * count;
    four* x = reinterpret_cast<four*>(z.data) + (long long)world * count;
    four* rest = reinterpret_cast<four*>(other.data) + (long long)world * count;
    // Blocks are transposed; of the last column a number past its end is read.
    const auto product = [&](int begin, int end) {
        four a = {0.0f, 0.0f, 0.0f, 0.0f}, b = a, c = a;
        const float* m = blocks + 9ll * begin;
        for (int p = begin; p < end; ++p, m += 9) {
            const four v = x[columns[p]];
            a += *reinterpret_cast<const four*>(m) * v[0];
            b += *reinterpret_cast<const four*>(m + 3) * v[1];
            c += *reinterpret_cast<const four*>(m + 6) * v[2];
        }
        a += b + c;
        return four{a[0], a[1], a[2], 0.0f};
    };
    const auto solved = [&](int i, const four& v) {
        const float* m = inverse + 9ll * i;
        const four a = {m[0], m[3], m[6], 0.0f}, b = {m[1], m[4], m[7], 0.0f}, c = {m[2], m[5], m[8], 0.0f};
        return a * v[0] + b * v[1] + c * v[2];
    };
"""


@wp.func_native(
    on_cpu(
        _ROWS,
        """
    for (int i = 0; i < count; ++i) {
        rest[i] = right[i] - product(starts[i], diagonal.data[i]);
        x[i] = solved(i, rest[i]);
    }
""",
    )
)
def sweep_rows_from_zero(
    world: int,
    count: int,
    entries: int,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _ROWS,
        """
    for (int k = 0; k < count; ++k) {
        const int i = backward ? count - 1 - k : k;
        x[i] += solved(i, right[i] - product(starts[i], starts[i + 1]));
    }
""",
    )
)
def sweep_rows(
    world: int,
    count: int,
    entries: int,
    backward: bool,
    rows: Rows,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
): ...


@wp.func_native(
    on_cpu(
        _ROWS,
        """
    if (is_first)
        for (int i = 0; i < count; ++i) rest[i] -= product(diagonal.data[i], starts[i + 1]);
    else
        for (int i = 0; i < count; ++i) rest[i] = right[i] - product(starts[i], starts[i + 1]);
""",
    )
)
def subtract_rows(
    world: int,
    count: int,
    entries: int,
    is_first: bool,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
): ...


@wp.kernel(enable_backward=False)
def sweep_from_zero(
    # In
    count: int,
    entries: int,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    # Out
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
):
    """z = (D + L)^-1 r; ``other`` is r - L z."""
    sweep_rows_from_zero(wp.tid(), count, entries, rows, diagonal, inverses, r, z, other)


@wp.kernel(enable_backward=False)
def sweep(
    # In
    count: int,
    entries: int,
    backward: bool,
    rows: Rows,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    # In and out
    z: wp.array[wp.vec4],
):
    """Sweep over all rows, forward or backward."""
    sweep_rows(wp.tid(), count, entries, backward, rows, inverses, r, z, z)


@wp.kernel(enable_backward=False)
def find_rest(
    # In
    count: int,
    entries: int,
    is_first: bool,
    rows: Rows,
    diagonal: wp.array[wp.int32],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    inverses: wp.array[wp.mat33],
    # In and out
    other: wp.array[wp.vec4],
):
    """r - A z; after ``sweep_from_zero``, ``other`` already has a part of it."""
    subtract_rows(wp.tid(), count, entries, is_first, rows, diagonal, inverses, r, z, other)
