"""The sums of clusters of pairs, on devices without shared memory, too."""

import functools

import numpy as np
import warp as wp

from warp_corot.kernels.clusters.laws import add_pair, measure_pairs, pair_dilatations
from warp_corot.kernels.clusters.pairs import PairClusters, half_word, pair_forces, record_of
from warp_corot.kernels.elements.dilatation import VOLUME
from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.tables.cluster_layout import QUAD_BYTES


def add_forces(scatter, material, u, f):
    """Like a ``ClusterScatter``; on a CPU pair by pair, without the sums in shared memory."""
    if u.device.is_cuda:
        scatter(material, u, f)
        return
    size = scatter.count * scatter.layout.threads
    forces = wp.zeros((size, 5), dtype=wp.vec3, device=u.device)
    nodes = wp.zeros((size, 5), dtype=wp.int32, device=u.device)
    kernel = forces_of_pairs(scatter.Pairs, scatter.Material, scatter.law)
    inputs = [scatter.pairs, scatter.clusters, material, scatter.layout.threads, u]
    wp.launch(kernel, size, inputs=inputs, outputs=[forces, nodes], device=u.device)
    found = f.numpy()
    np.add.at(found[:, :3], nodes.numpy(), forces.numpy())
    f.assign(found)


def add_dilatations(scatter, listed, stride, lam, u, sums):
    """Add up what groups share; on a CPU as above."""
    threads = scatter.layout.threads
    inputs = [scatter.clusters, scatter.pairs, listed, stride, lam, u]
    kernel = measure_pairs(scatter.Pairs, VOLUME, scatter.layout)
    if not u.device.is_cuda:
        inputs.append(threads)
        kernel = dilatations_of_pairs(scatter.Pairs)
    wp.launch(kernel, scatter.count * threads, inputs, [sums], device=u.device, block_dim=threads)


@functools.cache
def dilatations_of_pairs(Pairs):
    dilatations = pair_dilatations(VOLUME)

    @law_kernel()
    def dilatations_of_pairs(
        clusters: PairClusters,
        pairs: Pairs,
        groups: wp.array[wp.int32],
        stride: int,
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        size: int,
        sums: wp.array[wp.vec4],
    ):
        i = wp.tid()
        record = record_of(pairs, i)
        begin = i // size * size
        theta, other = dilatations(
            pairs,
            record,
            load_node(u, clusters.nodes[begin + half_word(record, 0) // wp.static(QUAD_BYTES)]),
            load_node(u, clusters.nodes[begin + half_word(record, 1) // wp.static(QUAD_BYTES)]),
            load_node(u, clusters.nodes[begin + half_word(record, 2) // wp.static(QUAD_BYTES)]),
            load_node(u, clusters.nodes[begin + half_word(record, 3) // wp.static(QUAD_BYTES)]),
            load_node(u, clusters.nodes[begin + half_word(record, 4) // wp.static(QUAD_BYTES)]),
        )
        add_pair(clusters, pairs, record, groups[2 * i], groups[2 * i + 1], stride, lam, i, theta, other, sums)

    return dilatations_of_pairs


@functools.cache
def forces_of_pairs(Pairs, Material, law):
    of_pair = pair_forces(law)

    @law_kernel()
    def forces_of_pairs(
        pairs: Pairs,
        clusters: PairClusters,
        material: Material,
        size: int,
        u: wp.array[wp.vec4],
        forces: wp.array2d[wp.vec3],
        nodes: wp.array2d[wp.int32],
    ):
        i = wp.tid()
        record = record_of(pairs, i)
        for k in range(5):
            nodes[i, k] = clusters.nodes[i // size * size + half_word(record, k) // wp.static(QUAD_BYTES)]
        fa, fb, fc, fd, fe = of_pair(
            pairs,
            record,
            material,
            clusters.elements,
            i,
            load_node(u, nodes[i, 0]),
            load_node(u, nodes[i, 1]),
            load_node(u, nodes[i, 2]),
            load_node(u, nodes[i, 3]),
            load_node(u, nodes[i, 4]),
            0.0,
            0.0,
        )
        forces[i, 0] = fa
        forces[i, 1] = fb
        forces[i, 2] = fc
        forces[i, 3] = fd
        forces[i, 4] = fe

    return forces_of_pairs
