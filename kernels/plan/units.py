"""The elements whose rotations are found if leaves share them: the units of a plan (``plan``), in tree order.

A unit is the highest tetrahedron above a leaf that is not above the rotation level and whose corners are nodes. The
leaves of a unit are contiguous.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK

from .plan import Plan, extent, flat_row, level_of
from .tree import Tree, code_above, element_of, is_torn, padding, parent_of, which_child

wp.set_module_options({"enable_backward": False})


@wp.func
def on_nodes(e: int, tree: Tree):
    """Whether all corners are nodes of leaves, the same of all: not on the rim of a domain's mesh, nor at a cut."""
    if is_torn(e, tree):
        return False
    if tree.named != 0:
        return True
    tet = tree.tets[e]
    return wp.max(wp.max(tet[0], tet[1]), wp.max(tet[2], tet[3])) < tree.node_count[0]


@wp.func
def begins_unit(i: int, tree: Tree, plan: Plan):
    """Whether leaf i has a different unit from the one before it.

    They share one if a common ancestor that is not above the level stands on nodes.
    """
    limit = plan.rotation_level
    if plan.rotation_level < 0:
        return False
    if i == 0 or wp.min(level_of(i, plan), level_of(i - 1, plan)) <= limit:
        return True
    a = element_of(i - 1, tree)
    b = element_of(i, tree)
    level_a = level_of(i - 1, plan)
    level_b = level_of(i, plan)
    # Elements of different levels may have the same number in a uniform tree.
    while (a != b or level_a != level_b) and (level_a > limit or level_b > limit):
        if level_a >= level_b:
            a = parent_of(a, tree)
            level_a -= 1
        else:
            b = parent_of(b, tree)
            level_b -= 1
    if a != b:
        return True
    while not on_nodes(a, tree) and level_a > limit:
        a = parent_of(a, tree)
        level_a -= 1
    return not on_nodes(a, tree)


@wp.func
def list_unit(k: int, i: int, tree: Tree, plan: Plan):
    """Write the unit of leaf i, the first of its leaves, to place k.

    It is the highest tetrahedron above the leaf, or the leaf, that is not above the rotation level and stands on nodes.
    """
    code = plan.code[i]
    e = element_of(i, tree)
    unit = int(e)
    climbed_code = int(code)
    while (climbed_code & LEVEL_MASK) > plan.rotation_level:
        climbed_code = code_above(climbed_code, which_child(e, tree), tree)
        e = parent_of(e, tree)
        if on_nodes(e, tree):
            unit = e
            code = climbed_code
    plan.unit_code[k] = code
    if tree.uniform == 0:
        plan.unit_nodes[k] = tree.tets[unit]
    else:
        nodes = wp.vec4i(0)
        for n in range(4):
            nodes[n] = tree.leaf_tets[i + tree.corner_leaves[n]][tree.corner_nodes[n]]
        plan.unit_nodes[k] = nodes


@wp.kernel(enable_backward=False)
def pad_units(
    # In
    threads: int,
    tree: Tree,
    # In and out
    plan: Plan,
):
    """Write padding to the first place, and after the units."""
    row = flat_row(plan) + 1
    count = plan.counts[row]
    for k in range(count + wp.tid(), extent(row, plan) + 1, threads):
        place = wp.where(k == count, 0, k)
        plan.unit_nodes[place] = padding(place, tree)
        plan.unit_code[place] = tree.padding_code


@wp.kernel(enable_backward=False)
def repeat_units(
    # In and out
    plan: Plan,
):
    """Units of the first world for the others too."""
    world, i = wp.tid()
    if i < plan.world_leaves:
        plan.unit[(world + 1) * plan.world_leaves + i] = plan.unit[i] + (world + 1) * plan.world_units
    if i < plan.world_units:
        k = (world + 1) * plan.world_units + i
        shift = (world + 1) * plan.world_nodes
        plan.unit_nodes[k] = plan.unit_nodes[i] + wp.vec4i(shift, shift, shift, shift)
        plan.unit_code[k] = plan.unit_code[i]
