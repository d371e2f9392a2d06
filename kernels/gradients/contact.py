"""Linear systems whose unknowns keep to obstacles: vectors without the normals of contacts, and the turning of these.

A row is a contact: its normal times the share of each node that carries it. N has the rows as columns.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

wp.set_module_options({"enable_backward": False})


@wp.struct
class Rows:
    """Contacts of rows, and the same of nodes.

    Attributes:
        starts: Where the entries of each row begin, int32 [m + 1].
        nodes, parts: The node of each entry, and the normal times its share.
        touched: Nodes with entries, int32 [t]; node_starts, of_node: where their entries begin, int32 [t + 1], and
            which they are.
        row: The row of each entry.
        inverse: The inverse of N^T N, float64 [m, m].
        block_starts, block_nodes, blocks: The matrix that the turning of normals adds, by touched nodes [N/m].
    """

    starts: wp.array[wp.int32]
    nodes: wp.array[wp.int32]
    parts: wp.array[wp.vec3]
    touched: wp.array[wp.int32]
    node_starts: wp.array[wp.int32]
    of_node: wp.array[wp.int32]
    row: wp.array[wp.int32]
    inverse: wp.array2d[wp.float64]
    block_starts: wp.array[wp.int32]
    block_nodes: wp.array[wp.int32]
    blocks: wp.array[wp.mat33]


@wp.kernel(enable_backward=False)
def measure_rows(rows: Rows, x: wp.array[wp.vec4], along: wp.array[wp.float64]):
    """N^T x."""
    i = wp.tid()
    total = wp.float64(0.0)
    for k in range(rows.starts[i], rows.starts[i + 1]):
        part, value = rows.parts[k], load_node(x, rows.nodes[k])
        for axis in range(3):
            total += wp.float64(part[axis]) * wp.float64(value[axis])
    along[i] = total


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
    t = wp.tid()
    node = rows.touched[t]
    left = wp.vec3d(load_node(x, node))
    for at in range(rows.node_starts[t], rows.node_starts[t + 1]):
        k = rows.of_node[at]
        left -= shared[rows.row[k]] * wp.vec3d(rows.parts[k])
    store_node(x, node, wp.vec3(left))


@wp.kernel(enable_backward=False)
def add_turning(rows: Rows, x: wp.array[wp.vec4], y: wp.array[wp.vec4]):
    """y + G x, with the change G of the forces of contact as their normals turn."""
    t = wp.tid()
    node = rows.touched[t]
    sums = load_node(y, node)
    for k in range(rows.block_starts[t], rows.block_starts[t + 1]):
        sums += rows.blocks[k] * load_node(x, rows.block_nodes[k])
    store_node(y, node, sums)
