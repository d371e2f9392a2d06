"""A force plan: its arrays, and what its kernels share.

``lists`` finds the leaves in complete subtrees and the others; ``units`` the elements whose rotations are
found; ``batches`` writes the arrays that launches read; ``slots`` numbers places for forces. A forest that stays as it
is gets arrays of exact sizes, for all worlds; one that changes (``changing``) gets arrays for its capacity.
"""

import warp as wp

from warp_corot.kernels.elements.elements import LEVEL_MASK

places_t = wp.types.vector(length=16, dtype=wp.int32)


@wp.struct
class Plan:
    """The derived arrays; those for the capacity have padding beyond the current size."""

    rotation_level: int  # -1: rotations are not shared
    with_subtrees: int  # 0: all leaves are computed one by one
    with_units: int  # 0: units are counted, but not listed
    members: int  # 2: groups and single subtrees; 1: there are no groups
    classes: int
    # Copies of the body, and the numbers of nodes, leaves and units in each.
    worlds: int
    world_nodes: int
    world_leaves: int
    world_units: int
    # Numbers for each class, for leaves in none, for units and for leaves; and the former numbers.
    counts: wp.array[wp.int32]
    before: wp.array[wp.int32]
    stale: wp.array[wp.int32]  # [1] nonzero: derive it even if the last pass changed nothing
    goes: wp.array[wp.int32]  # [1] whether it is derived at all
    # Leaves.
    code: wp.array[wp.int32]
    values: wp.array2d[wp.float32]  # [names, leaves]
    marks: wp.array[wp.int8]
    unit: wp.array[wp.int32]
    # First leaves of the subtrees, class after class, and the leaves in none.
    begin: places_t  # of each class
    first: wp.array[wp.int32]
    flat: wp.array[wp.int32]
    # Units. Where leaves may be padding the first place is padding for them, and units are counted from 1.
    first_unit: int
    unit_nodes: wp.array[wp.vec4i]
    unit_code: wp.array[wp.int32]


@wp.func
def flat_row(plan: Plan):
    """The row that counts leaves in no subtree; the next one counts units, then all leaves."""
    return plan.classes


@wp.func
def leaf_row(plan: Plan):
    """The row that counts all leaves."""
    return plan.classes + 2


@wp.func
def extent(row: int, plan: Plan):
    """Number of written places in a row, padding included; of one world."""
    if plan.goes[0] == 0:
        return 0
    return wp.max(plan.counts[row], plan.before[row])


@wp.func
def level_of(i: int, plan: Plan):
    return plan.code[i] & LEVEL_MASK
