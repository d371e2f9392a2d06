"""The coarsest level: one thread block for each world inverts its matrix once a linearisation, and one launch applies
the inverse.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.elements.simd8 import native

from .cycle import LevelArrays, sum_over_lanes

wp.set_module_options({"enable_backward": False})

#: Added to the diagonal, which is scaled to one: the inverse stays finite for a body that nothing holds.
SHIFT = wp.constant(wp.float64(1.0e-5))
#: Number of threads of ``invert_in_registers``.
SWEEPERS = 320


@wp.kernel(enable_backward=False)
def fill_dense(
    # In
    level: LevelArrays,
    # In and out
    matrix: wp.array3d[wp.float64],
    # Out
    scale: wp.array2d[wp.float64],
):
    """Write the matrix, scaled to a diagonal of ones, where it was zero; rows without an entry have scale zero."""
    world, thread = wp.tid()
    i, lane = thread / level.lanes, thread % level.lanes
    first = world * level.entries
    blocks = level.rows.blocks
    own = blocks[first + level.diagonal[i]]
    for p in range(level.rows.starts[i] + lane, level.rows.starts[i + 1], level.lanes):
        j = level.rows.columns[p]
        other = blocks[first + level.diagonal[j]]
        for a in range(3):
            for b in range(3):
                value = wp.float64(0.0)
                if own[a, a] > 0.0 and other[b, b] > 0.0:
                    value = wp.float64(blocks[first + p][b, a])
                    value /= wp.sqrt(wp.float64(own[a, a]) * wp.float64(other[b, b]))
                if i == j and a == b:
                    value = wp.where(own[a, a] > 0.0, value + SHIFT, wp.float64(1.0))
                matrix[world, 3 * i + a, 3 * j + b] = value
    if lane == 0:
        for a in range(3):
            scale[world, 3 * i + a] = wp.float64(0.0)
            if own[a, a] > 0.0:
                scale[world, 3 * i + a] = wp.float64(1.0) / wp.sqrt(wp.float64(own[a, a]))


@wp.func_native(native("sweep_matrix"))
def sweep(matrix: wp.array3d[wp.float64], world: int, rows: wp.array2d[wp.float64]):
    """Overwrite the lower triangle of a world's matrix with minus its inverse, by symmetric sweeps; ``rows`` has the
    pivot's row.
    """
    ...


@wp.kernel(enable_backward=False)
def invert_dense(matrix: wp.array3d[wp.float64], rows: wp.array2d[wp.float64]):
    """Overwrite the lower triangle of each world's matrix with minus its inverse; a thread for each world."""
    sweep(matrix, wp.tid(), rows)


@wp.func_native(native("sweep_in_registers"))
def sweep_in_registers(matrix: wp.array3d[wp.float64], world: int):
    """Overwrite the lower triangle of a world's matrix of at most 192 rows with minus its inverse, by symmetric sweeps.
    Each of 300 threads has eight by eight entries of it in registers.
    """
    ...


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=SWEEPERS)
def invert_in_registers(matrix: wp.array3d[wp.float64]):
    """Do the same as ``invert_dense`` on CUDA, with a block of SWEEPERS threads for each world."""
    sweep_in_registers(matrix, wp.tid() / wp.block_dim())


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
def apply_dense(level: LevelArrays, inverse: wp.array3d[float], z: wp.array[wp.vec4]):
    """z = inverse r."""
    world, thread = wp.tid()
    i, lane = thread / level.lanes, thread % level.lanes
    total = wp.vec3()
    for j in range(lane, level.count, level.lanes):
        value = load_node(level.r, world * level.count + j)
        for a in range(3):
            for b in range(3):
                total[a] += inverse[world, 3 * i + a, 3 * j + b] * value[b]
    total = sum_over_lanes(total, level.lanes)
    if lane == 0:
        store_node(z, world * level.count + i, total)
