"""What a plan of a forest that changes needs besides: whether it is derived again, the data of its leaves, and groups
of the leaves in no subtree; ``discretization.groups`` says what a group is.

Counts of ungrouped leaves climb the tree from all leaves at once. At each element the second of its two children to
arrive goes on with the sum, and where that is large enough the element makes a group and nothing goes on. Which child
arrives last changes nothing, and members are put in tree order, so that groups do not depend on the order of threads
but for their numbers."""

import warp as wp

from warp_corot.kernels.plan.plan import TORN, Plan, Tree, extent, flat_row, leaf_row
from warp_corot.kernels.remesh.pools import ADDED, LEAVES, REMOVED, UNUSED, Pools

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def begin_plan(
    # In
    pools: Pools,
    # In and out
    plan: Plan,
):
    plan.goes[0] = 0
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0 or plan.stale[0] != 0:
        plan.goes[0] = 1
        for row in range(plan.classes + 3):
            plan.before[row] = plan.counts[row]
        plan.counts[leaf_row(plan)] = pools.counts[LEAVES]
    plan.stale[0] = 0


@wp.kernel(enable_backward=False)
def begin_counts(
    # In
    goes: wp.array[wp.int32],
    # Out
    found: wp.array[wp.int32],
):
    """Reset the counts if they will be counted again."""
    if goes[0] != 0:
        found[wp.tid()] = 0


@wp.kernel(enable_backward=False)
def gather_leaves(
    # In
    threads: int,
    pools: Pools,
    tree: Tree,
    carried_values: wp.array2d[wp.float32],
    # In and out
    plan: Plan,
):
    """Data of leaves by their places in the list; values of padding are zero."""
    for i in range(wp.tid(), extent(leaf_row(plan), plan), threads):
        if i < pools.counts[LEAVES]:
            e = pools.leaves[i]
            plan.code[i] = pools.code[e]
            for c in range(plan.values.shape[0]):
                plan.values[c, i] = carried_values[e, c]
        else:
            plan.code[i] = tree.padding_code
            if plan.rotation_level >= 0:
                plan.unit[i] = 0
            for c in range(plan.values.shape[0]):
                plan.values[c, i] = 0.0


#: Leaves that make a group below an element of the tree, and in what is left of a root.
LEAST = wp.constant(8)
LEAST_OF_ROOT = wp.constant(4)
#: Added to a tally by each child that arrives: more than its leaves.
ARRIVED = wp.constant(16)


@wp.struct
class Groups:
    """Groups of leaves, with what finds them; places for as many groups as there may be leaves."""

    count: wp.array[wp.int32]  # [1] how many groups there are
    starts: wp.array[wp.int32]  # [groups + 1] where in ``members`` each begins
    members: wp.array[wp.int32]  # the leaves' places in the mesh
    size: wp.array[wp.int32]  # [groups + 1] one place ahead: its sums are the starts
    filled: wp.array[wp.int32]  # [groups] how many members are in place
    # Of each tetrahedron of the pool: arrivals and ungrouped leaves; the group that it makes, from 1.
    tally: wp.array[wp.int32]
    makes: wp.array[wp.int32]
    is_flat: wp.array[wp.int32]  # whether it is a leaf in no subtree
    # The same of the cubes, which join what is left of their roots, and the cube of each root.
    cube_tally: wp.array[wp.int32]
    cube_makes: wp.array[wp.int32]
    cube_of_root: wp.array[wp.int32]


@wp.kernel
def begin_groups(
    # In
    pools: Pools,
    plan: Plan,
    # Out
    groups: Groups,
):
    """A thread a tetrahedron, of the pool, a cube or a group."""
    if plan.goes[0] == 0:
        return
    i = wp.tid()
    if i == 0:
        groups.count[0] = 0
        groups.size[0] = 0
    if i < groups.tally.shape[0]:
        groups.tally[i] = 0
        groups.makes[i] = 0
        groups.is_flat[i] = 0
    if i < groups.cube_tally.shape[0]:
        groups.cube_tally[i] = 0
        groups.cube_makes[i] = 0
    if i < groups.filled.shape[0]:
        groups.size[i + 1] = 0
        groups.filled[i] = 0


@wp.kernel
def mark_flat(
    # In
    pools: Pools,
    plan: Plan,
    # Out
    groups: Groups,
):
    """A thread a leaf in no subtree."""
    k = wp.tid()
    if plan.goes[0] != 0 and k < plan.counts[flat_row(plan)]:
        groups.is_flat[pools.leaves[plan.flat[k]]] = 1


@wp.kernel
def climb(
    # In
    pools: Pools,
    plan: Plan,
    # In and out
    groups: Groups,
):
    """A thread a tetrahedron of the pool; those without children begin."""
    e = wp.tid()
    if plan.goes[0] == 0 or pools.level[e] == UNUSED or pools.first_child[e] >= 0:
        return
    left = groups.is_flat[e]
    while pools.parent[e] >= 0:
        if left > 0 and pools.cut[pools.parent[e]] >= TORN:
            # No group goes across a cut.
            groups.makes[e] = 1 + wp.atomic_add(groups.count, 0, 1)
            left = 0
        e = pools.parent[e]
        former = wp.atomic_add(groups.tally, e, ARRIVED + left)
        if former == 0:
            return
        left += former - ARRIVED
        if left >= LEAST:
            groups.makes[e] = 1 + wp.atomic_add(groups.count, 0, 1)
            left = 0
    if left >= LEAST_OF_ROOT:
        groups.makes[e] = 1 + wp.atomic_add(groups.count, 0, 1)
    elif left > 0:
        wp.atomic_add(groups.cube_tally, groups.cube_of_root[e], left)


@wp.kernel
def number_cubes(
    # In
    plan: Plan,
    # In and out
    groups: Groups,
):
    """A thread a cube."""
    c = wp.tid()
    if plan.goes[0] != 0 and groups.cube_tally[c] > 0:
        groups.cube_makes[c] = 1 + wp.atomic_add(groups.count, 0, 1)


@wp.func
def group_of(i: int, pools: Pools, groups: Groups):
    """The group of the i-th leaf."""
    e = pools.leaves[i]
    while groups.makes[e] == 0 and pools.parent[e] >= 0:
        e = pools.parent[e]
    if groups.makes[e] != 0:
        return groups.makes[e] - 1
    return groups.cube_makes[groups.cube_of_root[e]] - 1


@wp.kernel
def count_members(
    # In
    pools: Pools,
    plan: Plan,
    # In and out
    groups: Groups,
):
    """A thread a leaf in no subtree."""
    k = wp.tid()
    if plan.goes[0] != 0 and k < plan.counts[flat_row(plan)]:
        wp.atomic_add(groups.size, group_of(plan.flat[k], pools, groups) + 1, 1)


@wp.kernel
def place_members(
    # In
    pools: Pools,
    plan: Plan,
    # In and out
    groups: Groups,
):
    """A thread a leaf in no subtree."""
    k = wp.tid()
    if plan.goes[0] != 0 and k < plan.counts[flat_row(plan)]:
        i = plan.flat[k]
        g = group_of(i, pools, groups)
        groups.members[groups.starts[g] + wp.atomic_add(groups.filled, g, 1)] = i


@wp.kernel
def order_members(
    # In
    plan: Plan,
    # In and out
    groups: Groups,
):
    """A thread a group."""
    g = wp.tid()
    if plan.goes[0] == 0 or g >= groups.count[0]:
        return
    members = groups.members
    for end in range(groups.starts[g] + 1, groups.starts[g + 1]):
        i = members[end]
        place = end
        while place > groups.starts[g]:
            if members[place - 1] < i:
                break
            members[place] = members[place - 1]
            place -= 1
        members[place] = i
