"""Products with the finest matrix of subtrees on CUDA, without the matrix: one thread a subtree.

The rotations of a subtree's eight leaves are kept as quaternions, sixteen bytes a leaf, where the assembled matrix has
a hundred. Ten values are read, eight leaves multiplied in registers, and ten sums added up as in ``subtrees.memory``.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import ForestElements, Subtrees, load_node, root_of, store_node
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.math.matrices import column, identity3
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.forces import mat10
from warp_corot.kernels.subtrees.memory import memory_of
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import HANDEDNESS, LEAVES

from .values import rest_frame, semidefinite, turned_frame

wp.set_module_options({"enable_backward": False})


@wp.struct
class LeafMaterial:
    """Lamé's parameters, one or one for each leaf; lambda is at most ``most_lambda`` mu."""

    mu: wp.array[float]
    lam: wp.array[float]
    most_lambda: float


@wp.kernel(enable_backward=False)
def rank_places(
    # In
    mesh_nodes: int,
    ranks: int,
    rank: wp.array[wp.int32],
    # In and out
    places: wp.array2d[wp.int32],
):
    """Replace the numbers of nodes by their ranks, world after world; -1 stays."""
    i, j = wp.tid()
    node = places[i, j]
    if node >= 0:
        places[i, j] = (node / mesh_nodes) * ranks + rank[node % mesh_nodes]


@functools.cache
def keep_turns(is_turned: bool) -> wp.Kernel:
    """Write the quaternion of each leaf's frame at displacements u, or at rest: the first leaves of all subtrees, then
    the second ones.
    """
    frame_of = turned_frame if is_turned else rest_frame

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


@wp.struct
class OwnBlocks:
    """What nodes add to the diagonal besides subtrees, by rank: a M, minus one at held nodes, and the blocks of other
    forces, one if there are none.
    """

    masses: wp.array[float]
    blocks: wp.array[wp.mat33]


@wp.kernel(enable_backward=False)
def find_own(
    # In
    ranks: int,
    mesh_nodes: int,
    nodes: wp.array[wp.int32],
    free: wp.array[wp.uint8],
    inverse_mass: wp.array[float],
    scales: wp.array[float],
    others: wp.array[wp.mat33],
    # Out
    own: OwnBlocks,
):
    """Find these from blocks by node."""
    world, i = wp.tid()
    at = world * ranks + i
    node = nodes[i]
    own.masses[at] = 0.0
    if free[at] == wp.uint8(0):
        own.masses[at] = -1.0
    elif node < mesh_nodes:
        own.masses[at] = scales[0] / inverse_mass[world * mesh_nodes + node]
    if others.shape[0] > 1:
        block = wp.mat33()
        if node < mesh_nodes and free[at] != wp.uint8(0):
            block = others[world * mesh_nodes + node]
            if wp.trace(block) != 0.0:
                block = scales[2] * semidefinite(block)
        own.blocks[at] = block


@wp.func
def own_block(own: OwnBlocks, at: int):
    """The block of a node; zero if the node is held."""
    block = wp.max(own.masses[at], 0.0) * identity3()
    if own.blocks.shape[0] > 1:
        block += own.blocks[at]
    return block


@wp.func
def finished_product(
    at: int, stiffening: float, scales: wp.array[float], own: OwnBlocks, z: wp.vec3, products: wp.array[wp.vec4]
):
    """A z of one node from K z, which becomes zero for the next product."""
    product = (scales[2] + scales[1] * stiffening) * load_node(products, at) + own.masses[at] * z
    if own.blocks.shape[0] > 1:
        product += own.blocks[at] * z
    store_node(products, at, wp.vec3())
    return product


@wp.kernel(enable_backward=False)
def finish_smoothing(
    # In
    alpha: float,
    beta: float,
    from_zero: bool,
    stiffening: float,
    scales: wp.array[float],
    own: OwnBlocks,
    inverses: wp.array[wp.mat33],
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    # In and out
    products: wp.array[wp.vec4],
    other: wp.array[wp.vec4],
):
    """Make one step as ``cycle.smooth`` does, from ``products`` with K z."""
    at = wp.tid()
    now = load_node(z, at)
    product = finished_product(at, stiffening, scales, own, now, products)
    step = alpha * (inverses[at] * (load_node(r, at) - product))
    if beta != 0.0:
        before = wp.vec3()
        if not from_zero:
            before = load_node(other, at)
        step += beta * (now - before)
    store_node(other, at, now + step)


@wp.kernel(enable_backward=False)
def finish_residual(
    # In
    stiffening: float,
    scales: wp.array[float],
    own: OwnBlocks,
    r: wp.array[wp.vec4],
    z: wp.array[wp.vec4],
    # In and out
    products: wp.array[wp.vec4],
    # Out
    residual: wp.array[wp.vec4],
):
    """r - A z, zero at held nodes, from ``products`` with K z."""
    at = wp.tid()
    product = finished_product(at, stiffening, scales, own, load_node(z, at), products)
    rest = wp.vec3()
    if own.masses[at] >= 0.0:
        rest = load_node(r, at) - product
    store_node(residual, at, rest)
