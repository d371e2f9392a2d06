"""Kernel factories of the element loop: forces, energies and stresses of a law on a kind of elements.

``law`` arguments are functions of ``constitutive``; ``Elements`` is a struct of ``elements``. Material parameters are
arrays of one entry (uniform) or one per element; ``stride`` is 0 or 1 accordingly.
"""

import functools
from typing import Any

import warp as wp

from .elements import frame, local_gradient, rest_volume, scatter_stress

wp.set_module_options({"enable_backward": False})


@wp.func
def von_mises(s: wp.mat33):
    """sqrt(3/2 dev s : dev s) of a symmetric stress."""
    a = s[0, 0] - s[1, 1]
    b = s[1, 1] - s[2, 2]
    c = s[2, 2] - s[0, 0]
    shear = s[0, 1] * s[0, 1] + s[1, 2] * s[1, 2] + s[2, 0] * s[2, 0]
    return wp.sqrt(0.5 * (a * a + b * b + c * c) + 3.0 * shear)


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
        g = local_gradient(elements, t, u)
        scatter_stress(elements, t, stress(g, frame(elements, t), mu[t * stride], lam[t * stride]), f)

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
        g = local_gradient(elements, t, u)
        density = energy(g, frame(elements, t), mu[t * stride], lam[t * stride])
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
        g = local_gradient(elements, t, u)
        stress[t] = von_mises(cauchy(g, frame(elements, t), mu[t * stride], lam[t * stride]))

    return element_von_mises
