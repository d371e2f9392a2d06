"""Forces of pairs of elements in clusters, on CUDA: a cluster's nodes are in shared memory, and each is read once and
added to once.

A thread block takes a stretch of elements that follow one another in the order of the tree and so share most of their
nodes: half a node an element is left of four. Threads write their elements' forces to slots; then each sums up the
slots of a node, and adds the sum to memory. Displacements and forces are read and written 16 bytes at once.

The time of such a kernel is not arithmetic but waiting, so no thread looks anything up on the way. Each thread has a
pair and a task: a node that it reads, and up to twelve slots of that node that it adds up. It reads both at once, at
the beginning. A cluster has no more pairs or tasks than threads. Nodes of more slots have several tasks.
"""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.stepping.block_memory import LOAD, STORE
from warp_corot.kernels.stepping.threads import synchronize_block
from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS, QUAD_BYTES, PairLayout

from .pair_elements import (
    GENERAL_WORDS,
    LATTICE_WORDS,
    GeneralPairs,
    LatticePairs,
    add_sum,
    half_word,
    number_of,
    pair_forces,
    quad_of,
    record_of,
    shared_quads,
    vec4u,
    vector_of,
)

wp.set_module_options({"enable_backward": False})

#: Slots in a word, of so many bits each, words of a task, and its slots.
WORD_SLOTS, SLOT_BITS, TASK_WORDS = 3, 10, 4
PAIR_TASK_SLOTS = WORD_SLOTS * TASK_WORDS
SLOT_MASK = (1 << SLOT_BITS) - 1


@wp.struct
class PairClusters:
    """Pairs by clusters, in the order of the threads."""

    elements: wp.array[wp.int32]  # [2 * threads] which of a mesh's elements a pair is of
    nodes: wp.array[wp.int32]  # [threads] the task's node, -1: there is none; a node's first task is its place
    slots: wp.array[vec4u]  # [threads] its slots, those that it has not are zero slots


@wp.func
def slot_of(word: wp.uint32, k: int):
    """The k-th slot in a word."""
    return int((word >> wp.uint32(SLOT_BITS * k)) & wp.uint32(SLOT_MASK))


def slot_sum(slot: wp.Function, zero: int) -> wp.Function:
    """The sum of a task's slots. Words of zero slots only are skipped, except the first word."""
    nothing = sum(zero << SLOT_BITS * k for k in range(WORD_SLOTS))

    @wp.func
    def slot_sum(words: vec4u):
        force = wp.vec3()
        for j in range(wp.static(TASK_WORDS)):
            if wp.static(j == 0) or words[j] != wp.static(wp.uint32(nothing)):
                for k in range(wp.static(WORD_SLOTS)):
                    force += slot(wp.static(LOAD), wp.static(QUAD_BYTES) * slot_of(words[j], k), force)
        return force

    return slot_sum


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("prefetch.global.L2 [%0];" :: "l"(quads.data + i));
#endif
""")
def fetch_quad(quads: wp.array[vec4u], i: int):
    """Fetch into the second-level cache an entry that another block will soon read."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    asm volatile("prefetch.global.L2 [%0];" :: "l"(numbers.data + i));
#endif
""")
def fetch_number(numbers: wp.array[wp.int32], i: int): ...


@functools.cache
def fetch_records(Pairs: type) -> wp.Function:
    """Fetch the node and the record of the i-th thread, if there is one."""
    quads = {LatticePairs: LATTICE_WORDS // 4, GeneralPairs: GENERAL_WORDS // 4}[Pairs]

    @wp.func
    def fetch_records(clusters: PairClusters, pairs: Pairs, i: int):
        if i < clusters.nodes.shape[0]:
            fetch_number(clusters.nodes, i)
            for k in range(wp.static(quads)):
                fetch_quad(pairs.records, k * pairs.count + i)

    return fetch_records


@functools.cache
def scatter_pairs(
    Pairs: type, Material: type, law: wp.Function, layout: PairLayout, given: wp.Function | None = None
) -> wp.Kernel:
    """Add the nodal forces of a law to f; launch with block_dim ``layout.threads`` and whole blocks.

    Args:
        Pairs: ``LatticePairs`` or ``GeneralPairs``, in the order of the clusters, one for each thread.
        Material: The material of a law; law: a function of ``laws`` that takes it.
        given: Looks up a number that the law takes of the i-th element, early.
    """
    threads, zero = layout.threads, layout.zero
    displacement = shared_quads(threads, "displacements")
    slot = shared_quads(zero + BANK_GROUPS, "forces")
    forces, sum_of, fetch = pair_forces(law, given is not None), slot_sum(slot, zero), fetch_records(Pairs)

    # Code out of line runs rarely and must not take registers from the rest.
    @unique_kernel(grid_stride=False, launch_bounds=(threads, layout.resident))
    def scatter_pairs(
        # In
        clusters: PairClusters,
        pairs: Pairs,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        i = wp.tid()
        thread = i % wp.static(threads)
        node = number_of(clusters.nodes, i)
        record = record_of(pairs, i)
        words = quad_of(clusters.slots, i)
        first = float(0.0)
        second = float(0.0)
        if wp.static(given is not None):
            first = given(material, 2 * i)
            second = given(material, 2 * i + 1)
        if wp.static(layout.ahead > 0):
            later = i + wp.static(layout.ahead * threads)
            fetch(clusters, pairs, later)
            if later < clusters.nodes.shape[0]:
                fetch_quad(clusters.slots, later)
        at = wp.static(QUAD_BYTES) * thread
        if node >= 0:
            displacement(wp.static(STORE), at, vector_of(u, node))
        if thread < wp.static(BANK_GROUPS):
            slot(wp.static(STORE), at + wp.static(QUAD_BYTES * zero), wp.vec3())
        synchronize_block()
        fa, fb, fc, fd, fe = forces(
            pairs,
            record,
            material,
            clusters.elements,
            i,
            displacement(wp.static(LOAD), half_word(record, 0), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 1), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 2), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 3), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 4), wp.vec3()),
            first,
            second,
        )
        slot(wp.static(STORE), at, fa)
        slot(wp.static(STORE), at + wp.static(QUAD_BYTES * threads), fb)
        slot(wp.static(STORE), at + wp.static(2 * QUAD_BYTES * threads), fc)
        slot(wp.static(STORE), at + wp.static(3 * QUAD_BYTES * threads), fd)
        slot(wp.static(STORE), at + wp.static(4 * QUAD_BYTES * threads), fe)
        synchronize_block()
        if wp.static(not layout.early):
            words = quad_of(clusters.slots, i)
        if node >= 0:
            add_sum(f, node, sum_of(words))

    return scatter_pairs
