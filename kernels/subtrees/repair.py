"""Forces of the leaves that the subtree kernels left out: flat or inverted ones, with the rotation that is right for
every F.

A byte for each subtree, with a bit for each leaf, says which these are. On CUDA the subtrees that have any are in a
list (``LeftOut``), which one launch of a fixed size processes. On the CPU, and where sums must have a fixed order, a
thread reads the bytes of eight subtrees at a time, nearly always all zero, and processes their leaves in order.
"""

import warp as wp

from warp_corot.kernels.corotated.algebraic import FLAT, stretch_stress, turned_stress
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, rotated_stress
from warp_corot.kernels.elements.elements import ForestElements, frame, local_gradient, nodal_forces, scatter_stress
from warp_corot.kernels.elements.merging import add_four_forces
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.math.quaternion import robust_rotation

wp.set_module_options({"enable_backward": False})

#: Number of subtrees of one thread; ``flagged`` has a multiple of these.
SUBTREES = 8
LEAVES = 8
#: Number of threads in a block that processes a list, and in a warp.
LIST_BLOCK = 128
WARP = 32
#: Lists that a body's thread blocks take in turn.
LISTS = 32
COUNT_STRIDE = 32
#: Threads of a block of the subtree kernels.
SUBTREE_BLOCK = 128


# More rounds would cost more arithmetic than they save sums.
add_pairs = add_four_forces(1)


@wp.struct
class LeftOut:
    """Subtrees with leaves that were left out, in lists which thread blocks take in turn.

    There are several because atomic additions to one number that return its former value take 5 ns each.
    """

    # Entries of each list, a cache line apart, then blocks that are done; all zero between evaluations.
    counts: wp.array[wp.int32]  # [(LISTS + 1) COUNT_STRIDE]
    room: int  # of a list
    entries: wp.array[wp.vec2i]  # [LISTS room] where its first leaf (own rotations) or it itself stands, and the mask


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    // One addition for all threads of a warp; nobody waits for it here.
    const int lane = threadIdx.x & 31;
    const unsigned all = to_come + lane >= 32 ? 0xffffffffu : (1u << (to_come + lane)) - 1;
    const unsigned those = __ballot_sync(all, is_left_out);
    if (lane == 0 && those != 0) return atomicAdd(&wp::index(lists.counts, {COUNT_STRIDE} * list), __popc(those));
    return 0;
#else
    return wp::index(lists.counts, {COUNT_STRIDE} * list);
#endif
""")
def reserve(lists: LeftOut, list: int, is_left_out: bool, to_come: int) -> int:
    """Make room on a list for those threads of a warp that have left leaves out.

    ``to_come`` is the number of threads from this one on. All threads of a warp must call this, and ``append`` as well.
    """
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int lane = threadIdx.x & 31;
    const unsigned all = to_come + lane >= 32 ? 0xffffffffu : (1u << (to_come + lane)) - 1;
    const unsigned those = __ballot_sync(all, mask != 0);
    if (those == 0) return;
    const int begin = lists.room * list + __shfl_sync(all, reserved, 0);
    const int before = __popc(those & ((1u << lane) - 1));
    if (mask != 0) wp::index(lists.entries, begin + before) = wp::vec_t<2, wp::int32>(place, mask);
#else
    if (mask == 0) return;
    wp::index(lists.entries, lists.room * list + reserved) = wp::vec_t<2, wp::int32>(place, mask);
    wp::index(lists.counts, {COUNT_STRIDE} * list) = reserved + 1;
#endif
""")
def append(lists: LeftOut, list: int, reserved: int, place: int, mask: int, to_come: int):
    """Put a subtree on a list, in the room that was made for it, unless its mask is zero."""
    ...


@wp.func
def list_of(block: int):
    """The list that a thread block appends to."""
    return block % LISTS


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    return __syncthreads_or(wp::index(lists.counts, {COUNT_STRIDE} * (threadIdx.x % {LISTS}))) != 0;
#else
    int any = 0;
    for (int list = 0; list < {LISTS}; ++list) any |= wp::index(lists.counts, {COUNT_STRIDE} * list);
    return any != 0;
#endif
""")
def any_left_out(lists: LeftOut) -> bool:
    """Whether there is any entry; all threads of a block must call this together."""
    ...


@wp.func
def entry_count(lists: LeftOut, list: int):
    return lists.counts[COUNT_STRIDE * list]


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (threadIdx.x == 0) {{
        __threadfence();
        int* const counts = &wp::index(lists.counts, 0);
        if (atomicAdd(counts + {COUNT_STRIDE * LISTS}, 1) == blocks - 1)
            for (int list = 0; list <= {LISTS}; ++list) counts[{COUNT_STRIDE} * list] = 0;
    }}
#else
    for (int list = 0; list < {LISTS}; ++list) wp::index(lists.counts, {COUNT_STRIDE} * list) = 0;
#endif
""")
def leave(lists: LeftOut, blocks: int):
    """Empty the lists once every block is done with them."""
    ...


@wp.func
def is_left_out(flags: wp.uint64, leaf: int):
    """Whether the ``leaf``-th of the 64 leaves of eight subtrees was."""
    return ((flags >> wp.uint64(leaf)) & wp.uint64(1)) != wp.uint64(0)


@wp.func
def scatter_turned(
    elements: ForestElements,
    t: int,
    r: wp.mat33,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
):
    """Add the forces of element t with r, a rotation from rest space."""
    q = frame(elements, t)
    m = material.mu[t * material.stride]
    k = material.lam[t * material.stride]
    scatter_stress(elements, t, rotated_stress(local_gradient(elements, t, u), q, r * q, m, k), f)


@wp.func
def own_stress(elements: ForestElements, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    """First Piola-Kirchhoff stress times Q of element t with its own rotation, whatever its F, and whether the subtree
    kernels could have found it."""
    q = frame(elements, t)
    w = wp.transpose(q) * local_gradient(elements, t, u)
    m = material.mu[t * material.stride]
    k = material.lam[t * material.stride]
    p = wp.mat33()
    trusted = wp.determinant(identity3() + w) > FLAT
    if trusted:
        p, trusted = stretch_stress(w, m, k)
    if not trusted:
        p = turned_stress(identity3() + w, m, k)
    return q * p, trusted


@wp.func
def root_rotation(roots: ForestElements, s: int, u: wp.array[wp.vec4]):
    q = frame(roots, s)
    return robust_rotation(q + local_gradient(roots, s, u)) * wp.transpose(q)


# --- in place -------------------------------------------------------------------------------------------------------


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


# --- by a list ------------------------------------------------------------------------------------------------------


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ int places[{LIST_BLOCK // WARP}][{WARP * LEAVES}];
    int* const own = places[threadIdx.x / {WARP}];
    if (k >= 0) return own[k];
    const int lane = threadIdx.x % {WARP};
    int place = 0, mask = 0;
    if (lane < entries) {{
        place = wp::index(lists.entries, begin + lane)[0];
        mask = wp::index(lists.entries, begin + lane)[1];
    }}
    int end = __popc(mask);
    int at = -end;
    for (int step = 1; step < {WARP}; step *= 2) {{
        const int before = __shfl_up_sync(0xffffffff, end, step);
        if (lane >= step) end += before;
    }}
    at += end;
    __syncwarp();
    for (; mask != 0; mask &= mask - 1) own[at++] = place + __ffs(mask) - 1;
    __syncwarp();
    return __shfl_sync(0xffffffff, end, {WARP - 1});
#else
    static int own[{WARP * LEAVES}];
    if (k >= 0) return own[k];
    int at = 0;
    for (int entry = begin; entry < begin + entries; ++entry) {{
        const int mask = wp::index(lists.entries, entry)[1];
        for (int leaf = 0; leaf < {LEAVES}; ++leaf)
            if ((mask >> leaf) & 1) own[at++] = wp::index(lists.entries, entry)[0] + leaf;
    }}
    return at;
#endif
""")
def leaves_of_entries(lists: LeftOut, begin: int, entries: int, k: int) -> int:
    """Write the leaves of up to 32 entries into a list for the threads of a warp and return how many there are; or
    return the k-th of them.

    So every thread has a leaf even where few leaves of each entry were left out.
    """
    ...


@wp.kernel(enable_backward=False, grid_stride=False)
def repair_listed_own(
    # In
    threads: int,
    elements: ForestElements,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    # In and out
    listed: LeftOut,
    # Out
    f: wp.array[wp.vec4],
):
    """Every leaf with its own rotation, a thread a leaf.

    Neighbours' forces are added up before they go to memory. Launch with block_dim LIST_BLOCK and as many ``threads``,
    a multiple of it; or with one.
    """
    if not any_left_out(listed):
        return
    lanes = wp.min(threads, WARP)
    warps = threads // lanes
    warp = wp.tid() // lanes
    # A warp processes one of the lists at a time, together with others.
    at_a_time = wp.min(warps, LISTS)
    list = warp % at_a_time
    each_list = (warps - list + at_a_time - 1) // at_a_time
    while list < LISTS:
        count = entry_count(listed, list)
        each = wp.clamp((count + each_list - 1) // each_list, 1, WARP)
        begin = (warp // at_a_time) * each
        while begin < count:
            total = leaves_of_entries(listed, listed.room * list + begin, wp.min(each, count - begin), -1)
            k = wp.tid() % lanes
            # All threads of a warp stay together, for their neighbours'.
            while k - k % lanes < total:
                t = int(0)
                targets = wp.vec4i(-1, -1, -1, -1)
                p = wp.mat33()
                if k < total:
                    t = leaves_of_entries(listed, 0, 0, k)
                    targets = elements.targets[t]
                    p, _trusted = own_stress(elements, t, material, u)
                f0, f1, f2, f3 = nodal_forces(elements, t, p)
                add_pairs(f, targets, f0, f1, f2, f3)
                k += lanes
            begin += each_list * each
        list += at_a_time
    leave(listed, threads // LIST_BLOCK)


@wp.kernel(enable_backward=False, grid_stride=False)
def repair_listed_shared(
    # In
    threads: int,
    first: wp.array[wp.int32],
    roots: ForestElements,
    elements: ForestElements,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    # In and out
    listed: LeftOut,
    # Out
    f: wp.array[wp.vec4],
):
    """Every leaf of a listed subtree with the rotation of the subtree's root, a thread a leaf; launch as the other."""
    if not any_left_out(listed):
        return
    at_a_time = wp.min(threads, LISTS)
    list = wp.tid() % at_a_time
    each_list = (threads - list + at_a_time - 1) // at_a_time
    while list < LISTS:
        i = wp.tid() // at_a_time
        while i < entry_count(listed, list) * LEAVES:
            s = listed.entries[listed.room * list + i // LEAVES][0]
            t = first[s] + i % LEAVES
            scatter_turned(elements, t, root_rotation(roots, s, u), material, u, f)
            i += each_list
        list += at_a_time
    leave(listed, threads // LIST_BLOCK)


# --- by bytes, in order ---------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def repair_own(
    # In
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    elements: ForestElements,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Every leaf with its own rotation."""
    i = wp.tid()
    flags = flagged[i]
    if flags == wp.uint64(0):
        return
    leaf = int(0)
    while leaf < SUBTREES * LEAVES:
        if is_left_out(flags, leaf):
            t = first[SUBTREES * i + leaf // LEAVES] + leaf % LEAVES
            p, _trusted = own_stress(elements, t, material, u)
            scatter_stress(elements, t, p, f)
        leaf += 1


@wp.kernel(enable_backward=False)
def repair_shared(
    # In
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    roots: ForestElements,
    elements: ForestElements,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Every leaf with the rotation of its subtree's root."""
    i = wp.tid()
    flags = flagged[i]
    if flags == wp.uint64(0):
        return
    member = int(0)
    while member < SUBTREES:
        if is_left_out(flags, LEAVES * member):
            s = SUBTREES * i + member
            rotation = root_rotation(roots, s, u)
            leaf = int(0)
            while leaf < LEAVES:
                t = first[s] + leaf
                scatter_turned(elements, t, rotation, material, u, f)
                leaf += 1
        member += 1
