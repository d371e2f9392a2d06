"""Forces of the leaves that a block of the subtree kernels left out, by the block itself, a thread a leaf (CUDA).

A warp takes as long for one leaf as for 32, so a list in shared memory collects the leaves of all warps of a block.
"""

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ForestElements, nodal_forces

from .left_out import LEAVES, WARP
from .repair import add_pairs, own_stress

wp.set_module_options({"enable_backward": False})

#: Threads of a block of the subtree kernels.
SUBTREE_BLOCK = 128
#: The actions of ``leaves_of_block``.
COLLECT, LEAF, FIRST, MARK, MARKED = range(5)
#: Set in a list's entry if its subtree asks which leaves the subtree kernels would leave out.
ASKS = 1 << 15


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    __shared__ unsigned short leaves[{SUBTREE_BLOCK * LEAVES}];
    __shared__ int firsts[{SUBTREE_BLOCK}], marked[{SUBTREE_BLOCK}], count;
    if (what == {LEAF}) return leaves[value];
    if (what == {FIRST}) return firsts[value];
    if (what == {MARK}) return atomicOr(marked + value / {LEAVES}, 1 << value % {LEAVES});
    if (what == {MARKED}) {{
        __syncthreads();
        return marked[threadIdx.x];
    }}
    if (threadIdx.x == 0) count = 0;
    if (!__syncthreads_or(value != 0)) return 0;
    const int lane = threadIdx.x % {WARP};
    const unsigned all = to_come + lane >= {WARP} ? 0xffffffffu : (1u << (to_come + lane)) - 1;
    const int last = __popc(all) - 1, asks = first < 0 ? {ASKS} : 0;
    int end = __popc(value);
    int at = -end;
    for (int step = 1; step < {WARP}; step *= 2) {{
        const int before = __shfl_up_sync(all, end, step);
        if (lane >= step) end += before;
    }}
    int begin = 0;
    if (lane == last && end != 0) begin = atomicAdd(&count, end);
    at += end + __shfl_sync(all, begin, last);
    for (int mask = value; mask != 0; mask &= mask - 1)
        leaves[at++] = asks | ({LEAVES} * threadIdx.x + __ffs(mask) - 1);
    firsts[threadIdx.x] = first < 0 ? ~first : first;
    marked[threadIdx.x] = 0;
    __syncthreads();
    return count;
#else
    static int own[{LEAVES}], of, marks;
    if (what == {LEAF}) return own[value];
    if (what == {FIRST}) return of;
    if (what == {MARK}) return marks |= 1 << value % {LEAVES};
    if (what == {MARKED}) return marks;
    int at = 0;
    for (int leaf = 0; leaf < {LEAVES}; ++leaf)
        if ((value >> leaf) & 1) own[at++] = leaf | (first < 0 ? {ASKS} : 0);
    of = first < 0 ? ~first : first;
    marks = 0;
    return at;
#endif
""")
def leaves_of_block(what: int, value: int, first: int, to_come: int) -> int:
    """A block's list of leaves, as one function. On the CPU a block is one thread.

    Args:
        what: The action:
            ``COLLECT``: list the leaves of the mask ``value`` of each thread's subtree, and return the number of all.
            ``first`` is the subtree's first leaf, or its complement if the subtree asks. All threads must call this
            together.
            ``LEAF``: return entry ``value`` of the list: eight times its thread's place in the block, plus the leaf's
            number in its subtree, plus ``ASKS`` if the subtree asks.
            ``FIRST``: return the first leaf of the subtree of thread ``value``.
            ``MARK``: mark the leaf of entry ``value``.
            ``MARKED``: return the mask of marked leaves of this thread's subtree. All threads must call this together.
        value, first: As ``what`` says.
        to_come: The number of threads from this one on, in all blocks.
    """
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return threadIdx.x;
#else
    return 0;
#endif
""")
def thread_of() -> int:
    """The place of this thread in its block."""
    ...


@wp.func_native(f"""
#if defined(__CUDA_ARCH__)
    const int threads = to_come + threadIdx.x;
    return threads < {SUBTREE_BLOCK} ? threads : {SUBTREE_BLOCK};
#else
    return 1;
#endif
""")
def threads_of(to_come: int) -> int:
    """The threads of a block; the last one may have fewer."""
    ...


@wp.func
def scatter_in_block(
    elements: ForestElements,
    first: int,
    mask: int,
    asks: bool,
    to_come: int,
    material: IsotropicMaterial,
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
):
    """Add the forces of the leaves in the masks of a block's subtrees, a thread a leaf.

    Args:
        elements: All leaves.
        first: First leaf of this thread's subtree.
        mask: The leaves of this thread's subtree to compute, a bit each.
        asks: Whether to find out which leaves the subtree kernels would leave out; the mask must then have all leaves.
        to_come: Number of threads from this one on.
        material, u: As in ``own_stress``.
        f: Forces [N].

    Returns:
        The mask; if the subtree asks, the mask of the leaves that the subtree kernels would leave out.
    """
    found = int(mask)
    total = leaves_of_block(wp.static(COLLECT), mask, wp.where(asks, ~first, first), to_come)
    if total > 0:
        threads = threads_of(to_come)
        k = thread_of()
        # All threads of a warp stay together, because ``add_pairs`` sums the forces of neighbours.
        while k - k % WARP < total:
            targets = wp.vec4i(-1, -1, -1, -1)
            t = int(0)
            p = wp.mat33()
            if k < total:
                leaf = leaves_of_block(wp.static(LEAF), k, 0, 0)
                place = leaf & wp.static(ASKS - 1)
                t = leaves_of_block(wp.static(FIRST), place // LEAVES, 0, 0) + place % LEAVES
                targets = elements.targets[t]
                p, trusted = own_stress(elements, t, material, u)
                if leaf >= wp.static(ASKS) and not trusted:
                    leaves_of_block(wp.static(MARK), place, 0, 0)
            f0, f1, f2, f3 = nodal_forces(elements, t, p)
            add_pairs(f, targets, f0, f1, f2, f3)
            k += threads
        marked = leaves_of_block(wp.static(MARKED), 0, 0, 0)
        if asks:
            found = marked
    return found
