"""Forces of left-out leaves within the subtree kernels: each warp computes those of its own subtrees."""

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ForestElements, nodal_forces

from .left_out import LEAVES, WARP
from .repair import add_pairs, own_stress


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    // Half of the leaves of half of the subtrees of a whole warp.
    if (__activemask() != 0xffffffffu) return false;
    return __popc(__ballot_sync(0xffffffffu, __popc(mask) >= {LEAVES // 2})) >= {WARP // 2};
#else
    return false;
#endif
""")
def is_mostly_left_out(mask: int) -> bool:
    """Whether most leaves of a warp were left out in the last evaluation, as their masks say."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, lane);
#else
    return value;
#endif
""")
def of_lane(value: int, lane: int) -> int:
    """The value of another thread of a whole warp."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return static_cast<int>(__ballot_sync(0xffffffffu, flag));
#else
    return flag ? 1 : 0;
#endif
""")
def flags_of_warp(flag: bool) -> int:
    """A bit for each thread of a whole warp."""
    ...


@wp.func
def scatter_one_by_one(
    elements: ForestElements,
    first: int,
    lane: int,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
):
    """Add the forces of all leaves of a warp's subtrees, a thread a leaf at a time.

    Args:
        elements: All leaves.
        first: First leaf of this thread's subtree.
        lane: Place of the thread in its warp.
        material, u: As in ``own_stress``.
        f: Forces [N].

    Returns:
        A mask of the leaves of this thread's subtree that the subtree kernels would leave out.
    """
    mask = int(0)
    each = wp.static(WARP // LEAVES)
    j = int(0)
    while j < LEAVES:
        t = of_lane(first, each * j + lane // LEAVES) + lane % LEAVES
        p, trusted = own_stress(elements, t, material, u)
        f0, f1, f2, f3 = nodal_forces(elements, t, p)
        add_pairs(f, elements.targets[t], f0, f1, f2, f3)
        flags = flags_of_warp(not trusted)
        if lane // each == j:
            mask = (flags >> (LEAVES * (lane % each))) & 255
        j += 1
    return mask
