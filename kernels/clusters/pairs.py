"""Elements in pairs, in the form in which clusters read them: two elements that share a face have five nodes, not
eight.

The nodes of a pair are a, b and c of the face, then d of the first element and e of the second. An element's
displacement gradient is W = (ub - ua, uc - ua, ud - ua) B with the hat functions' gradients at b, c and d as rows of B.
One record describes a pair and is read 16 bytes at a time: the five nodes, and B twice. In a forest the
entries of B are whole numbers over the edge of a root cube, each of a power of two or zero, for which 16 bits are
enough. Where a second element is missing its B is zero, and so are its forces.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import ADD_FORCE
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import column
from warp_corot.kernels.stepping.block_memory import LOAD, STORE
from warp_corot.kernels.stepping.threads import synchronize_block
from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS, QUAD_BYTES, PairLayout

wp.set_module_options({"enable_backward": False})

# --- memory -----------------------------------------------------------------------------------------------------------
#
# Contiguous arrays on the device, and vectors in a thread block's shared memory. Warp does not know that arrays are
# contiguous, so these functions save some hundred instructions for addresses.


@wp.func_native("return numbers.data[i];")
def number_of(numbers: wp.array[wp.int32], i: int) -> int: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 a = ((const float4*)vectors.data)[i];
    return wp::vec_t<3, wp::float32>(a.x, a.y, a.z);
#else
    return wp::vec_t<3, wp::float32>(vectors.data[i][0], vectors.data[i][1], vectors.data[i][2]);
#endif
""")
def vector_of(vectors: wp.array[wp.vec4], i: int) -> wp.vec3: ...


@wp.func_native(ADD_FORCE.replace("wp::index(f, node)", "f.data[node]"))
def add_sum(f: wp.array[wp.vec4], node: int, force: wp.vec3): ...


def shared_quads(count: int, tag: str) -> wp.Function:
    """An array of vectors in shared memory, 16 bytes each, as one function that reads or writes it by bytes."""
    snippet = f"""
#if defined(__CUDA_ARCH__)
    // {tag}
    __shared__ float4 memory[{count}];
    float4* at = (float4*)((char*)memory + i);
    if (access == {STORE}) {{
        *at = make_float4(value[0], value[1], value[2], 0.0f);
        return value;
    }}
    const float4 a = *at;
    return wp::vec_t<3, wp::float32>(a.x, a.y, a.z);
#else
    return value;
#endif
"""

    @wp.func_native(snippet)
    def memory(access: int, i: int, value: wp.vec3) -> wp.vec3: ...

    return memory


# --- pairs -----------------------------------------------------------------------------------------------------------

vec4u = wp.types.vector(length=4, dtype=wp.uint32)
lattice_record = wp.types.vector(length=12, dtype=wp.uint32)
general_record = wp.types.vector(length=24, dtype=wp.uint32)

#: Words of a record. Two 16-bit numbers a word: nodes a to e in bytes, and, of elements of a forest, the exponents of
#: their volumes, 8 bits each. Then B of both, row by row; of general elements, their volumes.
LATTICE_WORDS, GENERAL_WORDS = 12, 24
FIRST_MATRIX, GENERAL_VOLUMES = 3, 21


@wp.struct
class LatticePairs:
    """Pairs of a forest's elements."""

    records: wp.array[vec4u]  # [3 * count], the first four words of all, then the next
    count: int
    inverse_cell: float  # of a root cube's edge length [1/m]
    scale: float  # a sixth of its square [m^2]


@wp.struct
class GeneralPairs:
    """Pairs of any elements."""

    records: wp.array[vec4u]  # [6 * count]
    count: int


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const uint4 a = ((const uint4*)records.data)[i];
    return wp::vec_t<4, wp::uint32>(a.x, a.y, a.z, a.w);
#else
    return records.data[i];
#endif
""")
def quad_of(records: wp.array[vec4u], i: int) -> vec4u: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __uint_as_float(word);
#else
    float number;
    memcpy(&number, &word, 4);
    return number;
#endif
""")
def as_float(word: wp.uint32) -> float: ...


@wp.func
def record_of(pairs: LatticePairs, i: int):
    record = lattice_record()
    for k in range(3):
        quad = quad_of(pairs.records, k * pairs.count + i)
        for j in range(4):
            record[4 * k + j] = quad[j]
    return record


@wp.func
def record_of(pairs: GeneralPairs, i: int):
    record = general_record()
    for k in range(6):
        quad = quad_of(pairs.records, k * pairs.count + i)
        for j in range(4):
            record[4 * k + j] = quad[j]
    return record


@wp.func
def half_word(record: Any, k: int):
    """The k-th 16-bit number."""
    word = record[k // 2]
    if k % 2 == 1:
        word = word >> wp.uint32(16)
    return int(word & wp.uint32(0xFFFF))


@wp.func_native("""
    const wp::uint32 bits = word & 0xffff0000u;
#if defined(__CUDA_ARCH__)
    return __uint_as_float(bits);
#else
    float number;
    memcpy(&number, &bits, 4);
    return number;
#endif
""")
def upper_half(word: wp.uint32) -> float: ...


@wp.func
def lower_half(word: wp.uint32):
    return as_float(word << wp.uint32(16))


@wp.func
def scaled_difference(pairs: LatticePairs, difference: wp.vec3):
    """A difference of displacements in the units of B's inverse. Scaled earlier, it would lose digits."""
    return pairs.inverse_cell * difference


@wp.func
def scaled_difference(pairs: GeneralPairs, difference: wp.vec3):
    return difference


@wp.func
def first_matrix(record: lattice_record):
    """B of the first element."""
    return wp.mat33(
        lower_half(record[3]), upper_half(record[3]), lower_half(record[4]),
        upper_half(record[4]), lower_half(record[5]), upper_half(record[5]),
        lower_half(record[6]), upper_half(record[6]), lower_half(record[7]),
    )  # fmt: skip


@wp.func
def second_matrix(record: lattice_record):
    """B of the second element."""
    return wp.mat33(
        upper_half(record[7]), lower_half(record[8]), upper_half(record[8]),
        lower_half(record[9]), upper_half(record[9]), lower_half(record[10]),
        upper_half(record[10]), lower_half(record[11]), upper_half(record[11]),
    )  # fmt: skip


@wp.func
def first_matrix(record: general_record):
    return wp.mat33(
        as_float(record[3]), as_float(record[4]), as_float(record[5]),
        as_float(record[6]), as_float(record[7]), as_float(record[8]),
        as_float(record[9]), as_float(record[10]), as_float(record[11]),
    )  # fmt: skip


@wp.func
def second_matrix(record: general_record):
    return wp.mat33(
        as_float(record[12]), as_float(record[13]), as_float(record[14]),
        as_float(record[15]), as_float(record[16]), as_float(record[17]),
        as_float(record[18]), as_float(record[19]), as_float(record[20]),
    )  # fmt: skip


@wp.func
def first_scale(pairs: LatticePairs, record: lattice_record):
    """The factor that turns the first element's stress times the transpose of B into forces: its volume."""
    return pairs.scale * as_float(((record[2] >> wp.uint32(16)) & wp.uint32(0xFF)) << wp.uint32(23))


@wp.func
def second_scale(pairs: LatticePairs, record: lattice_record):
    return pairs.scale * as_float((record[2] >> wp.uint32(24)) << wp.uint32(23))


@wp.func
def first_scale(pairs: GeneralPairs, record: general_record):
    return as_float(record[wp.static(GENERAL_VOLUMES)])


@wp.func
def second_scale(pairs: GeneralPairs, record: general_record):
    return as_float(record[wp.static(GENERAL_VOLUMES + 1)])


@functools.cache
def pair_forces(law: wp.Function, given: bool = False) -> wp.Function:
    """Forces on the five nodes of the i-th pair from their displacements, by a law of ``laws``.

    If ``given``, the law takes one more number, which the caller has for each element.
    """

    @wp.func
    def pair_forces(
        pairs: Any,
        record: Any,
        material: Any,
        listed: wp.array[wp.int32],
        i: int,
        ua: wp.vec3,
        ub: wp.vec3,
        uc: wp.vec3,
        ud: wp.vec3,
        ue: wp.vec3,
        first: float,
        second: float,
    ):
        e1 = scaled_difference(pairs, ub - ua)
        e2 = scaled_difference(pairs, uc - ua)
        b = first_matrix(record)
        w = wp.matrix_from_cols(e1, e2, scaled_difference(pairs, ud - ua)) * b
        if wp.static(given):
            h = law(material, listed, 2 * i, first_scale(pairs, record), w, first) * wp.transpose(b)
        else:
            h = law(material, listed, 2 * i, first_scale(pairs, record), w) * wp.transpose(b)
        f1, f2, f3 = -column(h, 0), -column(h, 1), -column(h, 2)
        b = second_matrix(record)
        w = wp.matrix_from_cols(e1, e2, scaled_difference(pairs, ue - ua)) * b
        if wp.static(given):
            h = law(material, listed, 2 * i + 1, second_scale(pairs, record), w, second) * wp.transpose(b)
        else:
            h = law(material, listed, 2 * i + 1, second_scale(pairs, record), w) * wp.transpose(b)
        f1 -= column(h, 0)
        f2 -= column(h, 1)
        f4 = -column(h, 2)
        return -(f1 + f2 + f3 + f4), f1, f2, f3, f4

    return pair_forces


# --- the kernel ------------------------------------------------------------------------------------------------------
#
# Forces of pairs of elements in clusters, on CUDA: a cluster's nodes are in shared memory, and each is read once and
# added to once.
#
# A thread block takes a stretch of elements that follow one another in the order of the tree and so share most of
# their nodes: half a node an element is left of four. Threads write their elements' forces to slots; then each sums
# up the slots of a node, and adds the sum to memory. Displacements and forces are read and written 16 bytes at once.
#
# The time of such a kernel is not arithmetic but waiting, so no thread looks anything up on the way. Each thread has
# a pair and a task: a node that it reads, and up to twelve slots of that node that it adds up. It reads both at once,
# at the beginning. A cluster has no more pairs or tasks than threads. Nodes of more slots have several tasks.

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
    @law_kernel(grid_stride=False, launch_bounds=(threads, layout.resident))
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
