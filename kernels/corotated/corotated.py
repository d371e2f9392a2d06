"""The corotated force of the paper, f = -R K (R^T x - x0), with own rotations or rotations shared down the tree.

Own rotations are found and used in one kernel. Shared ones take two: ``extract_rotations`` finds the rotation of each
ancestor from its four vertices, and kernels of forces gather it (``RotatedMaterial``). A rotation R maps rest space to
world space; an element's local frame Q turns it into the rotation R Q of its F Q.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import (
    IsotropicMaterial,
    RotatedMaterial,
    corotated_strain,
    hooke,
    hooke_energy,
    law_functions,
    rotated_stress,
    symmetric,
)
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, own_gradient
from warp_corot.kernels.elements.simd8 import LAW_HEADERS
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.math.quaternion import robust_rotation
from warp_corot.kernels.math.rotation import quick_rotation, rotation_out_of_line
from warp_corot.kernels.modules import Family, unique_kernel

wp.set_module_options({"enable_backward": False})


# --- the law, for the kernels of ``elements.forces`` ------------------------------------------------------------------


@functools.cache
def own_stress(rotation: wp.Function) -> wp.Function:
    """Stress with the rotation of the element's own deformation gradient."""

    @wp.func
    def own_stress(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
        i = t * material.stride
        g = local_gradient(elements, t, u)
        q = frame(elements, t)
        return rotated_stress(g, q, rotation(q + g), material.mu[i], material.lam[i])

    return own_stress


@wp.func
def given_stress(elements: Any, t: int, material: RotatedMaterial, u: wp.array[wp.vec4]):
    """Stress with a given rotation."""
    i = t * material.isotropic.stride
    g = local_gradient(elements, t, u)
    q = frame(elements, t)
    r = material.rotations[material.unit[t]] * q
    return rotated_stress(g, q, r, material.isotropic.mu[i], material.isotropic.lam[i])


@wp.func
def given_strain(elements: Any, t: int, material: RotatedMaterial, u: wp.array[wp.vec4]):
    q = frame(elements, t)
    return corotated_strain(local_gradient(elements, t, u), q, material.rotations[material.unit[t]] * q)


@wp.func
def given_density(elements: Any, t: int, material: RotatedMaterial, u: wp.array[wp.vec4]):
    """Energy density with a given rotation."""
    i = t * material.isotropic.stride
    return hooke_energy(given_strain(elements, t, material, u), material.isotropic.mu[i], material.isotropic.lam[i])


@wp.func
def given_cauchy(elements: Any, t: int, material: RotatedMaterial, u: wp.array[wp.vec4]):
    """Cauchy stress for display, with a given rotation."""
    i = t * material.isotropic.stride
    return hooke(given_strain(elements, t, material, u), material.isotropic.mu[i], material.isotropic.lam[i])


# --- rotations --------------------------------------------------------------------------------------------------------


@functools.cache
def extract_rotations(Elements: type, rotation: wp.Function) -> wp.Kernel:
    """The rotation R of each unit (an element or an ancestor) from rest space to world space."""

    @unique_kernel()
    def extract_rotations(
        # In
        units: Elements,
        u: wp.array[wp.vec4],
        # Out
        rotations: wp.array[wp.mat33],
    ):
        t = wp.tid()
        q = frame(units, t)
        rotations[t] = rotation(q + local_gradient(units, t, u)) * wp.transpose(q)

    return extract_rotations


# --- own rotations in closed form ------------------------------------------------------------------------------------
#
# The corotated stress without an iteration on matrices: the stretch S of F = R S by a root of its trace, with the
# digits of E = F^T F - I however small it is, for J > 0: see ``native/laws.h``. Flat and turned over elements have
# their rotations from ``robust_rotation``.


@wp.func_native("return corot::has_stretch(a);")
def has_stretch(a: wp.mat33) -> bool:
    """Whether F = I + A is neither flat, turned over nor far from order one."""
    ...


closed_stress, _differential, closed_energy = law_functions("corotated")


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
