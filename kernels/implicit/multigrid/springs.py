"""Springs at places between nodes in the matrices of all levels.

Up to four nodes of an element bear a place. On a coarser level these are interpolated from the corners of the
element's ancestor, so there again at most four nodes bear it, and a spring adds to entries that the matrix has.
"""

import warp as wp

from .pattern import place_of
from .values import inverse_block

wp.set_module_options({"enable_backward": False})


@wp.struct
class SpringRows:
    """Springs on one level, [S]. Numbers of nodes and entries count all worlds."""

    nodes: wp.array[wp.vec4i]  # the level's nodes that bear the place; -1: none
    weights: wp.array[wp.vec4]
    entries: wp.array2d[wp.int32]  # [S, 16] where they meet in the matrix; -1: nowhere. Empty without a matrix


@wp.struct
class LevelMatrix:
    """A level's matrix and smoother, and both without springs."""

    blocks: wp.array[wp.mat33]
    plain_blocks: wp.array[wp.mat33]
    inverses: wp.array[wp.mat33]
    plain_inverses: wp.array[wp.mat33]
    added: wp.array[wp.mat33]  # of springs to the diagonal, by node


@wp.kernel(enable_backward=False)
def find_spring_nodes(
    # In
    mesh_nodes: int,
    ranks: int,
    count: int,
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    rank: wp.array[wp.int32],
    ends: wp.array[wp.vec2i],
    # Out
    rows: SpringRows,
):
    """Replace the newest node of each place by its two ends, until all are among the first ``count``."""
    s = wp.tid()
    found = wp.vec4i(-1, -1, -1, -1)
    shares = wp.vec4()
    world = int(0)
    for k in range(4):
        if nodes[s][k] >= 0 and weights[s][k] != 0.0:
            world = nodes[s][k] / mesh_nodes
            found[k] = rank[nodes[s][k] - world * mesh_nodes]
            shares[k] = weights[s][k]
    while True:
        newest = int(0)
        for k in range(1, 4):
            if found[k] > found[newest]:
                newest = k
        i = found[newest]
        if i < count:
            break
        half = 0.5 * shares[newest]
        found[newest] = -1
        shares[newest] = 0.0
        for side in range(2):
            end = ends[i][side]
            at = int(-1)
            for k in range(4):
                if found[k] == end or (at < 0 and found[k] < 0):
                    at = k
            # There is always a place: all are corners of one ancestor.
            found[at] = end
            shares[at] = shares[at] + half
    for k in range(4):
        if found[k] >= 0:
            found[k] = world * count + found[k]
    rows.nodes[s] = found
    rows.weights[s] = shares


@wp.kernel(enable_backward=False)
def find_spring_entries(
    count: int, entries: int, starts: wp.array[wp.int32], columns: wp.array[wp.int32], rows: SpringRows
):
    """Where each two nodes of a place meet in the matrix."""
    s = wp.tid()
    nodes = rows.nodes[s]
    for a in range(4):
        for b in range(4):
            found = int(-1)
            if nodes[a] >= 0 and nodes[b] >= 0:
                world = nodes[a] / count
                i = nodes[a] - world * count
                j = nodes[b] - world * count
                p = place_of(i, j, starts, columns)
                if p >= 0:
                    found = world * entries + p
            rows.entries[s, 4 * a + b] = found


@wp.func
def is_spring(s: int, stiffness: wp.array[wp.mat33]):
    return wp.trace(stiffness[s]) > 0.0


@wp.kernel(enable_backward=False)
def remove_springs(before: wp.array[wp.mat33], rows: SpringRows, matrix: LevelMatrix):
    """Put back the entries that the springs of a former stiffness have changed."""
    s = wp.tid()
    if not is_spring(s, before):
        return
    nodes = rows.nodes[s]
    for k in range(rows.entries.shape[1]):
        p = rows.entries[s, k]
        if p >= 0:
            matrix.blocks[p] = matrix.plain_blocks[p]
    for k in range(4):
        if nodes[k] >= 0:
            matrix.inverses[nodes[k]] = matrix.plain_inverses[nodes[k]]
            matrix.added[nodes[k]] = wp.mat33()


@wp.kernel(enable_backward=False)
def add_springs(stiffness: wp.array[wp.mat33], rows: SpringRows, matrix: LevelMatrix):
    """Add springs to the matrix. Held nodes have no entries: their inverses are zero."""
    s = wp.tid()
    if not is_spring(s, stiffness):
        return
    k = stiffness[s]
    nodes = rows.nodes[s]
    w = rows.weights[s]
    for a in range(4):
        if nodes[a] >= 0 and wp.trace(matrix.plain_inverses[nodes[a]]) > 0.0:
            wp.atomic_add(matrix.added, nodes[a], (w[a] * w[a]) * k)
            if rows.entries.shape[1] > 0:
                for b in range(4):
                    p = rows.entries[s, 4 * a + b]
                    if p >= 0 and wp.trace(matrix.plain_inverses[nodes[b]]) > 0.0:
                        wp.atomic_add(matrix.blocks, p, (w[a] * w[b]) * k)


@wp.kernel(enable_backward=False)
def invert_with_springs(stiffness: wp.array[wp.mat33], rows: SpringRows, matrix: LevelMatrix):
    """The smoother's inverses with springs: (B^-1 + what springs add)^-1 of B without them."""
    s = wp.tid()
    if not is_spring(s, stiffness):
        return
    nodes = rows.nodes[s]
    for k in range(4):
        i = nodes[k]
        if i >= 0:
            matrix.inverses[i] = inverse_block(inverse_block(matrix.plain_inverses[i]) + matrix.added[i])
