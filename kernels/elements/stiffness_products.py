"""Products with the tangent stiffness K, minus the derivative of the elastic forces, element by element.

``differential`` is a device function (elements, t, material, u, dg) -> dP: the directional derivative of element t's
first Piola-Kirchhoff stress, in the local frame as ``elements.scatter_stress`` takes it, at nodal displacements u. Its
direction dg is the local gradient of another nodal vector (``elements.local_gradient``). ``Material`` is the struct
that it reads. Every kind of elements and every law has these two kernels; sums are atomic.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .constitutive import IsotropicMaterial
from .elements import add_nodal_forces, frame, gradient_of, local_gradient, rest_volume

wp.set_module_options({"enable_backward": False})


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

    @unique_kernel()
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

    @unique_kernel()
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
