"""Linear systems whose unknowns keep to obstacles: vectors without the normals of contacts, and the turning of these.

A row is a contact: its normal times the share of each node that carries it. N has the rows as columns.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node
from warp_corot.kernels.stepping.sums import dot64

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rows:
    """Entries of N and of the matrix G that the turning of normals adds, at free nodes.

    Attributes:
        row, node, part: The row and the node of each entry, and the normal times the node's share.
        inverse: The inverse of N^T N, float64 [m, m].
        first, second, block: The nodes of each 3x3 block of G, which may repeat, and the block [N/m].
    """

    row: wp.array[wp.int32]
    node: wp.array[wp.int32]
    part: wp.array[wp.vec3]
    inverse: wp.array2d[wp.float64]
    first: wp.array[wp.int32]
    second: wp.array[wp.int32]
    block: wp.array[wp.mat33]


@wp.kernel(enable_backward=False)
def measure_rows(rows: Rows, x: wp.array[wp.vec4], along: wp.array[wp.float64]):
    """Add N^T x."""
    k = wp.tid()
    wp.atomic_add(along, rows.row[k], dot64(rows.part[k], load_node(x, rows.node[k])))


@wp.kernel(enable_backward=False)
def share_rows(rows: Rows, along: wp.array[wp.float64], shared: wp.array[wp.float64]):
    """(N^T N)^-1 times what rows measured."""
    i = wp.tid()
    total = wp.float64(0.0)
    for j in range(along.shape[0]):
        total += rows.inverse[i, j] * along[j]
    shared[i] = total


@wp.kernel(enable_backward=False)
def remove_rows(rows: Rows, shared: wp.array[wp.float64], x: wp.array[wp.vec4]):
    """x - N times the rows' shares."""
    k = wp.tid()
    add_force(x, rows.node[k], -float(shared[rows.row[k]]) * rows.part[k])


@wp.kernel(enable_backward=False)
def add_turning(rows: Rows, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y + G x, with the change G of the forces of contact as their normals turn."""
    k = wp.tid()
    add_force(y, rows.first[k], rows.block[k] * load_node(x, rows.second[k]))
