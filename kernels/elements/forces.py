"""Kernel factories of the element loop: forces, energies and stresses of a law on a kind of elements.

``stress``, ``energy`` and ``cauchy`` are functions of ``constitutive``; ``Elements`` is a struct of ``elements``.
Material parameters are arrays of one entry (uniform) or one per element; ``stride`` is 0 or 1 accordingly.
"""

import functools
from typing import Any

import warp as wp

from .elements import ForestElements, GeneralElements, frame, local_gradient, rest_volume, scatter_stress

wp.set_module_options({"enable_backward": False})


@wp.func
def von_mises(s: wp.mat33):
    """sqrt(3/2 dev s : dev s) of a symmetric stress."""
    a = s[0, 0] - s[1, 1]
    b = s[1, 1] - s[2, 2]
    c = s[2, 2] - s[0, 0]
    shear = s[0, 1] * s[0, 1] + s[1, 2] * s[1, 2] + s[2, 0] * s[2, 0]
    return wp.sqrt(0.5 * (a * a + b * b + c * c) + 3.0 * shear)


@wp.func
def own_gradient(elements: ForestElements, t: int, u: wp.array[wp.vec4]):
    """A = Q^T G: the displacement gradient of element t in its local frame, rows and columns."""
    return wp.transpose(frame(elements, t)) * local_gradient(elements, t, u)


@wp.func
def own_gradient(elements: GeneralElements, t: int, u: wp.array[wp.vec4]):
    return local_gradient(elements, t, u)


@wp.func
def scatter_own_stress(elements: ForestElements, t: int, p: wp.mat33, f: wp.array[wp.vec4]):
    """Add the nodal forces of a first Piola-Kirchhoff stress in the frame of ``own_gradient``."""
    scatter_stress(elements, t, frame(elements, t) * p, f)


@wp.func
def scatter_own_stress(elements: GeneralElements, t: int, p: wp.mat33, f: wp.array[wp.vec4]):
    scatter_stress(elements, t, p, f)


@functools.cache
def scatter_forces(Elements: Any, stress: wp.Function) -> wp.Kernel:
    """Add the elastic nodal forces of a law to f."""

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_forces(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        p = stress(own_gradient(elements, t, u), mu[t * stride], lam[t * stride])
        scatter_own_stress(elements, t, p, f)

    return scatter_forces


@functools.cache
def element_energies(Elements: Any, energy: wp.Function) -> wp.Kernel:
    """Strain energy of each element [J], in float64 so that sums over millions keep their digits."""

    @wp.kernel(module="unique", enable_backward=False)
    def element_energies(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        energies: wp.array[wp.float64],
    ):
        t = wp.tid()
        density = energy(own_gradient(elements, t, u), mu[t * stride], lam[t * stride])
        energies[t] = wp.float64(density) * wp.float64(rest_volume(elements, t))

    return element_energies


@functools.cache
def element_von_mises(Elements: Any, cauchy: wp.Function) -> wp.Kernel:
    """Von Mises stress of each element [Pa]."""

    @wp.kernel(module="unique", enable_backward=False)
    def element_von_mises(
        # In
        elements: Elements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        stride: int,
        u: wp.array[wp.vec4],
        # Out
        stress: wp.array[wp.float32],
    ):
        t = wp.tid()
        stress[t] = von_mises(cauchy(own_gradient(elements, t, u), mu[t * stride], lam[t * stride]))

    return element_von_mises
