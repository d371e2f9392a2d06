"""What limits the time step of a mesh that has changed: the stiffest of its elements for their size and mass."""

import warp as wp

from .remesh import LEAVES, Pools
from .remesh_state import Carried


@wp.kernel(enable_backward=False)
def begin_survey(
    # In
    goes: wp.array[wp.int32],
    # Out
    found: wp.array[wp.int32],
):
    if goes[0] != 0:
        found[0] = 0
        found[1] = 0


@wp.kernel(enable_backward=False)
def find_stiffest(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    modulus: float,
    mu_column: int,
    lam_column: int,
    pools: Pools,
    carried: Carried,
    # Out
    found: wp.array[wp.int32],
):
    """Largest (2 mu + lambda) / (density volume^(2/3)) [1/s^2] of the leaves, as the bits of a float, and the finest level.

    ``modulus`` is 2 mu + lambda [Pa] where all elements have the same, and columns of ``values`` are negative.
    """
    count = wp.where(goes[0] != 0, pools.counts[LEAVES], 0)
    most = float(0.0)
    finest = int(0)
    for i in range(wp.tid(), count, threads):
        e = pools.leaves[i]
        level = pools.level[e]
        stiffness = modulus
        if mu_column >= 0:
            stiffness = 2.0 * carried.values[e, mu_column] + carried.values[e, lam_column]
        size = wp.pow(float(carried.volume[level]), 2.0 / 3.0)
        most = wp.max(most, stiffness / (float(carried.density[e]) * size))
        finest = wp.max(finest, level)
    # Positive floats are in the order of their bits. Few threads get so far as to write.
    bits = wp.cast(most, wp.int32)
    if bits > found[0]:
        wp.atomic_max(found, 0, bits)
    if finest > found[1]:
        wp.atomic_max(found, 1, finest)
