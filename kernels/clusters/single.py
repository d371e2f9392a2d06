"""Elements of a forest that changes in clusters, on CUDA, one by one: each has its own axes, and a cluster's nodes meet
in shared memory; see ``pairs``.

These kernels compute the leaves of forests that change, whose clusters are found on the device (``single_tables``).
Meshes that do not change use pairs.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import LEVEL_MASK
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import column
from warp_corot.kernels.stepping.block_memory import LOAD, STORE
from warp_corot.kernels.stepping.threads import number_in, synchronize_block
from warp_corot.kernels.tables.cluster_layout import DEFAULT_LAYOUT, NUMBERS, QUAD_BYTES, ClusterLayout
from warp_corot.kernels.tables.shapes import MIRROR_BIT, VOLUME

from .pairs import add_sum, number_of, shared_quads, vector_of

wp.set_module_options({"enable_backward": False})

# --- elements on their axes ------------------------------------------------------------------------------------------
#
# On suitable axes, which are those of the lattice in some order and direction, an element of a forest has the
# displacement gradient W = (D0, D1, D2) / h with
#     D0 = u1 - u0,  D1 = (u2 - u1) + [type 2] (u2 - u0),  D2 = (1 + [type 2]) (u3 - u2) + [type 1] (u3 - u0),
# nodes in Maubach order: the columns of ``tables.shapes.GRADIENT``, but for type 2 half their sum and difference, which
# turns its two diagonals into an edge and the height on it. One integer says which axes these are. Isotropic laws give
# the same result in right- and left-handed axes.

# An element's integer: its type; which components of vectors trade places, one pair after another, in its axes' order;
# which axes point backwards; and how many times its cube's edge was halved.
IS_TYPE1, IS_TYPE2 = wp.constant(1), wp.constant(2)
SWAPS = (4, 8, 16)
SWAP_XY, SWAP_YZ, SWAP_XY_AGAIN = (wp.constant(bit) for bit in SWAPS)
BACKWARDS = (32, 64, 128)
BACKWARDS_X, BACKWARDS_Y, BACKWARDS_Z = (wp.constant(bit) for bit in BACKWARDS)
HALVINGS_SHIFT = wp.constant(8)


@wp.struct
class AlignedElements:
    """Elements of a forest, in the order of their clusters."""

    shape: wp.array[wp.int32]  # [T] see above
    cell: float  # edge length of a root cube [m]
    inverse_cell: float


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __int_as_float((n + 127) << 23);
#else
    return ldexpf(1.0f, n);
#endif
""")
def power_of_two(n: int) -> float: ...


@wp.func
def to_axes(v: wp.vec3, shape: int):
    """A vector's components in the order of the element's axes."""
    swaps = (shape & SWAP_XY) != 0
    x, y, z = wp.where(swaps, v[1], v[0]), wp.where(swaps, v[0], v[1]), v[2]
    swaps = (shape & SWAP_YZ) != 0
    y, z = wp.where(swaps, z, y), wp.where(swaps, y, z)
    swaps = (shape & SWAP_XY_AGAIN) != 0
    return wp.vec3(wp.where(swaps, y, x), wp.where(swaps, x, y), z)


@wp.func
def from_axes(v: wp.vec3, shape: int):
    """The opposite of ``to_axes``."""
    swaps = (shape & SWAP_XY_AGAIN) != 0
    x, y, z = wp.where(swaps, v[1], v[0]), wp.where(swaps, v[0], v[1]), v[2]
    swaps = (shape & SWAP_YZ) != 0
    y, z = wp.where(swaps, z, y), wp.where(swaps, y, z)
    swaps = (shape & SWAP_XY) != 0
    return wp.vec3(wp.where(swaps, y, x), wp.where(swaps, x, y), z)


@wp.func
def one_if(shape: int, bit: int):
    return wp.where((shape & bit) != 0, 1.0, 0.0)


@wp.func
def directions(shape: int, length: float):
    """The same length along each axis, negative where the axis points backwards."""
    return wp.vec3(
        wp.where((shape & BACKWARDS_X) != 0, -length, length),
        wp.where((shape & BACKWARDS_Y) != 0, -length, length),
        wp.where((shape & BACKWARDS_Z) != 0, -length, length),
    )


@wp.func
def rows_times(d: wp.vec3, c0: wp.vec3, c1: wp.vec3, c2: wp.vec3):
    """diag(d) (c0, c1, c2)."""
    return wp.matrix_from_cols(wp.cw_mul(d, c0), wp.cw_mul(d, c1), wp.cw_mul(d, c2))


@wp.func
def shape_word(elements: AlignedElements, t: int):
    return number_of(elements.shape, t)


@wp.func
def element_gradient(elements: AlignedElements, t: int, shape: int, u0: wp.vec3, u1: wp.vec3, u2: wp.vec3, u3: wp.vec3):
    """The displacement gradient of element t in its axes, from its nodes' displacements."""
    type1, type2 = one_if(shape, IS_TYPE1), one_if(shape, IS_TYPE2)
    d0 = u1 - u0
    d1 = (u2 - u1) + type2 * (u2 - u0)
    d2 = (1.0 + type2) * (u3 - u2) + type1 * (u3 - u0)
    inverse_h = elements.inverse_cell * power_of_two(shape >> HALVINGS_SHIFT)
    return rows_times(directions(shape, inverse_h), to_axes(d0, shape), to_axes(d1, shape), to_axes(d2, shape))


@wp.func
def material_scale(elements: AlignedElements, t: int, shape: int):
    """The factor that stresses need before ``element_forces``: V / h."""
    h = elements.cell * power_of_two(-(shape >> HALVINGS_SHIFT))
    volume = wp.where((shape & IS_TYPE1) != 0, wp.static(VOLUME[1]), wp.static(VOLUME[0]))
    return wp.where((shape & IS_TYPE2) != 0, wp.static(VOLUME[2]), volume) * (h * h)


@wp.func
def element_forces(elements: AlignedElements, t: int, shape: int, p: wp.mat33):
    """The four nodes' forces from the scaled first Piola-Kirchhoff stress in the element's axes."""
    type1, type2 = one_if(shape, IS_TYPE1), one_if(shape, IS_TYPE2)
    d = directions(shape, 1.0)
    p0 = from_axes(wp.cw_mul(d, column(p, 0)), shape)
    p1 = from_axes(wp.cw_mul(d, column(p, 1)), shape)
    p2 = from_axes(wp.cw_mul(d, column(p, 2)), shape)
    f0 = p0 + type2 * p1 + type1 * p2
    f1 = p1 - p0
    f3 = -(1.0 + type2 + type1) * p2
    return f0, f1, -(f0 + f1 + f3), f3


@wp.kernel(enable_backward=False)
def align_elements(
    # In
    goes: wp.array[wp.int32],
    count: wp.array[wp.int32],
    code: wp.array[wp.int32],
    words: wp.array[wp.int32],
    # Out
    shape: wp.array[wp.int32],
):
    """Find the integers of elements from their shape codes, if ``goes`` is not zero.

    ``words`` has those of all frames, mirrored or not, and types; see ``discretization.clusters.axis_words``.
    """
    i = wp.tid()
    if goes[0] != 0 and i < count[0]:
        level = code[i] & LEVEL_MASK
        shape[i] = words[3 * (code[i] >> MIRROR_BIT) + level % 3] | ((level / 3) << HALVINGS_SHIFT)


# --- the kernel ------------------------------------------------------------------------------------------------------
#
# A thread block takes a stretch of elements that follow one another in the order of the tree and so share most of
# their nodes. Threads write their elements' four forces to slots; then each sums up to eight slots of a node, and adds
# the sum to memory.

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
    @law_kernel(grid_stride=False, launch_bounds=(threads, layout.resident))
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
