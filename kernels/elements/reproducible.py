"""Sums of forces in one order, in whatever order threads run.

Atomic sums differ a little from run to run. Here each unit of work (an element, a subtree, a group of subtrees) has a
slot of its own for each of its nodes, and a node adds up its slots. Slots stand in the order of the units, because
scattered writes cost five times as much as scattered reads.
"""

import warp as wp

from .elements import load_node, store_node

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def gather_slots(
    # In
    starts: wp.array[wp.int32],
    order: wp.array[wp.int32],
    clears: int,
    # In and out
    slots: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add each node's slots to its force; then they are zero if this ``clears`` them."""
    i = wp.tid()
    total = load_node(f, i)
    for at in range(starts[i], starts[i + 1]):
        total += load_node(slots, order[at])
        if clears != 0:
            store_node(slots, order[at], wp.vec3())
    store_node(f, i, total)
