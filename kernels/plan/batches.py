"""The arrays that launches read of a plan (``plan``): nodes and codes of subtrees and of single leaves.

Everything is written up to the current size, for each world, and as padding up to the former size. Padding refers to
sinks, nodes that do not move.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.tables.shapes import MIRROR_BIT

from .plan import LEAVES_OF_SUBTREE, SINKS, Plan, Tree, code_above, extent, flat_row, places_t, sink

wp.set_module_options({"enable_backward": False})

# Nodes of a single subtree; places for nodes of a group.
SINGLE_NODES = 10
GROUP_NODES = 40


@wp.struct
class Batches:
    """Arrays of subtrees, class after class."""

    # The leaf of the subtree, or of the group, and its node for each place, by shape; negative past the last.
    places: wp.array2d[wp.vec2i]  # [3, 10]
    group_places: wp.array2d[wp.vec2i]  # [3, 40]
    # Nodes of a class begin at a place: [groups, 40] for groups; for single subtrees [10, room], or [room, 10] if
    # ``by_node`` is zero.
    by_node: int
    node_begin: places_t
    room: places_t
    nodes: wp.array[wp.int32]
    # As ``Plan.first``.
    code: wp.array[wp.int32]  # of the root
    unit: wp.array[wp.int32]  # used by the leaves, if a rotation further up is shared


@wp.struct
class FlatLeaves:
    """Leaves in no subtree as general elements, and the tables from which these come; empty on CUDA."""

    nodes: wp.array[wp.vec4i]
    rest_inverse: wp.array[wp.mat33]
    volume: wp.array[wp.float32]
    inverse_of: wp.array[wp.mat33]  # [3 * n] by type and frame, of level 0 to 2
    volume_of: wp.array[wp.float32]  # by level


@wp.func
def kind_of_class(c: int, plan: Plan):
    """Shape and sharing of a class; see ``plan.kind_of``."""
    return c / plan.members


@wp.func
def shape_of_kind(kind: int, plan: Plan):
    shape = int(kind)
    if kind == 3:
        shape = plan.rotation_level % 3
    elif kind > 3:
        shape = kind - 4
    return shape


@wp.func
def is_grouped(c: int, plan: Plan):
    return plan.members == 2 and c % 2 == 0


@wp.func
def node_count(c: int, plan: Plan):
    """How many nodes of a class go with each of its subtrees: its own, or an eighth of its group's."""
    return wp.where(is_grouped(c, plan), GROUP_NODES / 8, SINGLE_NODES)


@wp.func
def node_place(c: int, k: int, n: int, plan: Plan, batches: Batches):
    """The place of the n-th node that goes with the k-th subtree of a class."""
    if batches.by_node != 0 and not is_grouped(c, plan):
        return batches.node_begin[c] + n * batches.room[c] + k
    return batches.node_begin[c] + node_count(c, plan) * k + n


@wp.func
def fill_nodes(c: int, shape: int, k: int, first: int, shift: int, tree: Tree, plan: Plan, batches: Batches):
    """Nodes that go with the k-th subtree of a class; ``first`` is its first leaf, or its group's, -1 for padding."""
    for n in range(node_count(c, plan)):
        place = batches.places[shape, n % SINGLE_NODES]
        if is_grouped(c, plan):
            place = batches.group_places[shape, 5 * (k % 8) + n]
        node = wp.where(place[0] < 0, -1, sink(k, tree))
        if place[0] >= 0 and first >= 0:
            node = tree.leaf_tets[first + place[0]][place[1]] + shift
        batches.nodes[node_place(c, k, n, plan, batches)] = node


@wp.kernel(enable_backward=False)
def fill_batches(
    # In
    threads: int,
    tree: Tree,
    # In and out
    plan: Plan,
    # Out
    batches: Batches,
):
    """Fill one class with each row of threads."""
    c, t = wp.tid()
    kind = kind_of_class(c, plan)
    shape = shape_of_kind(kind, plan)
    places = extent(c, plan)
    begin = plan.begin[c]
    for k in range(t, plan.worlds * places, threads):
        world = k / places
        in_world = k - world * places
        shift = world * plan.world_nodes
        place = begin + k
        first = int(-1)
        code = tree.padding_code
        if in_world < plan.counts[c]:
            first = plan.first[begin + in_world]
            code = plan.code[first]
            for _ in range(3):
                code = code_above(code, 0, tree)
            if kind > 3:
                batches.unit[place] = plan.unit[first] + world * plan.world_units
            if world > 0:
                plan.first[place] = first + world * plan.world_leaves
        else:
            plan.first[place] = 0
            if kind > 3:
                batches.unit[place] = 0
        batches.code[place] = code
        if first >= 0 and is_grouped(c, plan):
            first -= LEAVES_OF_SUBTREE * (in_world % 8)
        fill_nodes(c, shape, k, first, shift, tree, plan, batches)


@wp.kernel(enable_backward=False)
def fill_flat(
    # In
    threads: int,
    tree: Tree,
    # In and out
    plan: Plan,
    # Out
    leaves: FlatLeaves,
):
    """List the leaves in no subtree of all worlds but the first, and padding; and fill them in on the CPU."""
    row = flat_row(plan)
    places = extent(row, plan)
    for k in range(wp.tid(), plan.worlds * places, threads):
        world = k / places
        in_world = k - world * places
        # Padding refers to the last leaves, which are always padding.
        i = tree.leaf_tets.shape[0] - SINKS + k % SINKS
        if in_world < plan.counts[row]:
            i = plan.flat[in_world] + world * plan.world_leaves
        if world > 0 or in_world >= plan.counts[row]:
            plan.flat[k] = i
        if leaves.nodes.shape[0] > 0:
            code = plan.code[i]
            level = code & LEVEL_MASK
            # An edge is halved every three levels: exact, and much less work than to compute it again.
            halved = float(1 << (level / 3))
            leaves.nodes[k] = tree.leaf_tets[i]
            leaves.rest_inverse[k] = halved * leaves.inverse_of[3 * (code >> MIRROR_BIT) + level % 3]
            leaves.volume[k] = leaves.volume_of[level]
