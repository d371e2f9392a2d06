"""What limits the time step of a mesh that has changed: the stiffest of its elements for their size and mass."""

import warp as wp

from .remesh import ADDED, LEAVES, REMOVED, Pools
from .remesh_state import Carried


@wp.kernel(enable_backward=False)
def begin_survey(
    # In
    pools: Pools,
    # Out
    stiffest: wp.array[wp.int32],
):
    if pools.counts[ADDED] + pools.counts[REMOVED] > 0:
        stiffest[0] = 0


@wp.kernel(enable_backward=False)
def find_stiffest(
    # In
    threads: int,
    modulus: float,
    mu_column: int,
    lam_column: int,
    pools: Pools,
    carried: Carried,
    # Out
    stiffest: wp.array[wp.int32],
):
    """Largest (2 mu + lambda) / (density volume^(2/3)) [1/s^2] of the leaves, as the bits of a float.

    ``modulus`` is 2 mu + lambda [Pa] where all elements have the same, and columns of ``values`` are negative.
    """
    count = pools.counts[LEAVES]
    if pools.counts[ADDED] + pools.counts[REMOVED] == 0:
        count = 0
    most = float(0.0)
    for i in range(wp.tid(), count, threads):
        e = pools.leaves[i]
        stiffness = modulus
        if mu_column >= 0:
            stiffness = 2.0 * carried.values[e, mu_column] + carried.values[e, lam_column]
        size = wp.pow(float(carried.volume[pools.level[e]]), 2.0 / 3.0)
        most = wp.max(most, stiffness / (float(carried.density[e]) * size))
    # Positive floats are in the order of their bits. Few threads get so far as to write.
    bits = wp.cast(most, wp.int32)
    if bits > stiffest[0]:
        wp.atomic_max(stiffest, 0, bits)
