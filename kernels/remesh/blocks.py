"""The blocks of the list of leaves that contain an edge, so that a round visits few of them.

Consecutive leaves in tree order are close in space, so a node is named in only a few blocks of the list.
"""

import warp as wp

from .pools import BIRTHS, LEAVES, NODE_TOP, STAMP, Pools

wp.set_module_options({"enable_backward": False})

#: Leaves in a block, and those that one thread visits.
BLOCK = wp.constant(512)
STRETCH = wp.constant(16)
#: Number of blocks that are kept for a node. For a node in more blocks, the last entry says so.
KEPT = 8
LAST = wp.constant(KEPT - 1)
NONE = wp.constant(-1)
MORE = wp.constant(-2)


@wp.struct
class Blocks:
    """The blocks that name each node, in the list at the beginning of the pass."""

    of_node: wp.array2d[wp.int32]  # [nodes, KEPT]
    latest: wp.array[wp.int32]
    hot: wp.array[wp.int32]  # the last round in which an edge in the block became wanted
    all_hot: wp.array[wp.int32]  # [1] the same for an edge whose blocks are not known


@wp.func
def add_block(node: int, block: int, blocks: Blocks):
    # Usually it is the one that was added last.
    if blocks.latest[node] == block:
        return
    blocks.latest[node] = block
    for n in range(LAST):
        before = wp.atomic_cas(blocks.of_node, node, n, NONE, block)
        if before == NONE or before == block:
            return
    blocks.of_node[node, LAST] = MORE


@wp.kernel(enable_backward=False)
def clear_blocks(
    # In
    threads: int,
    pools: Pools,
    # Out
    blocks: Blocks,
):
    count = pools.counts[NODE_TOP]
    if pools.counts[BIRTHS] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        blocks.latest[i] = NONE
        for n in range(KEPT):
            blocks.of_node[i, n] = NONE


@wp.kernel(enable_backward=False)
def list_blocks(
    # In
    threads: int,
    pools: Pools,
    # In and out
    blocks: Blocks,
):
    """List the blocks of nodes, if any edge is wanted."""
    count = pools.counts[LEAVES]
    if pools.counts[BIRTHS] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        tet = pools.leaf_tets[i]
        for n in range(4):
            add_block(tet[n], i // BLOCK, blocks)


@wp.func
def heat_blocks(a: int, b: int, stamp: int, first_new: int, blocks: Blocks):
    """Mark the blocks that name both ends of an edge; nodes made in this pass are in none."""
    if a >= first_new or b >= first_new:
        return
    more_a = blocks.of_node[a, LAST] == MORE
    more_b = blocks.of_node[b, LAST] == MORE
    if more_a and more_b:
        blocks.all_hot[0] = stamp
        return
    one = int(a)
    other = int(b)
    if more_a:
        one = b
        other = a
    for n in range(LAST):
        block = blocks.of_node[one, n]
        if block != NONE:
            found = more_a or more_b
            for m in range(LAST):
                if blocks.of_node[other, m] == block:
                    found = True
            if found:
                blocks.hot[block] = stamp


@wp.func
def is_hot(i: int, pools: Pools, blocks: Blocks):
    """Whether an edge in the i-th leaf's block became wanted in the last round, or in this one."""
    since = pools.counts[STAMP] - 1
    return blocks.hot[i // BLOCK] >= since or blocks.all_hot[0] >= since
