"""Kernel factories of the element loop: forces, energies and stresses of a law on a kind of elements.

A law is device functions (elements, t, material, u) of element t at nodal displacements u: ``stress``, the first
Piola-Kirchhoff stress as ``elements.scatter_stress`` takes it; ``density``, the energy density; and ``cauchy``, a
tensor with the invariants of the Cauchy stress. ``Elements`` is a struct of ``elements``, ``Material`` the struct that
the law reads; ``kernel`` is the decorator, of a ``Family`` if there is one.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial, push_forward
from warp_corot.kernels.elements.elements import (
    ForestElements,
    GeneralElements,
    add_nodal_forces,
    frame,
    gradient_of,
    local_gradient,
    rest_volume,
    scatter_stress,
)
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.matrices import identity3

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
def to_own_frame(elements: ForestElements, t: int, g: wp.mat33):
    """Q^T G of a local gradient G."""
    return wp.transpose(frame(elements, t)) * g


@wp.func
def to_own_frame(elements: GeneralElements, t: int, g: wp.mat33):
    return g


@wp.func
def own_gradient(elements: Any, t: int, u: wp.array[wp.vec4]):
    """A = Q^T G: the displacement gradient of element t in its local frame, rows and columns."""
    return to_own_frame(elements, t, local_gradient(elements, t, u))


@wp.func
def in_local_frame(elements: ForestElements, t: int, p: wp.mat33):
    """P Q of a first Piola-Kirchhoff stress P in the frame of ``own_gradient``, rows and columns."""
    return frame(elements, t) * p


@wp.func
def in_local_frame(elements: GeneralElements, t: int, p: wp.mat33):
    return p


# --- laws of ``constitutive``, for isotropic materials -------------------------------------------------------------


@functools.cache
def law_stress(stress: wp.Function) -> wp.Function:
    """A law's stress for the kernels below."""

    @wp.func
    def law_stress(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
        i = t * material.stride
        return in_local_frame(elements, t, stress(own_gradient(elements, t, u), material.mu[i], material.lam[i]))

    return law_stress


@functools.cache
def law_cauchy(stress: wp.Function) -> wp.Function:
    """A law's Cauchy stress for the kernels below."""

    @wp.func
    def law_cauchy(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
        i = t * material.stride
        a = own_gradient(elements, t, u)
        return push_forward(identity3() + a, stress(a, material.mu[i], material.lam[i]))

    return law_cauchy


@functools.cache
def law_value(function: wp.Function) -> wp.Function:
    """A law's energy density, or the Cauchy stress of small strains, for the kernels below."""

    @wp.func
    def law_value(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
        i = t * material.stride
        return function(own_gradient(elements, t, u), material.mu[i], material.lam[i])

    return law_value


# --- laws of ``native`` with their material --------------------------------------------------------------------------


class ElementLaw(NamedTuple):
    """A law's stress, its differential and its energy density for the kernels below, and its stress at a displacement
    gradient in the axes of rest space: (t, A, material) -> P.
    """

    stress: wp.Function
    differential: wp.Function
    density: wp.Function
    in_rest_axes: wp.Function


@functools.cache
def element_law(law: str, Material: type) -> ElementLaw:
    """The functions of a law in C++, whose ``material`` is a struct of this type."""

    @wp.func_native(f"return corot::stress_at({law}, t, g, corot::frame_of(q));")
    def stress_at(t: int, g: wp.mat33, q: wp.mat33, material: Material) -> wp.mat33: ...

    @wp.func_native(f"return corot::differential_at({law}, t, g, q, dg);")
    def differential_at(t: int, g: wp.mat33, q: wp.mat33, dg: wp.mat33, material: Material) -> wp.mat33: ...

    @wp.func_native(f"return corot::energy_at({law}, t, g, q);")
    def energy_at(t: int, g: wp.mat33, q: wp.mat33, material: Material) -> float: ...

    @wp.func_native(f"return corot::stress_at({law}, t, a, corot::RestAxes<float>());")
    def in_rest_axes(t: int, a: wp.mat33, material: Material) -> wp.mat33: ...

    @wp.func
    def element_stress(elements: Any, t: int, material: Material, u: wp.array[wp.vec4]):
        return stress_at(t, local_gradient(elements, t, u), frame(elements, t), material)

    @wp.func
    def element_differential(elements: Any, t: int, material: Material, u: wp.array[wp.vec4], dg: wp.mat33):
        return differential_at(t, local_gradient(elements, t, u), frame(elements, t), dg, material)

    @wp.func
    def element_density(elements: Any, t: int, material: Material, u: wp.array[wp.vec4]):
        return energy_at(t, local_gradient(elements, t, u), frame(elements, t), material)

    return ElementLaw(element_stress, element_differential, element_density, in_rest_axes)


# --- kernels of any law on any kind of elements -----------------------------------------------------------------------


@functools.cache
def scatter_forces(Elements: type, Material: type, stress: wp.Function, kernel: Callable = law_kernel) -> wp.Kernel:
    """Add the elastic nodal forces of a law to f; a thread an element."""

    @kernel()
    def scatter_forces(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        scatter_stress(elements, t, stress(elements, t, material, u), f)

    return scatter_forces


@functools.cache
def scatter_chosen(Elements: type, Material: type, stress: wp.Function) -> wp.Kernel:
    """The same of some of the elements; a thread is one of these."""

    @law_kernel()
    def scatter_chosen(
        # In
        elements: Elements,
        chosen: wp.array[wp.int32],
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = chosen[wp.tid()]
        scatter_stress(elements, t, stress(elements, t, material, u), f)

    return scatter_chosen


@functools.cache
def repair_forces(Elements: type, Material: type, stress: wp.Function) -> wp.Kernel:
    """The same for the elements on a list (their number, then their indices), by one thread, which empties the list."""

    @law_kernel()
    def repair_forces(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        # In and out
        listed: wp.array[wp.int32],
        # Out
        f: wp.array[wp.vec4],
    ):
        for i in range(listed[0]):
            t = listed[i + 1]
            scatter_stress(elements, t, stress(elements, t, material, u), f)
        listed[0] = 0

    return repair_forces


@functools.cache
def element_energies(
    Elements: type, Material: type, density: wp.Function, kernel: Callable = law_kernel, adds: bool = False
) -> wp.Kernel:
    """Strain energy of each element [J], in float64 so that sums over millions keep their digits; or add it to a known
    one.
    """

    @kernel()
    def element_energies(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        # Out, or in and out
        energies: wp.array[wp.float64],
    ):
        t = wp.tid()
        energy = wp.float64(density(elements, t, material, u)) * wp.float64(rest_volume(elements, t))
        if wp.static(adds):
            energy += energies[t]
        energies[t] = energy

    return element_energies


@functools.cache
def element_von_mises(Elements: type, Material: type, cauchy: wp.Function, kernel: Callable = law_kernel) -> wp.Kernel:
    """Von Mises stress of each element [Pa]."""

    @kernel()
    def element_von_mises(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        stress: wp.array[wp.float32],
    ):
        t = wp.tid()
        stress[t] = von_mises(cauchy(elements, t, material, u))

    return element_von_mises


# --- products with the stiffness -------------------------------------------------------------------------------------
#
# Products with the tangent stiffness K, minus the derivative of the elastic forces, element by element.
#
# ``differential`` is a device function (elements, t, material, u, dg) -> dP: the directional derivative of element
# t's first Piola-Kirchhoff stress, in the local frame as ``elements.scatter_stress`` takes it, at nodal displacements
# u. Its direction dg is the local gradient of another nodal vector (``elements.local_gradient``). ``Material`` is the
# struct that it reads. Every kind of elements and every law has these two kernels; sums are atomic.


@functools.cache
def law_differential(law: wp.Function) -> wp.Function:
    """The differential for these kernels of one of ``constitutive``."""

    @wp.func
    def law_differential(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        i = t * material.stride
        q = frame(elements, t)
        a = wp.transpose(q) * local_gradient(elements, t, u)
        return q * law(a, wp.transpose(q) * dg, material.mu[i], material.lam[i])

    return law_differential


@functools.cache
def add_stiffness_product(Elements: type, Material: type, differential: wp.Function) -> wp.Kernel:
    """y += K(u) p; a thread an element."""

    @law_kernel()
    def add_stiffness_product(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        p: wp.array[wp.vec4],
        # In and out
        y: wp.array[wp.vec4],
    ):
        t = wp.tid()
        stress = differential(elements, t, material, u, local_gradient(elements, t, p))
        add_nodal_forces(elements, t, -stress, elements.nodes[t], y)

    return add_stiffness_product


@wp.func
def where_is(chosen: bool, v: wp.vec3):
    return wp.where(chosen, v, wp.vec3())


@functools.cache
def add_stiffness_diagonal(Elements: type, Material: type, differential: wp.Function) -> wp.Kernel:
    """Add the 3x3 blocks on K(u)'s diagonal to those of the nodes; a thread a node of an element."""

    @law_kernel()
    def add_stiffness_diagonal(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        t = wp.tid() // 4
        n = wp.tid() % 4
        # The gradient of the node's hat function: of its displacements alone, G = u (grad N)^T.
        x = wp.vec3(1.0, 0.0, 0.0)
        unit = gradient_of(
            elements, t, where_is(n == 0, x), where_is(n == 1, x), where_is(n == 2, x), where_is(n == 3, x)
        )
        hat = wp.vec3(unit[0, 0], unit[0, 1], unit[0, 2])
        scaled = rest_volume(elements, t) * hat
        block = wp.mat33()
        axis = int(0)
        # Not unrolled: the differential is compiled once.
        while axis < 3:
            e = wp.vec3(float(axis == 0), float(axis == 1), float(axis == 2))
            block += wp.outer(differential(elements, t, material, u, wp.outer(e, hat)) * scaled, e)
            axis += 1
        wp.atomic_add(blocks, elements.nodes[t][n], block)

    return add_stiffness_diagonal
