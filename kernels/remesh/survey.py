"""Limits of the time step of a changed mesh: its stiffest elements for their size and mass, and their number.

An element among elements of its size vibrates faster than one among larger ones, so the finest level alone is not
enough.
"""

import warp as wp

from .pools import LEAVES, Pools
from .state import Carried, modulus_of

wp.set_module_options({"enable_backward": False})

# Places in the result; from FINEST_COUNTS on there are partial sums.
STIFFEST = wp.constant(0)
FINEST_LEVEL = wp.constant(1)
FINEST_COUNTS = wp.constant(2)
PARTIAL_SUMS = wp.constant(256)
PLACES = 258


@wp.kernel(enable_backward=False)
def find_stiffest(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    modulus: float,
    pools: Pools,
    carried: Carried,
    # Out
    found: wp.array[wp.int32],
):
    """Largest (2 mu + lambda) / (density volume^(2/3)) [1/s^2] of the leaves, as a float's bits, and the finest level.

    ``modulus`` is 2 mu + lambda [Pa] if all elements have the same.
    """
    count = wp.where(goes[0] != 0, pools.counts[LEAVES], 0)
    most = float(0.0)
    finest = int(0)
    for i in range(wp.tid(), count, threads):
        e = pools.leaves[i]
        level = pools.level[e]
        size = carried.size[level]
        most = wp.max(most, modulus_of(e, modulus, carried) / float(carried.density[e] * size * size))
        finest = wp.max(finest, level)
    # Positive floats have the order of their bits. Few threads reach the write.
    bits = wp.cast(most, wp.int32)
    if bits > found[STIFFEST]:
        wp.atomic_max(found, STIFFEST, bits)
    if finest > found[FINEST_LEVEL]:
        wp.atomic_max(found, FINEST_LEVEL, finest)


@wp.kernel(enable_backward=False)
def count_finest(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    pools: Pools,
    # In and out
    found: wp.array[wp.int32],
):
    """Number of leaves at the finest level, in partial sums."""
    count = wp.where(goes[0] != 0, pools.counts[LEAVES], 0)
    own = int(0)
    for i in range(wp.tid(), count, threads):
        if pools.level[pools.leaves[i]] == found[FINEST_LEVEL]:
            own += 1
    if own > 0:
        wp.atomic_add(found, FINEST_COUNTS + wp.tid() % PARTIAL_SUMS, own)
