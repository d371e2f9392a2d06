"""The coarsest level: one thread block for each world inverts its matrix once a linearisation, and one launch applies
the inverse.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.elements.lanes import COMPILER_FLAGS
from warp_corot.kernels.stepping.threads import synchronize_block

from .cycle import sum_over_lanes

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": COMPILER_FLAGS})

#: Added to the diagonal, which is scaled to one: the inverse stays finite for a body that nothing holds.
SHIFT = wp.constant(wp.float64(1.0e-5))


@wp.kernel(enable_backward=False)
def fill_dense(
    # In
    entries: int,
    starts: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    diagonal: wp.array[wp.int32],
    blocks: wp.array[wp.mat33],
    # Out
    matrix: wp.array3d[wp.float64],
    scale: wp.array2d[wp.float64],
):
    """Write the matrix, scaled to a diagonal of ones; rows without an entry are zero and have scale zero."""
    world, i = wp.tid()
    first = world * entries
    own = blocks[first + diagonal[i]]
    for a in range(3):
        for column in range(matrix.shape[2]):
            matrix[world, 3 * i + a, column] = wp.float64(0.0)
        scale[world, 3 * i + a] = wp.float64(0.0)
        if own[a, a] > 0.0:
            scale[world, 3 * i + a] = wp.float64(1.0) / wp.sqrt(wp.float64(own[a, a]))
    for p in range(starts[i], starts[i + 1]):
        j = columns[p]
        other = blocks[first + diagonal[j]]
        for a in range(3):
            for b in range(3):
                if own[a, a] > 0.0 and other[b, b] > 0.0:
                    value = wp.float64(blocks[first + p][b, a])
                    size = wp.sqrt(wp.float64(own[a, a]) * wp.float64(other[b, b]))
                    matrix[world, 3 * i + a, 3 * j + b] = value / size
    for a in range(3):
        matrix[world, 3 * i + a, 3 * i + a] += SHIFT
        if own[a, a] <= 0.0:
            matrix[world, 3 * i + a, 3 * i + a] = wp.float64(1.0)


@wp.func_native("""
const double* row = &wp::index(rows, world, 0);
double* a = &wp::index(matrix, world, i, 0);
for (int j = lane; j <= i; j += lanes) a[j] -= factor * row[j];
""")
def subtract_row(
    matrix: wp.array3d[wp.float64],
    rows: wp.array2d[wp.float64],
    world: int,
    i: int,
    lane: int,
    lanes: int,
    factor: wp.float64,
):
    """Subtract a multiple of the pivot's row from row i of the lower triangle; ``lanes`` threads share its entries."""
    ...


@wp.kernel(enable_backward=False)
def invert_dense(
    # In
    lanes: int,
    # In and out
    matrix: wp.array3d[wp.float64],
    # Out
    rows: wp.array2d[wp.float64],
):
    """Overwrite the lower triangle of each world's matrix with minus its inverse, by symmetric sweeps. Each world has
    one thread block, which keeps the pivot's row in ``rows``; ``lanes`` of its threads share a row of the matrix.
    """
    thread = wp.tid()
    threads = wp.block_dim()
    world = thread / threads
    lane = thread % threads
    size = matrix.shape[1]
    for k in range(size):
        pivot = matrix[world, k, k]
        for j in range(lane, size, threads):
            if j < k:
                rows[world, j] = matrix[world, k, j]
            elif j > k:
                rows[world, j] = matrix[world, j, k]
            else:
                rows[world, j] = wp.float64(0.0)
        synchronize_block()
        inverse = wp.float64(1.0) / pivot
        part = lane % lanes
        for i in range(lane / lanes, size, threads / lanes):
            if i != k:
                factor = rows[world, i] * inverse
                subtract_row(matrix, rows, world, i, part, lanes, factor)
                # Entry k of the row is in the pivot's column; the lane that has subtracted from it writes it.
                if i > k and part == k % lanes:
                    matrix[world, i, k] = factor
            else:
                for j in range(part, k, lanes):
                    matrix[world, k, j] = rows[world, j] * inverse
                if part == 0:
                    matrix[world, k, k] = -inverse
        synchronize_block()


@wp.kernel(enable_backward=False)
def store_inverse(
    # In
    matrix: wp.array3d[wp.float64],
    scale: wp.array2d[wp.float64],
    # Out
    inverse: wp.array3d[float],
):
    world, i, j = wp.tid()
    value = matrix[world, wp.max(i, j), wp.min(i, j)]
    inverse[world, i, j] = float(-value * scale[world, i] * scale[world, j])


@wp.kernel(enable_backward=False)
def apply_dense(
    # In
    lanes: int,
    count: int,
    inverse: wp.array3d[float],
    r: wp.array[wp.vec4],
    # Out
    z: wp.array[wp.vec4],
):
    """z = inverse r; ``lanes`` neighbouring threads share the three rows of a node."""
    world, thread = wp.tid()
    i, lane = thread / lanes, thread % lanes
    total = wp.vec3()
    for j in range(lane, count, lanes):
        value = load_node(r, world * count + j)
        for a in range(3):
            for b in range(3):
                total[a] += inverse[world, 3 * i + a, 3 * j + b] * value[b]
    total = sum_over_lanes(total, lanes)
    if lane == 0:
        store_node(z, world * count + i, total)
