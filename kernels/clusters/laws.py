"""The laws of elements in clusters: stress from displacement gradient, with the material data that each law needs."""

import functools

import warp as wp

from warp_corot.kernels.corotated.anisotropic import (
    OrthotropicMaterial,
    axes_of,
    filled,
    material_strain,
    turned_stress_of,
    vec9,
)
from warp_corot.kernels.corotated.well_conditioned import definite_law, definite_strain, is_definite, load_axes
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.fibres import ReinforcedMaterial, stress_in_axes
from warp_corot.kernels.math.rotation import ITERATIONS, byers_xu, column, identity3, newton_rotation

from .memory import number_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class ActiveMaterial:
    """An orthotropic material, its axes also as quaternions, and the active stress of each element."""

    passive: OrthotropicMaterial
    axes: wp.array[wp.quat]
    is_active: int
    activation: wp.array[wp.float32]


@functools.cache
def isotropic_law(stress: wp.Function) -> wp.Function:
    """A law of ``elements.constitutive`` for the i-th element of a list, times ``scale``."""

    @wp.func
    def isotropic_law(material: IsotropicMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
        t = int(0)
        if material.stride != 0:
            t = number_of(listed, i)
        return stress(w, scale * material.mu[t], scale * material.lam[t])

    return isotropic_law


@wp.func(inline=False)
def robust_stress(g: wp.mat33, m: wp.mat33, c: vec9, mu: float, lam: float):
    """P of an F = I + g for which the unscaled iteration finds no rotation, or whose rotation is hardly definite.

    The arguments are the axes, the stiffness in these, and the nearest isotropic material.
    """
    turned_gradient = g * m
    r = byers_xu(m + turned_gradient)
    stress, a = turned_stress_of(material_strain(turned_gradient, m, r), c, mu, lam)
    return r * (stress + wp.skew(a)) * wp.transpose(m)


@functools.cache
def anisotropic_law(transverse: bool) -> wp.Function:
    """The anisotropic corotated law, for elements whose axes are the axes of rest space."""
    law = definite_law(transverse)

    @wp.func
    def anisotropic_law(material: ActiveMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
        t = number_of(listed, i)
        n = wp.quat_to_matrix(load_axes(material.axes, t * material.passive.axes_stride))
        gradient = identity3() + w
        f0 = column(gradient, 0)
        f1 = column(gradient, 1)
        f2 = column(gradient, 2)
        filled_scale = scale * filled(material.passive, t)
        z0, z1, z2, trusted = newton_rotation(f0, f1, f2, 1.0)
        e = definite_strain(z0, z1, z2, f0, f1, f2, w, w)
        p = wp.mat33()
        k = t * material.passive.stride
        stiffness = material.passive.stiffness[k]
        if trusted and is_definite(e):
            p = wp.matrix_from_cols(z0, z1, z2) * law(e, n, stiffness, wp.static(0.5**ITERATIONS) * filled_scale)
        else:
            m = axes_of(material.passive, t)
            p = filled_scale * robust_stress(w, m, stiffness, material.passive.mu[k], material.passive.lam[k])
        if material.is_active != 0:
            d = column(n, 0)
            p += wp.outer((filled_scale * material.activation[t]) * (gradient * d), d)
        return p

    return anisotropic_law


@wp.func
def reinforced_law(material: ReinforcedMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
    """The law of Holzapfel, Gasser and Ogden, for elements whose axes are the axes of rest space."""
    t = number_of(listed, i)
    m = axes_of(material.fibres, t)
    return scale * (m * stress_in_axes(wp.transpose(m) * w * m, material, t) * wp.transpose(m))
