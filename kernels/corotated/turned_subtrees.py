"""Products with R K R^T over complete subtrees of a forest, one thread a subtree; rotations are found once for many.

The rotations of a subtree's eight leaves are kept as quaternions, sixteen bytes a leaf. Ten values are read, eight
leaves multiplied in registers, and ten sums added up as in ``subtrees.memory``.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import ForestElements, Subtrees, frame, load_node, local_gradient, root_of
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.math.matrices import column
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.forces import mat10
from warp_corot.kernels.subtrees.memory import memory_of
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import HANDEDNESS, LEAVES

wp.set_module_options({"enable_backward": False})


@wp.struct
class LeafMaterial:
    """Lamé's parameters, one or one for each leaf; lambda is at most ``most_lambda`` mu."""

    mu: wp.array[float]
    lam: wp.array[float]
    most_lambda: float


@functools.cache
def turned_by(rotation: wp.Function) -> wp.Function:
    """An element's frame turned by its own rotation."""

    @wp.func
    def turned_by(elements: ForestElements, t: int, u: wp.array[wp.vec4]):
        return rotation(frame(elements, t) + local_gradient(elements, t, u))

    return turned_by


@functools.cache
def keep_turns(frame_of: wp.Function) -> wp.Kernel:
    """Write the quaternion of each leaf's turned frame, ``frame_of(elements, t, u)``: the first leaves of all subtrees,
    then the second ones.
    """

    @unique_kernel()
    def keep_turns(
        # In
        count: int,
        first: wp.array[wp.int32],
        elements: ForestElements,
        u: wp.array[wp.vec4],
        # Out
        turns: wp.array[wp.vec4],
    ):
        leaf, s = wp.tid()
        turn = wp.normalize(wp.quat_from_matrix(frame_of(elements, first[s] + leaf, u)))
        turns[leaf * count + s] = wp.vec4(turn[0], turn[1], turn[2], turn[3])

    return keep_turns


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 a = __ldcs(reinterpret_cast<const float4*>(&wp::index(turns, i)));
    return wp::quat_t<wp::float32>(a.x, a.y, a.z, a.w);
#else
    const wp::vec_t<4, wp::float32>& a = wp::index(turns, i);
    return wp::quat_t<wp::float32>(a[0], a[1], a[2], a[3]);
#endif
""")
def load_turn(turns: wp.array[wp.vec4], i: int) -> wp.quat: ...


@wp.func
def leaf_axes(turns: wp.array[wp.vec4], i: int, mirror: float):
    """The columns of a leaf's turned Maubach frame."""
    turn = wp.quat_to_matrix(load_turn(turns, i))
    return column(turn, 0), column(turn, 1), mirror * column(turn, 2)


@functools.cache
def subtree_product(shape: int, uniform: bool) -> wp.Function:
    """K x of one subtree, from the ten values of its nodes, without what its leaves share."""
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, hands, volume = LEAVES[shape], HANDEDNESS[shape], VOLUME[shape]

    @wp.func
    def subtree_product(
        x: mat10,
        s: int,
        count: int,
        h: float,
        mirror: float,
        material: LeafMaterial,
        first: int,
        turns: wp.array[wp.vec4],
    ):
        _generated_from = wp.static(fingerprint(leaves, hands))
        # Forces are minus V P grad N, and a product is plus that.
        size = -wp.static(volume) * h
        m = size * material.mu[first]
        k = wp.max(size * material.lam[first], material.most_lambda * m)
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                m = size * material.mu[first + leaf]
                k = wp.max(size * material.lam[first + leaf], material.most_lambda * m)
            a0, a1, a2 = leaf_axes(turns, leaf * count + s, mirror * wp.static(hands[leaf]))
            b0, b1, b2 = columns(
                x[wp.static(leaves[leaf][0])],
                x[wp.static(leaves[leaf][1])],
                x[wp.static(leaves[leaf][2])],
                x[wp.static(leaves[leaf][3])],
            )
            e0 = wp.dot(a0, b0)
            e1 = wp.dot(a1, b1)
            e2 = wp.dot(a2, b2)
            pressure = k * (e0 + e1 + e2)
            s0 = 2.0 * m * e0 + pressure
            s1 = 2.0 * m * e1 + pressure
            s2 = 2.0 * m * e2 + pressure
            s01 = m * (wp.dot(a0, b1) + wp.dot(a1, b0))
            s02 = m * (wp.dot(a0, b2) + wp.dot(a2, b0))
            s12 = m * (wp.dot(a1, b2) + wp.dot(a2, b1))
            f0, f1, f2, f3 = leaf_forces(
                s0 * a0 + s01 * a1 + s02 * a2, s01 * a0 + s1 * a1 + s12 * a2, s02 * a0 + s12 * a1 + s2 * a2
            )
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        return g

    return subtree_product


@functools.cache
def add_subtree_products(shape: int, grouped: bool, uniform: bool, shares: bool) -> wp.Kernel:
    """y += K x of all subtrees of a batch, which share a dilatation if ``shares``. Launch with block_dim
    ``subtrees.memory.BLOCK``.
    """
    load, add = memory_of(shape, grouped)
    product = subtree_product(shape, uniform)

    @unique_kernel(grid_stride=False)
    def add_subtree_products(
        # In
        subtrees: Subtrees,
        material: LeafMaterial,
        turns: wp.array[wp.vec4],
        rows: wp.array[wp.vec4],
        x: wp.array[wp.vec4],
        # In and out
        y: wp.array[wp.vec4],
    ):
        s = wp.tid()
        h, _q, mirror = root_of(subtrees, s)
        values = load(subtrees, s, x)
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        count = turns.shape[0] / 8
        g = product(values, s, count, h, mirror, material, first, turns)
        if wp.static(shares):
            part = float(0.0)
            for n in range(10):
                part += wp.dot(load_node(rows, n * count + s), values[n])
            for n in range(10):
                g[n] += part * load_node(rows, n * count + s)
        add(subtrees, s, g, y)

    return add_subtree_products
