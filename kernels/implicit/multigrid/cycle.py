"""The cycle: smoothing, transfers, and the conversion of its input and output.

Smoothing is Chebyshev's iteration with the inverse diagonal blocks. It needs a bound on the largest eigenvalue of
D^-1 A. The matrix of each element, and of each ancestor, is positive semidefinite and couples four nodes, so it is at
most four times its own diagonal blocks: 4 is a bound on all levels.

On a CPU one thread of each world moves values between levels, because a launch over all nodes takes longer to count
them, and one thread computes a row of a matrix. On CUDA several lanes share a row: they read neighbouring entries
together, and a small level takes no longer than its longest sum.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.elements.simd8 import constants, on_cpu

wp.set_module_options({"enable_backward": False})


#: Native code: four floats that are added and multiplied at once.
FOUR = """
#if defined(__CUDA_ARCH__)
    struct alignas(16) four {
        float v[4];
        __device__ float operator[](int i) const { return v[i]; }
        __device__ four operator+(const four& b) const {
            return {v[0] + b.v[0], v[1] + b.v[1], v[2] + b.v[2], v[3] + b.v[3]};
        }
        __device__ four operator*(const four& b) const {
            return {v[0] * b.v[0], v[1] * b.v[1], v[2] * b.v[2], v[3] * b.v[3]};
        }
        __device__ four operator*(float s) const { return {s * v[0], s * v[1], s * v[2], s * v[3]}; }
        __device__ void operator+=(const four& b) { *this = *this + b; }
        __device__ void operator*=(float s) { *this = *this * s; }
    };
#else
    #pragma clang fp contract(fast)
    typedef float four __attribute__((vector_size(16), aligned(4)));
#endif
"""


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


@wp.struct
class LevelArrays:
    """A level's matrix, smoother and residual."""

    ranks: int  # nodes of all levels in one world
    count: int  # its own
    entries: int
    lanes: int  # threads that share a row
    free: wp.array[wp.uint8]  # by rank
    rows: Rows
    diagonal: wp.array[wp.int32]
    inverses: wp.array[wp.mat33]  # of diagonal blocks
    r: wp.array[wp.vec4]


@wp.func
def row_of(level: LevelArrays, world: int, i: int, lane: int, z: wp.array[wp.vec4]):
    """Row i of A z, in the first lane."""
    begin, end = level.rows.starts[i], level.rows.starts[i + 1]
    first, first_node = world * level.entries, world * level.count
    columns, blocks = level.rows.columns, level.rows.blocks
    part = row_product(lane, level.lanes, begin, end, first, first_node, columns, blocks, z)
    return sum_over_lanes(part, level.lanes)


#: What is moved: the residual from the mesh to the finest level; the correction back; the finer level's residual to a
#: coarser one; and the coarser level's correction to the finer one.
TAKE_IN, HAND_OUT, RESTRICT, PROLONGATE = range(4)


@wp.struct
class Transfer:
    """What moves between a level and another one, or the mesh."""

    kind: int
    threads: int  # of each world
    count: int  # nodes of the other level, or of the mesh, in one world
    alpha: float  # the factor of the smoother's first step from zero; zero: none is made
    starts: wp.array[wp.int32]  # where the midpoints of each node begin
    places: wp.array[wp.int32]  # these midpoints; or the mesh's node of each rank
    ends: wp.array[wp.vec2i]  # by rank
    given: wp.array[wp.vec4]  # the other level's vector; or the residual by node
    z: wp.array[wp.vec4]
    result: wp.array[wp.vec4]  # by node


@wp.func_native(
    FOUR
    + constants(TAKE_IN=TAKE_IN, HAND_OUT=HAND_OUT, RESTRICT=RESTRICT)
    + """
    const auto vectors = [&](const auto& all, int nodes) {
        return reinterpret_cast<four*>(all.data) + (long long)world * nodes;
    };
    const unsigned char* is_free = level.free.data + (long long)world * level.ranks;
    const four zero = {0.0f, 0.0f, 0.0f, 0.0f};
    const int count = level.count, others = transfer.count, threads = transfer.threads;
    const int *starts = transfer.starts.data, *places = transfer.places.data;
    const auto* ends = transfer.ends.data;
    const four* given = vectors(transfer.given, others);
    four *r = vectors(level.r, count), *z = vectors(transfer.z, count), *result = vectors(transfer.result, others);
    if (transfer.kind == TAKE_IN)
        for (int i = thread; i < count; i += threads) r[i] = places[i] < others && is_free[i] ? given[places[i]] : zero;
    else if (transfer.kind == HAND_OUT)
        for (int i = thread; i < count; i += threads) {
            if (places[i] < others) result[places[i]] = is_free[i] ? z[i] : given[places[i]];
        }
    else if (transfer.kind == RESTRICT)
        for (int i = thread; i < count; i += threads) {
            four total = zero;
            if (is_free[i]) {
                for (int p = starts[i]; p < starts[i + 1]; ++p) total = total + given[places[p]];
                total = total * 0.5f + given[i];
            }
            r[i] = total;
        }
    else
        for (int i = thread; i < count; i += threads)
            if (is_free[i]) z[i] = z[i] + (i < others ? given[i] : (given[ends[i][0]] + given[ends[i][1]]) * 0.5f);
"""
)
def move_nodes(world: int, thread: int, level: LevelArrays, transfer: Transfer):
    """Warp's own loops over vec4 arrays take two to three times as long on a CPU."""
    ...


@wp.kernel(enable_backward=False)
def move(level: LevelArrays, transfer: Transfer):
    """Move residuals with P^T, or from the mesh, zero at held nodes, and make the smoother's first step from zero; or
    corrections with P at free nodes, or to the mesh, where held nodes have the identity.
    """
    world, thread = wp.tid()
    move_nodes(world, thread, level, transfer)
    if transfer.alpha != 0.0:
        for i in range(thread, level.count, transfer.threads):
            at = world * level.count + i
            store_node(transfer.z, at, transfer.alpha * (level.inverses[at] * load_node(level.r, at)))


@wp.func
def make_step(
    at: int,
    product: wp.vec3,
    alpha: float,
    beta: float,
    from_zero: bool,
    level: LevelArrays,
    z: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
):
    """Make one step from A z of a node: ``other`` has the values before z, or zero if the flag says so, and receives
    the values after it.
    """
    now = load_node(z, at)
    step = alpha * (level.inverses[at] * (load_node(level.r, at) - product))
    if beta != 0.0:
        before = wp.vec3()
        if not from_zero:
            before = load_node(other, at)
        step += beta * (now - before)
    store_node(other, at, now + step)


@wp.kernel(enable_backward=False)
def smooth(
    level: LevelArrays, alpha: float, beta: float, from_zero: bool, z: wp.array[wp.vec4], other: wp.array[wp.vec4]
):
    world, thread = wp.tid()
    i, lane = thread / level.lanes, thread % level.lanes
    product = row_of(level, world, i, lane, z)
    if lane == 0:
        make_step(world * level.count + i, product, alpha, beta, from_zero, level, z, other)


@wp.kernel(enable_backward=False)
def find_residual(level: LevelArrays, z: wp.array[wp.vec4], residual: wp.array[wp.vec4]):
    """r - A z."""
    world, thread = wp.tid()
    i, lane = thread / level.lanes, thread % level.lanes
    at = world * level.count + i
    product = row_of(level, world, i, lane, z)
    if lane == 0:
        store_node(residual, at, load_node(level.r, at) - product)


#: What a sweep over the rows does: z = (D + L)^-1 r, with r - L z in ``other``; a sweep forward or backward; and
#: ``other`` = r - A z, at once or from the part that a sweep from zero has left there.
FROM_ZERO, FORWARD, BACKWARD, RESIDUAL, RESIDUAL_LEFT = range(5)


@wp.func_native(
    on_cpu(
        constants(FROM_ZERO=FROM_ZERO, BACKWARD=BACKWARD, RESIDUAL=RESIDUAL, RESIDUAL_LEFT=RESIDUAL_LEFT),
        """
    const int *starts = level.rows.starts.data, *columns = level.rows.columns.data, *diagonal = level.diagonal.data;
    const int count = level.count;
    const float* blocks = &level.rows.blocks.data[(long long)world * level.entries].data[0][0];
    const float* inverse = &level.inverses.data[(long long)world * count].data[0][0];
    const four* right = reinterpret_cast<const four*>(level.r.data) + (long long)world * count;
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
    if (kind == FROM_ZERO)
        for (int i = 0; i < count; ++i) {
            rest[i] = right[i] - product(starts[i], diagonal[i]);
            x[i] = solved(i, rest[i]);
        }
    else if (kind == RESIDUAL)
        for (int i = 0; i < count; ++i) rest[i] = right[i] - product(starts[i], starts[i + 1]);
    else if (kind == RESIDUAL_LEFT)
        for (int i = 0; i < count; ++i) rest[i] -= product(diagonal[i], starts[i + 1]);
    else
        for (int k = 0; k < count; ++k) {
            const int i = kind == BACKWARD ? count - 1 - k : k;
            x[i] += solved(i, right[i] - product(starts[i], starts[i + 1]));
        }
""",
    )
)
def sweep_rows(world: int, kind: int, level: LevelArrays, z: wp.array[wp.vec4], other: wp.array[wp.vec4]): ...


@wp.kernel(enable_backward=False)
def sweep(kind: int, level: LevelArrays, z: wp.array[wp.vec4], other: wp.array[wp.vec4]):
    """Go over the rows of each world by block Gauss-Seidel, in one thread.

    A forward sweep from zero reads the lower half of the matrix, and its residual needs only the upper half. So one
    sweep before the coarser level and its mirror image after it cost as much as two products, and smooth as well as
    Chebyshev's iteration of degree 2, which costs four.
    """
    sweep_rows(wp.tid(), kind, level, z, other)
