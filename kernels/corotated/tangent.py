"""Differentials of the isotropic corotated law P = R sigma(e), e = sym(R^T F) - I, for ``elements.stiffness_products``.

With the rotation held fixed dP = R sigma(sym(R^T dF)): the paper's R K R^T, which is positive semidefinite. The exact
differential includes the change of R, dR = R [w]x with (tr(S) I - S) w = axial(R^T dF), which needs the rotation to be
the element's own: dP = R ([w]x sigma(e) + sigma(dS)), dS = sym(R^T dF - [w]x e).
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import (
    IsotropicMaterial,
    RotatedMaterial,
    corotated_strain,
    hooke,
    symmetric,
)
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.math.matrices import axial, cofactor, column, identity3, largest_entry
from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})

#: det(tr(S) I - S) / |S|^3, which is 1.54 at rest, below which the rotation is taken to turn less than it does, and the
#: largest entry of S below which it is. Both at zero, F has no definite rotation and the derivative does not exist.
LEAST_DEFINITENESS = wp.constant(1.0e-3)
LEAST_STRETCH = wp.constant(1.0e-3)


@wp.func
def stretch_turning(strain: wp.mat33):
    """tr(S) I - S of S scaled to order one, S = I + ``strain``: its adjugate, its determinant or what is put for one
    near zero, and the scale."""
    s = strain + identity3()
    scale = 1.0 / wp.max(largest_entry(s), LEAST_STRETCH)
    s = s * scale
    h = wp.trace(s) * identity3() - s
    adjugate = cofactor(h)
    n2 = wp.ddot(s, s)
    least = wp.max(LEAST_DEFINITENESS * n2 * wp.sqrt(n2), 1.0e-12)
    return adjugate, wp.max(wp.dot(column(h, 0), column(adjugate, 0)), least), scale


@wp.func
def rotation_differential(strain: wp.mat33, b: wp.mat33):
    """w of dR = R [w]x, for b = R^T dF."""
    adjugate, det, scale = stretch_turning(strain)
    return (scale / det) * (adjugate * axial(b))


@wp.func
def given_differential(elements: Any, t: int, material: RotatedMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
    """With a given rotation, held fixed."""
    i = t * material.isotropic.stride
    r = material.rotations[material.unit[t]] * frame(elements, t)
    return r * hooke(symmetric(wp.transpose(r) * dg), material.isotropic.mu[i], material.isotropic.lam[i])


@wp.func
def differential_of(r: wp.mat33, strain: wp.mat33, dg: wp.mat33, mu: float, lam: float):
    """With the rotation r of an element's F Q, and its change."""
    b = wp.transpose(r) * dg
    turning = wp.skew(rotation_differential(strain, b))
    return r * (turning * hooke(strain, mu, lam) + hooke(symmetric(b - turning * strain), mu, lam))


@functools.cache
def exact_differential(rotation: wp.Function) -> wp.Function:
    """With the element's own rotation and its change."""

    @wp.func
    def exact_differential(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        i = t * material.stride
        q = frame(elements, t)
        g = local_gradient(elements, t, u)
        r = rotation(q + g)
        return differential_of(r, corotated_strain(g, q, r), dg, material.mu[i], material.lam[i])

    return exact_differential


@wp.struct
class KeptStrains:
    """Lamé's parameters, and the rotation and strain of each element, which ``exact_differential`` would find again for
    every product.
    """

    isotropic: IsotropicMaterial
    rotations: wp.array[wp.mat33]
    strains: wp.array[wp.mat33]


@functools.cache
def keep_strains(Elements: type, rotation: wp.Function) -> wp.Kernel:
    """Write each element's own rotation and strain."""

    @unique_kernel()
    def keep_strains(
        # In
        elements: Elements,
        u: wp.array[wp.vec4],
        # Out
        rotations: wp.array[wp.mat33],
        strains: wp.array[wp.mat33],
    ):
        t = wp.tid()
        q = frame(elements, t)
        g = local_gradient(elements, t, u)
        r = rotation(q + g)
        rotations[t] = r
        strains[t] = corotated_strain(g, q, r)

    return keep_strains


@wp.func
def kept_differential(elements: Any, t: int, material: KeptStrains, u: wp.array[wp.vec4], dg: wp.mat33):
    """As ``exact_differential``, with the kept rotations and strains."""
    i = t * material.isotropic.stride
    mu = material.isotropic.mu[i]
    return differential_of(material.rotations[t], material.strains[t], dg, mu, material.isotropic.lam[i])
