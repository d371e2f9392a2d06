"""Forces of left-out leaves within the subtree kernels: each warp computes those of its own subtrees."""

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ForestElements, nodal_forces

from .left_out import LEAVES, WARP
from .repair import add_pairs, own_stress

#: Threads of a block of the subtree kernels.
SUBTREE_BLOCK = 128


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
    """Whether most leaves of a warp were left out before, by their masks: then the warp takes its leaves one by one."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __shfl_sync(0xffffffffu, value, lane);
#else
    return value;
#endif
""")
def of_lane(value: int, lane: int) -> int:
    """The value that another thread of a whole warp has."""
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
        The leaves of this thread's subtree that the subtree kernels would leave out, a bit each.
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


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ unsigned char places[{SUBTREE_BLOCK // WARP}][{WARP * LEAVES}];
    unsigned char* const own = places[threadIdx.x / {WARP}];
    if (k >= 0) return own[k];
    const int lane = threadIdx.x % {WARP};
    const unsigned all = to_come + lane >= {WARP} ? 0xffffffffu : (1u << (to_come + lane)) - 1;
    if (__ballot_sync(all, mask != 0) == 0) return 0;
    int end = __popc(mask);
    int at = -end;
    for (int step = 1; step < {WARP}; step *= 2) {{
        const int before = __shfl_up_sync(all, end, step);
        if (lane >= step) end += before;
    }}
    at += end;
    for (; mask != 0; mask &= mask - 1) own[at++] = {LEAVES} * lane + __ffs(mask) - 1;
    __syncwarp(all);
    return __shfl_sync(all, end, __popc(all) - 1);
#else
    static int own[{LEAVES}];
    if (k >= 0) return own[k];
    int at = 0;
    for (int leaf = 0; leaf < {LEAVES}; ++leaf)
        if ((mask >> leaf) & 1) own[at++] = leaf;
    return at;
#endif
""")
def leaves_of_warp(mask: int, to_come: int, k: int) -> int:
    """Write down which leaves of a warp's subtrees are in their masks, and how many there are; or the k-th of them.

    A leaf is eight times its thread's place in the warp, plus its number. A CPU's warp is one thread.
    """
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    return threadIdx.x % {WARP};
#else
    return 0;
#endif
""")
def lane_of() -> int: ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x % {WARP};
    return to_come + lane >= {WARP} ? {WARP} : to_come + lane;
#else
    return 1;
#endif
""")
def lanes_of(to_come: int) -> int:
    """The threads of a warp; the last one may have fewer."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x % {WARP};
    const unsigned all = to_come + lane >= {WARP} ? 0xffffffffu : (1u << (to_come + lane)) - 1;
    return __shfl_sync(all, value, from_lane);
#else
    return value;
#endif
""")
def value_of_lane(value: int, to_come: int, from_lane: int) -> int:
    """The value that another thread of the warp has."""
    ...


@wp.func
def scatter_in_warp(
    elements: ForestElements,
    first: int,
    mask: int,
    asks: bool,
    to_come: int,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
):
    """Add the forces of the leaves in the masks of a warp's subtrees, a thread a leaf.

    Args:
        elements: All leaves.
        first: First leaf of this thread's subtree.
        mask: Which of its leaves, a bit each.
        asks: Whether to find which of them the subtree kernels would leave out; of whole warps and all leaves.
        to_come: Threads from this one on.
        material, u: As in ``own_stress``.
        f: Forces [N].

    Returns:
        The mask, or what was found.
    """
    found = int(mask)
    total = leaves_of_warp(mask, to_come, -1)
    lane = lane_of()
    lanes = lanes_of(to_come)
    begin = int(0)
    while begin < total:
        entry = int(0)
        if begin + lane < total:
            entry = leaves_of_warp(0, 0, begin + lane)
        t = value_of_lane(first, to_come, entry // LEAVES) + entry % LEAVES
        targets = wp.vec4i(-1, -1, -1, -1)
        p = wp.mat33()
        trusted = bool(True)
        if begin + lane < total:
            targets = elements.targets[t]
            p, trusted = own_stress(elements, t, material, u)
        f0, f1, f2, f3 = nodal_forces(elements, t, p)
        add_pairs(f, targets, f0, f1, f2, f3)
        if asks:
            flags = flags_of_warp(not trusted)
            if lane // wp.static(WARP // LEAVES) == begin // WARP:
                found = (flags >> (LEAVES * (lane % wp.static(WARP // LEAVES)))) & 255
        begin += lanes
    return found
