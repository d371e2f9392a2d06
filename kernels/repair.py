"""Forces of the leaves that the subtree kernels left out: flat or inverted ones, with the rotation that is right for
every F.

Which those are is a byte a subtree, a bit a leaf. On CUDA the subtrees that have any stand in a list (``LeftOut``), and
one launch of a fixed size goes through it. On the CPU, and where the order of the sums must be settled, a thread reads
the bytes of eight subtrees at a time, nearly always all zero, and goes through their leaves in order.
"""

import warp as wp

from .algebraic import algebraic_rotation, turned_stress
from .constitutive import corotated_strain, hooke
from .elements import ForestElements, frame, local_gradient, nodal_forces, scatter_stress
from .newton_merging import add_four_forces

wp.set_module_options({"enable_backward": False})

#: Subtrees that one thread looks after; ``flagged`` has a multiple of these.
SUBTREES = 8
LEAVES = 8
#: Threads of a block that goes through a list, and of a warp.
LIST_BLOCK = 128
WARP = 32


add_neighbours = add_four_forces(2)


@wp.struct
class LeftOut:
    """The list of subtrees with leaves that were left out."""

    # Entries, then blocks that are done with the list: both zero between evaluations.
    counts: wp.array[wp.int32]  # [2]
    entries: wp.array[wp.vec2i]  # [capacity] where its first leaf (own rotations) or it itself stands, and the mask


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // One addition for all threads of a warp that are here.
    const unsigned here = __activemask();
    const unsigned lane = threadIdx.x & 31;
    const int leader = __ffs(here) - 1;
    int begin = 0;
    if (lane == leader) begin = atomicAdd(&wp::index(list.counts, 0), __popc(here));
    begin = __shfl_sync(here, begin, leader);
    wp::index(list.entries, begin + __popc(here & ((1u << lane) - 1))) = wp::vec_t<2, wp::int32>(place, mask);
#else
    wp::index(list.entries, wp::index(list.counts, 0)++) = wp::vec_t<2, wp::int32>(place, mask);
#endif
""")
def append(list: LeftOut, place: int, mask: int):
    """Add a subtree to the list."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    __syncthreads();
    if (threadIdx.x == 0) {
        __threadfence();
        int* const counts = &wp::index(list.counts, 0);
        if (atomicAdd(counts + 1, 1) == blocks - 1) {
            counts[0] = 0;
            counts[1] = 0;
        }
    }
#else
    wp::index(list.counts, 0) = 0;
#endif
""")
def leave(list: LeftOut, blocks: int):
    """Empty the list once every block is done with it."""
    ...


@wp.func
def is_left_out(flags: wp.uint64, leaf: int):
    """Whether the ``leaf``-th of the 64 leaves of eight subtrees was."""
    return ((flags >> wp.uint64(leaf)) & wp.uint64(1)) != wp.uint64(0)


@wp.func
def scatter_turned(
    elements: ForestElements, t: int, r: wp.mat33, mu: float, lam: float, u: wp.array[wp.vec4], f: wp.array[wp.vec4]
):
    """Add the forces of element t with r, the rotation of its F Q."""
    strain = corotated_strain(local_gradient(elements, t, u), frame(elements, t), r)
    scatter_stress(elements, t, r * hooke(strain, mu, lam), f)


@wp.func
def own_stress(
    elements: ForestElements,
    t: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
):
    """First Piola-Kirchhoff stress times Q of element t with its own rotation."""
    return turned_stress(frame(elements, t) + local_gradient(elements, t, u), mu[t * stride], lam[t * stride])


@wp.func
def scatter_own(
    elements: ForestElements,
    t: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
):
    """Add the forces of element t with its own rotation."""
    scatter_stress(elements, t, own_stress(elements, t, mu, lam, stride, u), f)


@wp.func
def root_rotation(roots: ForestElements, s: int, u: wp.array[wp.vec4]):
    q = frame(roots, s)
    return algebraic_rotation(q + local_gradient(roots, s, u)) * wp.transpose(q)


# --- by a list ------------------------------------------------------------------------------------------------------


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ int places[{LIST_BLOCK // WARP}][{WARP * LEAVES}];
    int* const own = places[threadIdx.x / {WARP}];
    if (k >= 0) return own[k];
    const int lane = threadIdx.x % {WARP};
    int place = 0, mask = 0;
    if (lane < entries) {{
        place = wp::index(list.entries, begin + lane)[0];
        mask = wp::index(list.entries, begin + lane)[1];
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
        const int mask = wp::index(list.entries, entry)[1];
        for (int leaf = 0; leaf < {LEAVES}; ++leaf)
            if ((mask >> leaf) & 1) own[at++] = wp::index(list.entries, entry)[0] + leaf;
    }}
    return at;
#endif
""")
def leaves_of_entries(list: LeftOut, begin: int, entries: int, k: int) -> int:
    """Write down the leaves of up to 32 entries for the threads of a warp, and how many there are; or the k-th of them.

    Where few leaves of each entry were left out, every thread has one to do all the same.
    """
    ...


@wp.kernel(enable_backward=False, grid_stride=False)
def repair_listed_own(
    # In
    threads: int,
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
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
    count = listed.counts[0]
    if count == 0:
        return
    lanes = wp.min(threads, WARP)
    warps = threads // lanes
    each = wp.clamp((count + warps - 1) // warps, 1, WARP)
    begin = (wp.tid() // lanes) * each
    while begin < count:
        total = leaves_of_entries(listed, begin, wp.min(each, count - begin), -1)
        k = wp.tid() % lanes
        # All threads of a warp stay together, for their neighbours'.
        while k - k % lanes < total:
            t = int(0)
            targets = wp.vec4i(-1, -1, -1, -1)
            p = wp.mat33()
            if k < total:
                t = leaves_of_entries(listed, 0, 0, k)
                targets = elements.targets[t]
                p = own_stress(elements, t, mu, lam, stride, u)
            f0, f1, f2, f3 = nodal_forces(elements, t, p)
            add_neighbours(f, targets, f0, f1, f2, f3)
            k += lanes
        begin += warps * each
    leave(listed, threads // LIST_BLOCK)


@wp.kernel(enable_backward=False, grid_stride=False)
def repair_listed_shared(
    # In
    threads: int,
    first: wp.array[wp.int32],
    roots: ForestElements,
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
    u: wp.array[wp.vec4],
    # In and out
    listed: LeftOut,
    # Out
    f: wp.array[wp.vec4],
):
    """Every leaf of a listed subtree with the rotation of the subtree's root, a thread a leaf; launch as the other."""
    count = listed.counts[0]
    if count == 0:
        return
    i = wp.tid()
    while i < count * LEAVES:
        s = listed.entries[i // LEAVES][0]
        t = first[s] + i % LEAVES
        r = root_rotation(roots, s, u) * frame(elements, t)
        scatter_turned(elements, t, r, mu[t * stride], lam[t * stride], u, f)
        i += threads
    leave(listed, threads // LIST_BLOCK)


# --- by bytes, in order ---------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def repair_own(
    # In
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
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
            scatter_own(elements, t, mu, lam, stride, u, f)
        leaf += 1


@wp.kernel(enable_backward=False)
def repair_shared(
    # In
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    roots: ForestElements,
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    stride: int,
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
                scatter_turned(elements, t, rotation * frame(elements, t), mu[t * stride], lam[t * stride], u, f)
                leaf += 1
        member += 1
