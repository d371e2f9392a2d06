"""The nodes of a changing mesh that follow keyframes."""

import warp as wp

from .pools import NODE_TOP, Pools
from .state import MIXED_ROWS, NO_ROW, Carried

wp.set_module_options({"enable_backward": False})

#: Counts: nodes that follow keyframes, and those among them whose row is not known yet.
FOLLOWERS = wp.constant(0)
MIXED = wp.constant(1)
PLACES = 2


@wp.kernel(enable_backward=False)
def list_followers(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    pools: Pools,
    carried: Carried,
    # Out
    nodes: wp.array[wp.int32],
    rows: wp.array[wp.int32],
    found: wp.array[wp.int32],
):
    """List nodes with their rows, in any order, if ``goes`` [1] is not zero."""
    count = pools.counts[NODE_TOP]
    if goes[0] == 0:
        count = 0
    for i in range(wp.tid(), count, threads):
        row = carried.row[i]
        if row != NO_ROW:
            place = wp.atomic_add(found, FOLLOWERS, 1)
            nodes[place] = i
            rows[place] = row
            if row == MIXED_ROWS:
                wp.atomic_add(found, MIXED, 1)
