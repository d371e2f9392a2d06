"""A coarser mesh out of a forest: bisected again from the roots, where it is wished and conformity asks for it.

All that could be asked for is in the forest: a conforming mesh that is wished for in part of its tetrahedra needs no
other bisections than those that the forest has. So nothing is made here, and no value looked at.
"""

import warp as wp

from warp_corot.kernels.tables.shapes import FIRST_NODE, SECOND_NODE

from .bisection import refinement_end
from .growth import LIVE, VOID, find_midpoint

#: In place of a first child: below the mesh.
BELOW = wp.constant(-3)


@wp.kernel(enable_backward=False)
def find_midpoints(
    # In
    tets: wp.array[wp.vec4i],
    first_child: wp.array[wp.int32],
    keys: wp.array[wp.int64],
    values: wp.array[wp.int32],
    # Out
    midpoints: wp.array2d[wp.int32],
):
    """The nodes at the middle of the six edges of what is bisected, -1 where there is none."""
    i = wp.tid()
    if first_child[i] >= 0:
        tet = tets[i]
        for e in range(6):
            midpoints[i, e] = find_midpoint(tet[FIRST_NODE[e]], tet[SECOND_NODE[e]], keys, values)


@wp.kernel(enable_backward=False)
def bisect_again(
    # In
    first_child: wp.array[wp.int32],
    level: wp.array[wp.int32],
    midpoints: wp.array2d[wp.int32],
    needs: wp.array[wp.float32],
    least: float,
    holds: wp.array[wp.uint8],
    # In and out
    child: wp.array[wp.int32],
    active: wp.array[wp.uint8],
    counts: wp.array[wp.int32],
):
    """One round: leaves of the mesh that need it, or hang, are bisected. Midpoints that become active in this round may
    be seen in it or in the next one: which leaves are bisected in the end is the same."""
    i = wp.tid()
    if child[i] != LIVE or first_child[i] < 0:
        return
    split = needs[i] > least
    if not split:
        for e in range(6):
            node = midpoints[i, e]
            if node >= 0:
                split = split or active[node] != wp.uint8(0)
    if split:
        below = first_child[i]
        active[midpoints[i, refinement_end(level[i]) - 1]] = wp.uint8(1)
        for n in range(2):
            child[below + n] = wp.where(holds[below + n] != wp.uint8(0), LIVE, VOID)
        child[i] = below
        wp.atomic_add(counts, 0, 1)


@wp.kernel(enable_backward=False)
def count_leaves(
    # In
    child: wp.array[wp.int32],
    shares: wp.array[wp.float32],
    least: float,
    # Out
    counts: wp.array[wp.int32],
):
    """How many leaves hold no less than a share of themselves."""
    i = wp.tid()
    if child[i] == LIVE and shares[i] >= least:
        wp.atomic_add(counts, 0, 1)
