"""Leaves of a growing forest: those to bisect for a tolerance, that the surface may cut, or that hold tissue."""

import warp as wp

from .elements import LEFT, OPEN
from .growth import LIVE

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def flag_off(
    # In
    first_child: wp.array[wp.int32],
    level: wp.array[wp.int32],
    needs: wp.array[wp.float32],
    tolerances: wp.array[wp.float32],
    max_level: int,
    # Out
    flags: wp.array[wp.int32],
):
    """Flag leaves whose error exceeds the tolerance."""
    i = wp.tid()
    flag = int(0)
    if first_child[i] == LIVE and level[i] < max_level and needs[i] > tolerances[level[i]]:
        flag = 1
    flags[i] = flag


@wp.kernel(enable_backward=False)
def open_leaves(
    # In
    first_child: wp.array[wp.int32],
    level: wp.array[wp.int32],
    parent: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    phi: wp.array[wp.float32],
    needs: wp.array[wp.float32],
    circumradius: wp.array[wp.float32],
    lipschitz: float,
    deepest: int,
    rough: float,
    # Out
    states: wp.array[wp.int32],
):
    """Leaves at or below the deepest level that the surface may cut and whose parents' error was a fraction of their
    size."""
    i = wp.tid()
    state = LEFT
    if first_child[i] == LIVE and level[i] >= deepest:
        size = circumradius[level[i]]
        above = parent[i]
        if above < 0 or needs[above] > rough * size:
            tet = tets[i]
            highest = wp.max(wp.vec4(phi[tet[0]], phi[tet[1]], phi[tet[2]], phi[tet[3]]))
            if highest >= -lipschitz * size:
                state = OPEN
    states[i] = state


@wp.kernel(enable_backward=False)
def count_holding(
    # In
    first_child: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    phi: wp.array[wp.float32],
    # Out
    count: wp.array[wp.int32],
):
    """Number of leaves with a corner inside."""
    i = wp.tid()
    if first_child[i] == LIVE:
        tet = tets[i]
        if wp.min(wp.vec4(phi[tet[0]], phi[tet[1]], phi[tet[2]], phi[tet[3]])) < 0.0:
            wp.atomic_add(count, 0, 1)
