"""Smoothing on the finest level over subtrees on CUDA, without its matrix: what nodes add to ``turned_subtrees``.

There a leaf's rotation takes sixteen bytes; its part of an assembled matrix has a hundred.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.math.matrices import identity3

from .values import semidefinite

wp.set_module_options({"enable_backward": False})


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
