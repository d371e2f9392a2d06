"""The corotated stress without an iteration on matrices: the stretch S of F = R S by a root of its trace.

With E = F^T F - I, its invariants a = tr E, b = tr adj E, c = det E, and j = J - 1, t = tr S - 3 is the largest root of
    t^4 + 12 t^3 + (48 - 2a) t^2 + (64 - 12a - 8j) t + a^2 - 20a - 24j - 4b = 0
(Cayley-Hamilton for S), whose slope is 4q, q = 2 (s1 + s2)(s1 + s3)(s2 + s3) of the principal stretches. From t follow
    I - S^-1 = (n0 I + (8 + y) E - (6 + y) adj E) / q,  y = (2t - 6j) / J,
    n0 = t (18 + t (8 + t)) - a (10 + t) - 2j - y (1 + a),  and  P = F (2 mu (I - S^-1) + lambda t S^-1),
with the digits of E however small it is, for J > 0: see ``native/laws.h``. Flat and turned over elements have their
rotations from ``robust_rotation``.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import (
    IsotropicMaterial,
    corotated_strain,
    hooke,
    hooke_energy,
    law_functions,
    symmetric,
)
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, own_gradient
from warp_corot.kernels.elements.simd8 import LAW_HEADERS
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.math.quaternion import robust_rotation
from warp_corot.kernels.math.rotation import quick_rotation, rotation_out_of_line
from warp_corot.kernels.modules import Family

wp.set_module_options({"enable_backward": False})


@wp.func_native("return corot::has_stretch(a);")
def has_stretch(a: wp.mat33) -> bool:
    """Whether F = I + A is neither flat, turned over nor far from order one."""
    ...


closed_stress, _differential, closed_energy = law_functions("corot::Corotated{}")


@wp.func
def stretch_stress(a: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of the corotated law from the displacement gradient A in an orthonormal frame, and
    whether it may be trusted; else it is zero."""
    p = wp.mat33()
    trusted = has_stretch(a)
    if trusted:
        p = closed_stress(a, mu, lam)
    return p, trusted


@wp.func
def turned_stress(f: wp.mat33, mu: float, lam: float):
    """As ``stretch_stress``, but from F and for every F. Where E is small the result loses digits."""
    r = robust_rotation(f)
    return (2.0 * mu) * f + (lam * (wp.ddot(r, f) - 3.0) - 2.0 * mu) * r


@wp.func(inline=False)
def turned_stress_out_of_line(f: wp.mat33, mu: float, lam: float):
    return turned_stress(f, mu, lam)


@wp.func
def corotated_stress(a: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of the corotated law from any displacement gradient A."""
    p, trusted = stretch_stress(a, mu, lam)
    if not trusted:
        p = turned_stress_out_of_line(identity3() + a, mu, lam)
    return p


# --- the energy ------------------------------------------------------------------------------------------------------


OF_OWN_ROTATIONS = Family(__name__, LAW_HEADERS)


@wp.func(inline=False)
def turned_energy(f: wp.mat33, mu: float, lam: float):
    """The density of F, for every F."""
    strain = symmetric(wp.transpose(rotation_out_of_line(f)) * f) - identity3()
    return hooke_energy(strain, mu, lam)


@wp.func
def corotated_energy(a: wp.mat33, mu: float, lam: float):
    """The density of any displacement gradient A."""
    density = float(0.0)
    trusted = has_stretch(a)
    if trusted:
        density = closed_energy(a, mu, lam)
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
