"""Lists of the subtrees with leaves that the subtree kernels left out; see ``degenerate``."""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from warp_corot.kernels.corotated.corotated import corotated_stress
from warp_corot.kernels.corotated.tangent import keep_gradients
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, rotated_stress
from warp_corot.kernels.elements.elements import (
    ForestElements,
    GeneralElements,
    add_four_forces,
    frame,
    gradient_of_code,
    local_gradient,
    nodal_forces,
    node_displacements,
    scatter_stress,
    shape_of,
)
from warp_corot.kernels.elements.simd8 import LAW_HEADERS, law_kernel
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.math.rotation import rotation_out_of_line
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import FRAME_SHIFT

wp.set_module_options({"enable_backward": False, "extra_build_options": LAW_HEADERS})

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
    entries: wp.array[wp.vec2i]  # [LISTS room] first leaf of the subtree, and its mask


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


# --- forces of listed and flagged leaves -----------------------------------------------------------------------------
#
# Forces of the leaves that the subtree kernels left out, mostly flat or inverted ones, with a rotation that is right
# for every F.
#
# A byte for each subtree, with a bit for each leaf, says which these are. Those of a whole body on CUDA are also in
# lists (``DegenerateList``), which one launch of a fixed size processes. Elsewhere threads read the bytes of eight
# subtrees at a time, which are nearly always all zero; one thread, or one for each of the eight, adds their leaves.


#: Number of subtrees that one thread processes; the length of ``flagged`` is a multiple of it.
SUBTREES = 8

# More rounds would cost more arithmetic than the atomic additions that they save.
add_pairs = add_four_forces(1)


@wp.func
def is_degenerate(flags: wp.uint64, leaf: int):
    """Whether the ``leaf``-th of the 64 leaves of eight subtrees was left out."""
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
    """Add the forces of element t with a given rotation r from rest space."""
    q = frame(elements, t)
    m = material.mu[t * material.stride]
    k = material.lam[t * material.stride]
    scatter_stress(elements, t, rotated_stress(local_gradient(elements, t, u), q, r * q, m, k), f)


@wp.func(inline=False)
def stress_out_of_line(w: wp.mat33, mu: float, lam: float):
    return corotated_stress(w, mu, lam)


@wp.func
def robust_own_stress(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    """First Piola-Kirchhoff stress of element t with its own rotation, times Q, for any F."""
    q = frame(elements, t)
    w = wp.transpose(q) * local_gradient(elements, t, u)
    m = material.mu[t * material.stride]
    k = material.lam[t * material.stride]
    return q * stress_out_of_line(w, m, k)


@wp.func_native("return wp::index(nodes, t)[n];")
def node_of(nodes: wp.array[wp.vec4i], t: int, n: int) -> int: ...


@wp.func
def root_rotation(elements: ForestElements, places: wp.array2d[wp.vec2i], first: int, code: int, u: wp.array[wp.vec4]):
    """The rotation of a subtree as one element of a shape code; ``places`` has the leaf and the node of each of its
    nodes, by shape."""
    nodes = wp.vec4i(0)
    for n in range(4):
        place = places[shape_of(code), n]
        nodes[n] = node_of(elements.nodes, first + place[0], place[1])
    u0, u1, u2, u3 = node_displacements(nodes, u)
    q = elements.frames[code >> FRAME_SHIFT]
    return rotation_out_of_line(q + gradient_of_code(elements, code, u0, u1, u2, u3)) * wp.transpose(q)


# --- by a list ------------------------------------------------------------------------------------------------------


@law_kernel(grid_stride=False)
def repair_listed_own(
    # In
    threads: int,
    elements: ForestElements,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    # In and out
    listed: DegenerateList,
    # Out
    f: wp.array[wp.vec4],
):
    """Add the forces of listed leaves, each with its own rotation, a thread a leaf.

    Forces of neighbours are added up before they go to memory. Launch with block_dim LIST_BLOCK and ``threads``
    threads, a multiple of LIST_BLOCK, or one.
    """
    if not any_degenerate(listed):
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
            # All threads of a warp stay together, because ``add_pairs`` sums the forces of neighbours.
            while k - k % lanes < total:
                t = int(0)
                targets = wp.vec4i(-1, -1, -1, -1)
                p = wp.mat33()
                if k < total:
                    t = leaves_of_entries(listed, 0, 0, k)
                    targets = elements.targets[t]
                    p = robust_own_stress(elements, t, material, u)
                f0, f1, f2, f3 = nodal_forces(elements, t, p)
                add_pairs(f, targets, f0, f1, f2, f3)
                k += lanes
            begin += each_list * each
        list += at_a_time
    leave(listed, threads // LIST_BLOCK)


# --- by bytes, in order ---------------------------------------------------------------------------------------------


@functools.cache
def repair_flagged(Material: type, stress: wp.Function, kernel: Callable = law_kernel) -> wp.Kernel:
    """Add the forces of flagged leaves under a law of ``elements.forces`` that is right for every F.

    So many ``lanes`` share a word of 64 bits, one for each leaf of eight subtrees; nearly always all bits are zero. In
    one lane leaves come in order.
    """

    @kernel()
    def repair_flagged(
        # In
        lanes: int,
        flagged: wp.array[wp.uint64],
        first: wp.array[wp.int32],
        elements: ForestElements,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        i = wp.tid() // lanes
        flags = flagged[i]
        if flags == wp.uint64(0):
            return
        leaf = wp.tid() % lanes
        while leaf < SUBTREES * LEAVES:
            if is_degenerate(flags, leaf):
                t = first[SUBTREES * i + leaf // LEAVES] + leaf % LEAVES
                scatter_stress(elements, t, stress(elements, t, material, u), f)
            leaf += lanes

    return repair_flagged


@wp.kernel(enable_backward=False)
def turn_listed(
    # In
    elements: GeneralElements,
    u: wp.array[wp.vec4],
    # In and out
    listed: wp.array[wp.int32],
    # Out
    gradients: wp.array[wp.vec4],
):
    """Write the kept gradients of listed elements, by one thread, which empties the list; see
    ``corotated.tangent``."""
    for i in range(listed[0]):
        t = listed[i + 1]
        turn = rotation_out_of_line(identity3() + local_gradient(elements, t, u))
        keep_gradients(elements, t, turn, gradients)
    listed[0] = 0


@unique_kernel()
def repair_shared(
    # In
    lanes: int,
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    code: wp.array[wp.int32],
    places: wp.array2d[wp.vec2i],
    elements: ForestElements,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add the forces of flagged subtrees, all leaves of each with the rotation of its root; see ``repair_flagged``."""
    i = wp.tid() // lanes
    flags = flagged[i]
    if flags == wp.uint64(0):
        return
    leaf = wp.tid() % lanes
    rotation = wp.mat33()
    while leaf < SUBTREES * LEAVES:
        if is_degenerate(flags, leaf):
            s = SUBTREES * i + leaf // LEAVES
            if lanes > 1 or leaf % LEAVES == 0:
                rotation = root_rotation(elements, places, first[s], code[s], u)
            scatter_turned(elements, first[s] + leaf % LEAVES, rotation, material, u, f)
        leaf += lanes


#: Of corotated leaves with own rotations.
repair_own = repair_flagged(IsotropicMaterial, robust_own_stress, functools.partial(wp.kernel, enable_backward=False))
