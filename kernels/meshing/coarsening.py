"""A coarser mesh from a forest: bisected again from the roots, where requested and where conformity requires it.

Everything that can be requested is in the forest: a conforming mesh that needs part of its tetrahedra needs no
bisections that the forest does not have. A tetrahedron must be bisected if it is requested, if a child of it
is bisected, and if another with the same refinement edge is; all its other edges are edges of its children. So one
sweep from the deepest level up gives for every tetrahedron the threshold up to which it is bisected.
"""

import warp as wp

from .bisection import refinement_end
from .growth import LIVE, VOID

wp.set_module_options({"enable_backward": False})

#: Value in place of a first child: below the mesh.
BELOW = wp.constant(-3)


@wp.func
def newest_node(element: int, tets: wp.array[wp.vec4i], level: wp.array[wp.int32], first_child: wp.array[wp.int32]):
    """The node at which an element was bisected."""
    return tets[first_child[element]][refinement_end(level[element])]


@wp.kernel(enable_backward=False)
def gather_needs(
    # In
    elements: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    first_child: wp.array[wp.int32],
    holds: wp.array[wp.uint8],
    # In and out
    needs: wp.array[wp.float32],
    of_node: wp.array[wp.float32],
):
    """Gather the needs of the bisected elements of one level, and pass them to the others around the edge."""
    element = elements[wp.tid()]
    below = first_child[element]
    need = wp.max(needs[element], wp.max(needs[below], needs[below + 1]))
    needs[element] = need
    if holds[element] != wp.uint8(0):
        wp.atomic_max(of_node, newest_node(element, tets, level, first_child), need)


@wp.kernel(enable_backward=False)
def take_needs(
    # In
    elements: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    level: wp.array[wp.int32],
    first_child: wp.array[wp.int32],
    of_node: wp.array[wp.float32],
    # In and out
    needs: wp.array[wp.float32],
):
    """Bisect an element if another around its refinement edge is bisected."""
    element = elements[wp.tid()]
    node = newest_node(element, tets, level, first_child)
    needs[element] = wp.max(needs[element], of_node[node])


@wp.kernel(enable_backward=False)
def cut_off(
    # In
    parent: wp.array[wp.int32],
    first_child: wp.array[wp.int32],
    needs: wp.array[wp.float32],
    least: float,
    holds: wp.array[wp.uint8],
    # Out
    child: wp.array[wp.int32],
):
    """The mesh of a threshold. An element outside the body is not bisected."""
    i = wp.tid()
    above = parent[i]
    found = BELOW
    if above < 0 or (holds[above] != wp.uint8(0) and needs[above] > least):
        found = VOID
        if holds[i] != wp.uint8(0):
            found = LIVE
            if needs[i] > least and first_child[i] >= 0:
                found = first_child[i]
    child[i] = found
