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
    rotated_stress,
)
from warp_corot.kernels.elements.elements import (
    frame,
    local_gradient,
)
from warp_corot.kernels.modules import unique_kernel

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
