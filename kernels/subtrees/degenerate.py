"""Lists of the subtrees with leaves that the subtree kernels left out; see ``repair``."""

import warp as wp

#: Number of leaves of a subtree.
LEAVES = 8
#: Number of threads in a block that processes a list, and in a warp.
LIST_BLOCK = 128
WARP = 32
#: Number of lists; the thread blocks of a body append to them in turn.
LISTS = 32
COUNT_STRIDE = 32


@wp.struct
class DegenerateList:
    """Subtrees with left-out leaves, in several lists.

    One list would be slow: atomic additions to one number that return its former value take 5 ns each.
    """

    # The lengths of the lists, a cache line apart, then the number of blocks that are done; zero between evaluations.
    counts: wp.array[wp.int32]  # [(LISTS + 1) COUNT_STRIDE]
    room: int  # capacity of a list
    entries: wp.array[wp.vec2i]  # [LISTS room] first leaf of the subtree (own rotations) or the subtree, and its mask


#: The argument of kernels that write no list.
NO_LIST = DegenerateList()


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    // One addition for all threads of a warp; nobody waits for it here.
    const int lane = threadIdx.x & 31;
    const unsigned all = to_come + lane >= 32 ? 0xffffffffu : (1u << (to_come + lane)) - 1;
    const unsigned those = __ballot_sync(all, is_degenerate);
    if (lane == 0 && those != 0) return atomicAdd(&wp::index(lists.counts, {COUNT_STRIDE} * list), __popc(those));
    return 0;
#else
    return wp::index(lists.counts, {COUNT_STRIDE} * list);
#endif
""")
def reserve(lists: DegenerateList, list: int, is_degenerate: bool, to_come: int) -> int:
    """Make room on a list for the threads of a warp that have left leaves out.

    ``to_come`` is the number of threads from this one on. All threads of a warp must call this, and then ``append``.
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
def append(lists: DegenerateList, list: int, reserved: int, place: int, mask: int, to_come: int):
    """Put a subtree on a list, at the place that ``reserve`` made for it, unless its mask is zero."""
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
def any_degenerate(lists: DegenerateList) -> bool:
    """Whether any list has an entry; all threads of a block must call this together."""
    ...


@wp.func
def entry_count(lists: DegenerateList, list: int):
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
def leave(lists: DegenerateList, blocks: int):
    """Say that this block is done; the last of all blocks empties the lists."""
    ...


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
def leaves_of_entries(lists: DegenerateList, begin: int, entries: int, k: int) -> int:
    """For k < 0, list the leaves of up to 32 entries for the threads of a warp and return their number; otherwise
    return the k-th of them.

    So every thread gets a leaf even if few leaves of each entry were left out.
    """
    ...
