"""A force plan: its arrays, and what its kernels share; the leaves of a forest and the tetrahedra above them.

``lists`` finds the leaves in complete subtrees, the others, and the elements whose rotations are found; ``batches``
writes the arrays that launches read; ``slots`` numbers places for forces. A forest that stays as it is gets arrays of
exact sizes, for all worlds; one that changes (``changing``) gets arrays for its capacity.

A forest that changes is in pools, any other in a tree; both are read in place. If all leaves have one level, nothing
above them is stored: the elements of a level are then numbered in tree order, each level from zero."""

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


places_t = wp.types.vector(length=16, dtype=wp.int32)


@wp.struct
class Plan:
    """The derived arrays; those for the capacity have padding beyond the current size."""

    rotation_level: int  # -1: rotations are not shared
    with_subtrees: int  # 0: all leaves are computed one by one
    with_units: int  # 0: units are counted, but not listed
    members: int  # 2: groups and single subtrees; 1: there are no groups
    classes: int
    # Copies of the body, and the numbers of nodes, leaves and units in each.
    worlds: int
    world_nodes: int
    world_leaves: int
    world_units: int
    # Numbers for each class, for leaves in none, for units and for leaves; and the former numbers.
    counts: wp.array[wp.int32]
    before: wp.array[wp.int32]
    stale: wp.array[wp.int32]  # [1] nonzero: derive it even if the last pass changed nothing
    goes: wp.array[wp.int32]  # [1] whether it is derived at all
    # Leaves.
    code: wp.array[wp.int32]
    values: wp.array2d[wp.float32]  # [names, leaves]
    marks: wp.array[wp.int8]
    unit: wp.array[wp.int32]
    # First leaves of the subtrees, class after class, and the leaves in none.
    begin: places_t  # of each class
    first: wp.array[wp.int32]
    flat: wp.array[wp.int32]
    # Units. Where leaves may be padding the first place is padding for them, and units are counted from 1.
    first_unit: int
    unit_nodes: wp.array[wp.vec4i]
    unit_code: wp.array[wp.int32]


@wp.func
def flat_row(plan: Plan):
    """The row that counts leaves in no subtree; the next one counts units, then all leaves."""
    return plan.classes


@wp.func
def leaf_row(plan: Plan):
    """The row that counts all leaves."""
    return plan.classes + 2


@wp.func
def extent(row: int, plan: Plan):
    """Number of written places in a row, padding included; of one world."""
    if plan.goes[0] == 0:
        return 0
    return wp.max(plan.counts[row], plan.before[row])


@wp.func
def level_of(i: int, plan: Plan):
    return plan.code[i] & LEVEL_MASK
