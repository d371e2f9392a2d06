"""The arrays that launches read of a derived plan (``plan``): nodes and codes of subtrees and of single leaves.

Everything is written up to the current size, and as padding up to the former size. Padding refers to
sinks, nodes that do not move.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.remesh.pools import SINKS, Pools, padding
from warp_corot.kernels.tables.shapes import MIRROR_BIT

from .lists import LEAVES_OF_SUBTREE
from .plan import Plan, above, extent, flat_row, padding_code


@wp.struct
class Batches:
    """Arrays by class, or by kind (shape and sharing) if only groups or only single subtrees have them."""

    # The leaf of the subtree, or of the group, and its node for each place, by shape; negative past the last.
    places: wp.array2d[wp.vec2i]  # [3, 10]
    group_places: wp.array2d[wp.vec2i]  # [3, 40]
    by_node: int  # 1: nodes of single subtrees are [10, subtrees], else [subtrees, 10]
    nodes: wp.array3d[wp.int32]  # [kinds, 10, subtrees]
    group_nodes: wp.array3d[wp.int32]  # [kinds, groups, 40]
    code: wp.array2d[wp.int32]  # [classes, subtrees] of the root
    root_nodes: wp.array2d[wp.vec4i]  # [members, subtrees] of those that share their root's rotation
    unit: wp.array2d[wp.int32]  # [classes, subtrees] used by the leaves, if a rotation further up is shared


@wp.struct
class FlatLeaves:
    """Leaves in no subtree, as single elements."""

    nodes: wp.array[wp.vec4i]
    code: wp.array[wp.int32]
    unit: wp.array[wp.int32]
    # Their Lamé parameters if these vary, and their rows in ``Plan.values``; else -1.
    mu: wp.array[wp.float32]
    lam: wp.array[wp.float32]
    mu_row: int
    lam_row: int
    # Data of general elements, on the CPU, and the tables from which they come.
    rest_inverse: wp.array[wp.mat33]
    volume: wp.array[wp.float32]
    inverse_of: wp.array[wp.mat33]  # [3 * n] by type and frame, of level 0 to 2
    volume_of: wp.array[wp.float32]  # by level


@wp.func
def sink(i: int, pools: Pools):
    return pools.sink + i % SINKS


@wp.func
def fill_single(kind: int, shape: int, k: int, first: int, pools: Pools, batches: Batches):
    """Nodes of the k-th single subtree of a kind; ``first`` is its first leaf, -1 for padding."""
    for n in range(10):
        node = sink(k, pools)
        if first >= 0:
            place = batches.places[shape, n]
            node = pools.leaf_tets[first + place[0]][place[1]]
        if batches.by_node != 0:
            batches.nodes[kind, n, k] = node
        else:
            batches.nodes[kind, k, n] = node


@wp.func
def fill_share(kind: int, shape: int, k: int, first: int, pools: Pools, batches: Batches):
    """Five nodes of the group with the k-th subtree of a kind; ``first`` is the group's first leaf, or -1."""
    for n in range(5):
        m = 5 * (k % 8) + n
        node = sink(k, pools)
        if first >= 0:
            place = batches.group_places[shape, m]
            node = int(-1)
            if place[0] >= 0:
                node = pools.leaf_tets[first + place[0]][place[1]]
        elif batches.group_places[shape, m][0] < 0:
            node = int(-1)
        batches.group_nodes[kind, k / 8, m] = node


@wp.kernel(enable_backward=False)
def fill_batches(
    # In
    threads: int,
    pools: Pools,
    # In and out
    plan: Plan,
    # Out
    batches: Batches,
):
    """Fill one class with each row of threads."""
    c, t = wp.tid()
    kind = c / plan.members
    grouped = plan.members == 2 and c % 2 == 0
    shape = kind
    if kind == 3:
        shape = plan.rotation_level % 3
    elif kind > 3:
        shape = kind - 4
    for k in range(t, extent(c, plan), threads):
        first = int(-1)
        code = padding_code(pools)
        if k < plan.counts[c]:
            first = plan.first[c, k]
            root = above(pools.leaves[first], 3, pools)
            code = pools.code[root]
            if kind == 3:
                batches.root_nodes[c % plan.members, k] = pools.tets[root]
            elif kind > 3:
                batches.unit[c, k] = plan.unit[first]
        else:
            plan.first[c, k] = 0
            if kind == 3:
                batches.root_nodes[c % plan.members, k] = padding(k, pools)
            elif kind > 3:
                batches.unit[c, k] = 0
        batches.code[c, k] = code
        if not grouped:
            fill_single(kind, shape, k, first, pools, batches)
        else:
            if first >= 0:
                first -= LEAVES_OF_SUBTREE * (k % 8)
            fill_share(kind, shape, k, first, pools, batches)


@wp.kernel(enable_backward=False)
def fill_flat(
    # In
    threads: int,
    pools: Pools,
    # In and out
    plan: Plan,
    # Out
    leaves: FlatLeaves,
):
    """Fill the leaves in no subtree."""
    row = flat_row(plan)
    for k in range(wp.tid(), extent(row, plan), threads):
        nodes = padding(k, pools)
        code = padding_code(pools)
        unit = int(0)
        mu = float(0.0)
        lam = float(0.0)
        if k < plan.counts[row]:
            i = plan.flat[k]
            nodes = pools.leaf_tets[i]
            code = plan.code[i]
            if plan.rotation_level >= 0:
                unit = plan.unit[i]
            if leaves.mu_row >= 0:
                mu = plan.values[leaves.mu_row, i]
                lam = plan.values[leaves.lam_row, i]
        else:
            plan.flat[k] = 0
        leaves.nodes[k] = nodes
        leaves.code[k] = code
        if plan.rotation_level >= 0:
            leaves.unit[k] = unit
        if leaves.mu_row >= 0:
            leaves.mu[k] = mu
            leaves.lam[k] = lam
        if leaves.volume.shape[0] > 0:
            level = code & LEVEL_MASK
            # An edge is halved every three levels: exact, and much less work than to compute it again.
            halved = float(1 << (level / 3))
            leaves.rest_inverse[k] = halved * leaves.inverse_of[3 * (code >> MIRROR_BIT) + level % 3]
            leaves.volume[k] = leaves.volume_of[level]
