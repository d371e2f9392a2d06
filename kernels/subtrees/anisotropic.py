"""Corotated forces of orthotropic materials by complete subtrees on CUDA; one thread a subtree, as in ``cuda``.

The law is that of ``corotated.anisotropic``. Each leaf is computed in its own frame, in which the columns of F - I are
differences of displacements, and four unscaled iterations find its rotation. A leaf for which these find no rotation
adds nothing; a bit flags it, and ``repair_leaves`` computes it. Leaves whose rotation is nearly indefinite are flagged,
too: see ``corotated.anisotropic``.
"""

import functools

import warp as wp

from warp_corot.kernels.clusters.laws import ActiveMaterial
from warp_corot.kernels.corotated.anisotropic import FibreMaterial, fibre_stress, filled
from warp_corot.kernels.corotated.well_conditioned import definite_law, definite_strain, is_definite, load_axes
from warp_corot.kernels.math.rotation import ITERATIONS, byers_xu, column, identity3, newton_rotation

from .cuda import scatter_subtrees
from .degenerate import repair_flagged
from .forces import handedness_of, mat10, turns_of

wp.set_module_options({"enable_backward": False})


@functools.cache
def anisotropic_leaves(shape: int, transverse: bool, one_axes: bool, one_stiffness: bool) -> wp.Function:
    """The law of leaves (``forces``), which share the subtree's frame, or the material's axes in it if ``one_axes``."""
    into_leaf, out_of_leaf = turns_of(shape)
    law, handedness = definite_law(transverse), handedness_of(shape)

    @wp.func
    def anisotropic_leaf(material: ActiveMaterial, shared: wp.mat33, leaf: int, t: int, area: float, g: wp.mat33):
        passive = material.passive
        m = shared
        if wp.static(not one_axes):
            m = wp.transpose(shared) * wp.quat_to_matrix(load_axes(material.axes, t))
        c = passive.stiffness[wp.where(wp.static(one_stiffness), 0, t)]
        # A = B^T G, and the axes, in the leaf's frame B.
        a = into_leaf(leaf, g)
        n = into_leaf(leaf, m)
        # F B, of which B is constant.
        f = g + out_of_leaf(leaf, identity3())
        f0, f1, f2 = column(f, 0), column(f, 1), column(f, 2)
        z0, z1, z2, trusted = newton_rotation(f0, f1, f2, handedness(leaf))
        e = definite_strain(z0, z1, z2, f0, f1, f2, g, a)
        filled_area = area * filled(passive, t)
        p = wp.matrix_from_cols(z0, z1, z2) * law(e, n, c, wp.static(0.5**ITERATIONS) * filled_area)
        if material.is_active != 0:
            d = column(n, 0)
            p += wp.outer((filled_area * material.activation[t]) * (d[0] * f0 + d[1] * f1 + d[2] * f2), d)
        is_good = trusted and is_definite(e)
        return p, is_good, is_good

    return anisotropic_leaf


@functools.cache
def shared_axes(one_axes: bool) -> wp.Function:
    """The subtree's frame, or the material's axes in it if ``one_axes``."""

    @wp.func
    def shared_axes(material: ActiveMaterial, y: mat10, first: int, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
        shared = wp.matrix_from_cols(q0, q1, q2)
        if wp.static(one_axes):
            shared = wp.transpose(shared) * wp.quat_to_matrix(load_axes(material.axes, 0))
        return shared

    return shared_axes


def scatter_anisotropic_subtrees(
    shape: int, grouped: bool, transverse: bool, one_axes: bool, one_stiffness: bool
) -> wp.Kernel:
    """Add the forces of subtrees and flag the leaves that were left out; see ``cuda.scatter_subtrees``. The axes are
    those of the material."""
    leaves = anisotropic_leaves(shape, transverse, one_axes, one_stiffness)
    return scatter_subtrees(shape, grouped, False, leaves, ActiveMaterial, shared_axes(one_axes), "flags")


repair_leaves = repair_flagged(FibreMaterial, fibre_stress(byers_xu))
