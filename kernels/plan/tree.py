"""The leaves of a forest and the tetrahedra above them, as kernels that derive a plan read them.

A forest that changes is in pools, any other in a tree; both are read in place. If all leaves have one level, nothing
above them is stored: the elements of a level are then numbered in tree order, each level from zero.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.tables.shapes import FRAME_SHIFT

#: Number of places past the last node that padding names in turn, so that additions to them seldom collide.
SINKS = wp.constant(1024)
#: Bits of ``Tree.cut`` and ``Pools.cut``: n of a leaf for its face opposite to node n; this one of an element whose
#: leaves do not agree on the nodes that they share.
TORN = wp.constant(16)


@wp.struct
class Tree:
    """The leaves in tree order, and the tetrahedra above them."""

    leaf_count: wp.array[wp.int32]  # [1]
    node_count: wp.array[wp.int32]  # [1] nodes that leaves name: all lower numbers
    named: int  # 1: leaves name all nodes
    leaf_tets: wp.array[wp.vec4i]  # nodes of the leaves in Maubach order
    uniform: int  # 1: all leaves have one level; the arrays of elements are empty then, and roots is zero
    roots: int  # roots come first, then pairs of children
    leaves: wp.array[wp.int32]  # the leaves' places among the elements
    # Elements: parents, and nodes in Maubach order.
    parent: wp.array[wp.int32]
    tets: wp.array[wp.vec4i]
    cut: wp.array[wp.int32]  # as ``Pools.cut``; empty if nothing was ever cut
    # In a uniform tree, for the corners of a unit: the leaf counted from its first one, and the leaf's node.
    corner_leaves: wp.vec4i
    corner_nodes: wp.vec4i
    # Codes without level of the parent of an element, by the element's frame and type, and first or second child.
    parent_code: wp.array3d[wp.int32]
    # What padding has: a first node, and a code.
    sink: int
    padding_code: int


@wp.func
def sink(i: int, tree: Tree):
    """The node of the i-th padding entry."""
    return tree.sink + i % SINKS


@wp.func
def padding(i: int, tree: Tree):
    """The nodes of the i-th padding entry."""
    node = sink(i, tree)
    return wp.vec4i(node, node, node, node)


@wp.func
def element_of(i: int, tree: Tree):
    """The element that is leaf i."""
    if tree.uniform != 0:
        return i
    return tree.leaves[i]


@wp.func
def parent_of(e: int, tree: Tree):
    if tree.uniform != 0:
        return e >> 1
    return tree.parent[e]


@wp.func
def above(e: int, steps: int, tree: Tree):
    """The ancestor so many levels up."""
    if tree.uniform != 0:
        return e >> steps
    found = int(e)
    for _ in range(steps):
        found = tree.parent[found]
    return found


@wp.func
def is_torn(e: int, tree: Tree):
    """Whether the leaves below an element do not agree on the nodes that they share, because of a cut."""
    if tree.cut.shape[0] == 0:
        return False
    return tree.cut[e] >= TORN


@wp.func
def which_child(e: int, tree: Tree):
    """0 for the first child of a parent, 1 for the second."""
    return (e - tree.roots) & 1


@wp.func
def code_above(code: int, which: int, tree: Tree):
    """The code of the parent of an element with a code, its first or second child."""
    level = code & LEVEL_MASK
    return tree.parent_code[code >> FRAME_SHIFT, level % 3, which] | (level - 1)
