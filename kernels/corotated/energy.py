"""The corotated energy without rotations, in closed form; see ``algebraic`` for the invariants and the trace of S.

With D = S - I, of invariants t, i2, i3, the density is mu |D|^2 + lambda/2 t^2, |D|^2 = t^2 - 2 i2. From
2 i2 = t^2 + 2t - tr E come few digits where the strain is small. There E = D^2 + 2D gives
    tr adj E = i2 (4 + 2t + i2) - i3 (6 + 2t),  det E = i3 (8 + 4t + 2 i2 + i3),
in which the sums need no more digits than that i2 has.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial, corotated_strain, hooke, hooke_energy, symmetric
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, own_gradient
from warp_corot.kernels.math.matrices import identity3, reciprocal
from warp_corot.kernels.math.rotation import quick_rotation, rotation_out_of_line
from warp_corot.kernels.modules import Family

from .algebraic import FAR, FLAT, NEAR, stretch_trace

wp.set_module_options({"enable_backward": False})

OF_OWN_ROTATIONS = Family(__name__)


@wp.func
def stretch_energy(w: wp.mat33, mu: float, lam: float):
    """The density from the displacement gradient W in an orthonormal frame, and whether it may be trusted; as
    ``stretch_stress``."""
    e = w + wp.transpose(w) + wp.transpose(w) * w
    d00 = e[1, 1] * e[2, 2] - e[1, 2] * e[1, 2]
    d11 = e[0, 0] * e[2, 2] - e[0, 2] * e[0, 2]
    d22 = e[0, 0] * e[1, 1] - e[0, 1] * e[0, 1]
    d01 = e[0, 2] * e[1, 2] - e[0, 1] * e[2, 2]
    d02 = e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1]
    a = wp.trace(e)
    b = d00 + d11 + d22
    c = e[0, 0] * d00 + e[0, 1] * d01 + e[0, 2] * d02
    volume = wp.determinant(identity3() + w)
    # A comparison with NaN is false.
    trusted = volume > FLAT and a < FAR
    density = float(0.0)
    if trusted:
        j = (a + b + c) * reciprocal(1.0 + volume)
        t = stretch_trace(a, b, c, j)
        i2 = 0.5 * (t * (2.0 + t) - a)
        if a * a - 2.0 * b < NEAR:
            i3 = c * reciprocal(8.0 + 4.0 * t + 2.0 * i2 + (j - t - i2))
            i2 = (b + i3 * (6.0 + 2.0 * t)) * reciprocal(4.0 + 2.0 * t + i2)
        density = mu * (t * t - 2.0 * i2) + 0.5 * lam * t * t
    return density, trusted


@wp.func(inline=False)
def turned_energy(f: wp.mat33, mu: float, lam: float):
    """The density of F, for every F."""
    strain = symmetric(wp.transpose(rotation_out_of_line(f)) * f) - identity3()
    return hooke_energy(strain, mu, lam)


@wp.func
def corotated_energy(a: wp.mat33, mu: float, lam: float):
    """The density of any displacement gradient A."""
    density, trusted = stretch_energy(a, mu, lam)
    if not trusted:
        density = turned_energy(identity3() + a, mu, lam)
    return density


@wp.func
def own_density(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    """The density of an element with its own rotation."""
    i = t * material.stride
    return corotated_energy(own_gradient(elements, t, u), material.mu[i], material.lam[i])


@wp.func
def own_cauchy(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    """Cauchy stress of an element for display, with its own rotation."""
    i = t * material.stride
    g = local_gradient(elements, t, u)
    q = frame(elements, t)
    return hooke(corotated_strain(g, q, quick_rotation(q + g)), material.mu[i], material.lam[i])


@OF_OWN_ROTATIONS.member
def own_energies(Elements: type) -> wp.Kernel:
    return element_energies(Elements, IsotropicMaterial, own_density, OF_OWN_ROTATIONS.kernel)


@OF_OWN_ROTATIONS.member
def own_von_mises(Elements: type) -> wp.Kernel:
    return element_von_mises(Elements, IsotropicMaterial, own_cauchy, OF_OWN_ROTATIONS.kernel)
