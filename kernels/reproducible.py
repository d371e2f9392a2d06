"""Sums of forces in one order, whatever order threads run in.

Atomic sums come out a little different every time. Here each unit of work (an element, a subtree, a group of subtrees)
has a slot of its own for each of its nodes, and a node adds up its slots, which stand next to one another.
"""

import warp as wp

from .elements import load_node, store_node

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def gather_slots(
    # In
    starts: wp.array[wp.int32],
    # In and out
    slots: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add each node's slots to its force and clear them for the next to add to."""
    i = wp.tid()
    total = load_node(f, i)
    for slot in range(starts[i], starts[i + 1]):
        total += load_node(slots, slot)
        store_node(slots, slot, wp.vec3())
    store_node(f, i, total)
