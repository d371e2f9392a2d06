"""Viscous forces: a stress proportional to the rate at which an element's stretch changes, however it turns.

With F = R U, Fdot = (du/dt) grad N and A = R^T Fdot, A = W U + Udot, where W = R^T Rdot is skew and Udot symmetric. The
skew part of A says W: (tr(U) I - U) w is the axial vector of A - A^T. Udot vanishes where a body turns as a whole, at
any strain. The stress s = eta (2 mu Udot + lambda tr(Udot) I) works against Udot; the force that does the same work at
the nodes is that of P = R (s + [a]x), with (tr(U) I - U) a the axial vector of U s - s U: it takes out s : Udot >= 0 of
power and has no torque.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.math.matrices import axial
from warp_corot.kernels.math.rotation import byers_xu, identity3

from .constitutive import IsotropicMaterial, corotated_strain, hooke, symmetric
from .elements import frame, local_gradient

wp.set_module_options({"enable_backward": False})

#: Below this determinant of tr(U) I - U, which is 8 at rest, the turning of a crushed or inverted element is hardly
#: determined. With stretches a > 0 > b it is (a - b) / (a + b) times Udot and so faster than the nodes, which no
#: explicit step survives. Below, the symmetric part of A stands for Udot, which still takes power out.
LEAST = wp.constant(0.05)


@wp.struct
class ViscousMaterial:
    """Lamé's parameters [Pa], viscosities over these [s], and the velocities of nodes [m/s]."""

    isotropic: IsotropicMaterial
    seconds: float
    velocities: wp.array[wp.vec4]


@wp.func
def viscous_stress(u: wp.mat33, a: wp.mat33, mu: float, lam: float):
    """R^T P of a stretch U, a rate A and viscosities [Pa s]."""
    m = wp.trace(u) * identity3() - u
    if wp.determinant(m) < LEAST or wp.determinant(u) < 0.0:
        return hooke(symmetric(a), mu, lam)
    inverse = wp.inverse(m)
    rate = symmetric(a - wp.skew(inverse * axial(a)) * u)
    s = hooke(rate, mu, lam)
    return s + wp.skew(inverse * axial(u * s))


@wp.func
def viscosity_stress(elements: Any, t: int, material: ViscousMaterial, u: wp.array[wp.vec4]):
    """The viscous stress of element t for the kernels of ``forces``; forces are the stiffness times seconds times
    velocities, for small motions."""
    g = local_gradient(elements, t, u)
    q = frame(elements, t)
    r = byers_xu(q + g)
    stretch = identity3() + corotated_strain(g, q, r)
    rate = wp.transpose(r) * local_gradient(elements, t, material.velocities)
    eta = material.seconds
    i = t * material.isotropic.stride
    return r * viscous_stress(stretch, rate, eta * material.isotropic.mu[i], eta * material.isotropic.lam[i])
