"""The exact differential of the anisotropic corotated law, for ``elements.stiffness_products``.

In the material's axes P = R (s + [a]x), where s is the derivative of the energy density with respect to S, H a =
axial(S s), and H = tr(S) I - S (see ``anisotropic``). With b = R^T dF, H w = axial(b) and dS = sym(b - [w]x S),
    dP = R ([w]x (s + [a]x) + ds + [da]x),  H da = axial(dS s + S ds) - dH a.
The isotropic part of s adds nothing to axial(S s). The change of the rotation is bounded as in ``tangent``.

Active stress s (F d) d^T is linear in F; its s is held fixed.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import hooke, symmetric
from warp_corot.kernels.math.matrices import axial, cofactor, cofactor_differential, column, identity3, largest_entry

from .anisotropic import (
    INDEFINITE,
    FibreMaterial,
    axes_of,
    filled,
    material_gradient,
    material_strain,
    orthotropic_stress,
    turned_stress,
    vec9,
)
from .tangent import rotation_differential, stretch_turning

wp.set_module_options({"enable_backward": False})


@wp.func
def share_differential(strain: wp.mat33, d_strain: wp.mat33):
    """The share b of the law that is not isotropic (``anisotropic.definiteness``), db, and the derivative of b with
    respect to S and its differential."""
    scale = 1.0 / wp.max(largest_entry(strain + identity3()), 1.0e-30)
    s = scale * (strain + identity3())
    ds = scale * d_strain
    h = wp.trace(s) * identity3() - s
    adjugate = cofactor(h)
    n2 = wp.max(wp.ddot(s, s), 1.0e-12)
    n3 = n2 * wp.sqrt(n2)
    x = wp.dot(column(h, 0), column(adjugate, 0)) / n3
    share = float(1.0)
    d_share = float(0.0)
    slope = wp.mat33()
    d_slope = wp.mat33()
    if x < INDEFINITE:
        y = wp.clamp(x / INDEFINITE, 0.0, 1.0)
        share = y * y * (3.0 - 2.0 * y)
        first = 6.0 * y * (1.0 - y) / INDEFINITE
        second = (6.0 - 12.0 * y) / (INDEFINITE * INDEFINITE)
        of_det = (wp.trace(adjugate) * identity3() - adjugate) / n3
        of_x = of_det - (3.0 * x / n2) * s
        dx = wp.ddot(of_x, ds)
        d_adjugate = cofactor_differential(h, wp.trace(ds) * identity3() - ds)
        growth = wp.ddot(s, ds) / n2
        d_of_x = (wp.trace(d_adjugate) * identity3() - d_adjugate) / n3 - (3.0 * growth) * of_det
        d_of_x += ((6.0 * x * growth - 3.0 * dx) / n2) * s - (3.0 * x / n2) * ds
        d_share = first * dx
        slope = (scale * first) * of_x
        d_slope = scale * ((second * dx) * of_x + first * d_of_x)
    return share, d_share, slope, d_slope


@wp.func
def stress_differential(strain: wp.mat33, d_strain: wp.mat33, c: vec9, mu: float, lam: float):
    """ds, and the part of s that is not isotropic with its differential."""
    stress = orthotropic_stress(strain, c)
    d_stress = orthotropic_stress(d_strain, c)
    share, d_share, slope, d_slope = share_differential(strain, d_strain)
    turning = stress
    d_turning = d_stress
    if share < 1.0:
        excess = stress - hooke(strain, mu, lam)
        isotropic = hooke(d_strain, mu, lam)
        turning = share * excess
        d_turning = share * (d_stress - isotropic) + d_share * excess
        d_stress = isotropic + d_turning
        d_stress += wp.ddot(excess, d_strain) * slope + (0.5 * wp.ddot(strain, excess)) * d_slope
    return d_stress, turning, d_turning


@functools.cache
def anisotropic_differential(rotation: wp.Function) -> wp.Function:
    """With the element's own rotation and its turning, and its active stress."""

    @wp.func
    def anisotropic_differential(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        passive = material.passive
        i = t * passive.stride
        m = axes_of(passive, t)
        g, turn = material_gradient(elements, t, m, u)
        df = dg * turn
        r = rotation(m + g)
        strain = material_strain(g, m, r)
        stress, a = turned_stress(strain, passive, t)
        b = wp.transpose(r) * df
        w = wp.skew(rotation_differential(strain, b))
        d_strain = symmetric(b - w * strain)
        c = passive.stiffness[i]
        d_stress, turning, d_turning = stress_differential(strain, d_strain, c, passive.mu[i], passive.lam[i])
        adjugate, det, scale = stretch_turning(strain)
        of_a = axial(d_strain * turning + strain * d_turning) - (wp.trace(d_strain) * a - d_strain * a)
        da = (scale / det) * (adjugate * of_a)
        p = r * (w * (stress + wp.skew(a)) + d_stress + wp.skew(da))
        if material.is_active != 0:
            p += wp.outer(material.activation[t] * column(df, 0), wp.vec3(1.0, 0.0, 0.0))
        return (filled(passive, t) * p) * wp.transpose(turn)

    return anisotropic_differential
