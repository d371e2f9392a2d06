"""Viscous forces of complete subtrees on CUDA, one thread a subtree: those of ``elements.viscosity``.

Displacements and velocities are turned into the subtree's own frame, as in ``subtrees.laws``; rotations and stresses
are those of the leaves' frames there.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain
from warp_corot.kernels.elements.elements import Subtrees, root_of
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.elements.viscosity import ViscousMaterial, viscous_stress
from warp_corot.kernels.math.matrices import column, identity3
from warp_corot.kernels.math.rotation import byers_xu
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.forces import mat10, turns_of
from warp_corot.kernels.subtrees.laws import turn_in, turn_out
from warp_corot.kernels.subtrees.memory import memory_of
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import FRAMES, LEAVES

wp.set_module_options({"enable_backward": False})


@wp.func
def viscous_piola(a: wp.mat33, rate: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of a displacement gradient, its rate and viscosities [Pa s]."""
    r = byers_xu(identity3() + a)
    stretch = identity3() + corotated_strain(a, identity3(), r)
    return r * viscous_stress(stretch, wp.transpose(r) * rate, mu, lam)


@functools.cache
def viscous_forces_of(shape: int, uniform: bool) -> wp.Function:
    """The forces of a subtree's leaves from ten displacements y and ten velocities w in its frame, in edge lengths h of
    a leaf.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, frames, volume = LEAVES[shape], FRAMES[shape], VOLUME[shape]
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def viscous_forces(y: mat10, w: mat10, h: float, material: ViscousMaterial, first: int):
        _generated_from = wp.static(fingerprint(leaves, frames))
        # P V / h.
        area = wp.static(volume) * h * h * material.seconds
        m = area * material.isotropic.mu[first]
        k = area * material.isotropic.lam[first]
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                m = area * material.isotropic.mu[first + leaf]
                k = area * material.isotropic.lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            c0, c1, c2 = columns(
                w[wp.static(leaves[leaf][0])],
                w[wp.static(leaves[leaf][1])],
                w[wp.static(leaves[leaf][2])],
                w[wp.static(leaves[leaf][3])],
            )
            a = into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2))
            p = out_of_leaf(leaf, viscous_piola(a, into_leaf(leaf, wp.matrix_from_cols(c0, c1, c2)), m, k))
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        return g

    return viscous_forces


@functools.cache
def scatter_viscous_subtrees(shape: int, grouped: bool, uniform: bool) -> wp.Kernel:
    """Add the viscous forces of a batch of subtrees. Launch with block_dim ``subtrees.memory.BLOCK``."""
    load, add = memory_of(shape, grouped)
    forces = viscous_forces_of(shape, uniform)

    @unique_kernel(grid_stride=False)
    def scatter_viscous_subtrees(
        # In
        subtrees: Subtrees,
        material: ViscousMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        y = turn_in(load(subtrees, s, u), q0, q1, q2, 1.0 / h)
        w = turn_in(load(subtrees, s, material.velocities), q0, q1, q2, 1.0 / h)
        g = forces(y, w, h, material, wp.where(wp.static(uniform), 0, subtrees.first[s]))
        add(subtrees, s, turn_out(g, q0, q1, q2), f)

    return scatter_viscous_subtrees
