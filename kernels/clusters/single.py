"""Forces of elements in clusters, on CUDA: a cluster's nodes are in shared memory, and each is read once and added to
once.

A thread block takes a stretch of elements that follow one another in the order of the tree and so share most of their
nodes: half a node an element is left of four. Threads write their elements' four forces to slots; then each sums up to
eight slots of a node, and adds the sum to memory. Displacements and forces are read and written 16
bytes at once.

These kernels compute the leaves of forests that change, whose clusters are found on the device (``tables``). Meshes
that do not change use pairs (``pairs``).
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ADD_FORCE
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.stepping.block_memory import LOAD, STORE
from warp_corot.kernels.stepping.threads import number_in, synchronize_block
from warp_corot.kernels.tables.block_layout import NUMBERS
from warp_corot.kernels.tables.cluster_layout import DEFAULT_LAYOUT, QUAD_BYTES, ClusterLayout

from .elements import AlignedElements, element_forces, element_gradient, material_scale, number_of, shape_word

wp.set_module_options({"enable_backward": False})

vec2ul = wp.types.vector(length=2, dtype=wp.uint64)


@wp.struct
class Clusters:
    """Elements by clusters."""

    count: wp.array[wp.int32]  # [1] elements
    elements: wp.array[wp.int32]  # [count] which of a mesh's elements
    corners: wp.array[wp.uint64]  # [count] which of the cluster's nodes its four are, in bytes
    begin: wp.array[wp.int32]  # [clusters] where a cluster's tasks begin
    task_count: wp.array[wp.int32]  # [clusters] how many there are
    node_count: wp.array[wp.int32]  # [clusters]
    nodes: wp.array[wp.int32]  # [tasks] a cluster's nodes; those with more slots come again after all of these
    slots: wp.array[vec2ul]  # [tasks] eight slots each, the zero one past the last, in bytes


# Arrays here are contiguous. Warp does not know that, so these functions save some hundred instructions for addresses.


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 a = ((const float4*)vectors.data)[i];
    return wp::vec_t<3, wp::float32>(a.x, a.y, a.z);
#else
    return wp::vec_t<3, wp::float32>(vectors.data[i][0], vectors.data[i][1], vectors.data[i][2]);
#endif
""")
def vector_of(vectors: wp.array[wp.vec4], i: int) -> wp.vec3: ...


@wp.func_native("return words.data[i];")
def word_of(words: wp.array[wp.uint64], i: int) -> wp.uint64: ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const ulonglong2 pair = ((const ulonglong2*)pairs.data)[i];
    return wp::vec_t<2, wp::uint64>(pair.x, pair.y);
#else
    return pairs.data[i];
#endif
""")
def pair_of(pairs: wp.array[vec2ul], i: int) -> vec2ul: ...


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


def slot_sum(slot: wp.Function, zero: int) -> wp.Function:
    """The sum of eight slots; ``zero`` is the number of the one that is always zero."""
    # The word of four slots that are all that one.
    nothing = sum(QUAD_BYTES * zero << 16 * k for k in range(NUMBERS))

    @wp.func
    def slot_sum(words: vec2ul):
        force = wp.vec3()
        for k in range(wp.static(NUMBERS)):
            force += slot(wp.static(LOAD), number_in(words[0], k), force)
        if words[1] != wp.static(wp.uint64(nothing)):
            for k in range(wp.static(NUMBERS)):
                force += slot(wp.static(LOAD), number_in(words[1], k), force)
        return force

    return slot_sum


@functools.cache
def scatter_clusters(law: wp.Function, layout: ClusterLayout = DEFAULT_LAYOUT) -> wp.Kernel:
    """Add the nodal forces of a law to f; launch with block_dim ``layout.threads`` and whole blocks.

    Args:
        law: A function of ``laws`` for isotropic materials.
    """
    threads, size, corners = layout.threads, layout.elements, layout.corners
    displacement, slot = shared_quads(corners, "displacements"), shared_quads(corners + 1, "forces")
    sum_of = slot_sum(slot, corners)

    # Code out of line runs rarely and must not take registers from the rest.
    @unique_kernel(grid_stride=False, launch_bounds=(threads, layout.resident))
    def scatter_clusters(
        # In
        clusters: Clusters,
        elements: AlignedElements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        i = wp.tid()
        cluster = i // wp.static(threads)
        thread = i % wp.static(threads)
        begin = number_of(clusters.begin, cluster)
        count = number_of(clusters.task_count, cluster)
        node_count = number_of(clusters.node_count, cluster)
        words = vec2ul()
        node = int(0)
        if wp.static(layout.early) and thread < count:
            words = pair_of(clusters.slots, begin + thread)
            node = number_of(clusters.nodes, begin + thread)
        place = int(thread)
        while place < node_count:
            displacement(
                wp.static(STORE), wp.static(QUAD_BYTES) * place, vector_of(u, number_of(clusters.nodes, begin + place))
            )
            place += wp.static(threads)
        if thread == 0:
            slot(wp.static(STORE), wp.static(QUAD_BYTES * corners), wp.vec3())
        synchronize_block()
        element_count = number_of(clusters.count, 0)
        for k in range(wp.static(layout.each)):
            at = thread + wp.static(threads * k)
            t = cluster * wp.static(size) + at
            if t < element_count:
                word = word_of(clusters.corners, t)
                shape = shape_word(elements, t)
                w = element_gradient(
                    elements,
                    t,
                    shape,
                    displacement(wp.static(LOAD), number_in(word, 0), wp.vec3()),
                    displacement(wp.static(LOAD), number_in(word, 1), wp.vec3()),
                    displacement(wp.static(LOAD), number_in(word, 2), wp.vec3()),
                    displacement(wp.static(LOAD), number_in(word, 3), wp.vec3()),
                )
                p = law(material, clusters.elements, t, material_scale(elements, t, shape), w)
                f0, f1, f2, f3 = element_forces(elements, t, shape, p)
                slot(wp.static(STORE), wp.static(QUAD_BYTES) * at, f0)
                slot(wp.static(STORE), wp.static(QUAD_BYTES) * (at + wp.static(size)), f1)
                slot(wp.static(STORE), wp.static(QUAD_BYTES) * (at + wp.static(2 * size)), f2)
                slot(wp.static(STORE), wp.static(QUAD_BYTES) * (at + wp.static(3 * size)), f3)
        synchronize_block()
        place = int(thread)
        while place < count:
            if place >= wp.static(threads if layout.early else 0):
                words = pair_of(clusters.slots, begin + place)
                node = number_of(clusters.nodes, begin + place)
            add_sum(f, node, sum_of(words))
            place += wp.static(threads)

    return scatter_clusters
