"""Differentials of the isotropic corotated law P = R sigma(e), e = sym(R^T F) - I, for ``elements.forces``.

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
from warp_corot.kernels.elements.elements import GeneralElements, frame, local_gradient
from warp_corot.kernels.elements.simd8 import headers, law_kernel, scatter_simd8
from warp_corot.kernels.math.matrices import axial, identity3
from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})


@wp.func_native("return corot::turning_of(strain);")
def turning_of(strain: wp.mat33) -> wp.mat33:
    """The matrix of axial(R^T dF) that gives w of dR = R [w]x, of S - I; bounded where F has no definite rotation."""
    ...


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
    turning = wp.skew(turning_of(strain) * axial(b))
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


# --- R K R^T with turned gradients that are kept (CPU) ---------------------------------------------------------------
#
# Products with the corotated R K R^T on the CPU, rotations found once; see ``elements.simd8``.
#
# With rotations held fixed, K is the stiffness of linear elasticity with the gradients of hat functions turned by R.
# These gradients are kept, times the root of the volume, so that a product reads 36 bytes an element and does not
# evaluate the law.

#: Places of eight elements in the array of gradients, vec4.
PLACES = 18


@wp.struct
class KeptGradients:
    """Lamé's parameters, and the gradients that ``turn_gradients`` writes."""

    isotropic: IsotropicMaterial
    gradients: wp.array[wp.vec4]


@functools.cache
def turn_gradients() -> wp.Kernel:
    """Write the gradients; a thread is eight elements. Those without a good rotation are listed.

    ``subtrees.degenerate.turn_listed`` writes these.
    """
    call = "corot::turn_gradients(units, block, count, u, f, missed)"
    return scatter_simd8(call, GeneralElements, IsotropicMaterial, wp.int32, headers("tangents8"))


@functools.cache
def add_kept_product() -> wp.Kernel:
    """y += K p; a thread is eight elements."""
    call = "corot::add_kept_product(units, block, count, material, u, f)"
    return scatter_simd8(call, GeneralElements, KeptGradients, wp.int32, headers("tangents8"))


@wp.func
def keep_gradients(elements: GeneralElements, t: int, turn: wp.mat33, gradients: wp.array[wp.vec4]):
    """Write the gradients of one element that has turned."""
    rows = elements.rest_inverse[t]
    root = wp.sqrt(elements.volume[t])
    for n in range(3):
        h = root * (turn * wp.vec3(rows[n, 0], rows[n, 1], rows[n, 2]))
        for axis in range(3):
            place = 18 * (t / 8) + 2 * (3 * n + axis) + (t % 8) / 4
            four = gradients[place]
            four[t % 4] = h[axis]
            gradients[place] = four


# --- the exact derivative, kept (CPU) --------------------------------------------------------------------------------
#
# Products with the exact derivative of corotated forces on the CPU, rotations found once; see ``elements.simd8``.
#
# With gradients of hat functions turned by R and G' = dF R^T, the stress is [t]x sigma(e') + sigma(sym(G' - [t]x e'))
# of the turned strain e' = R e R^T, where t = R W R^T axial(G') and W is the matrix of
# ``turning_of``. All of this is kept, so that a product reads 84 bytes an element and finds no
# determinant.

#: Numbers that an element keeps, and places of eight elements in their array, vec4.
EXACT_NUMBERS, EXACT_PLACES = wp.constant(21), 42


@wp.func_native("""
    float* to = &wp::index(kept, first);
    const auto write = [&](const wp::mat_t<3, 3, float>& a, int place) {
        const float values[6] = {a.data[0][0], a.data[1][1], a.data[2][2], a.data[0][1], a.data[0][2], a.data[1][2]};
        for (int k = 0; k < 6; ++k) to[8 * (place + k)] = values[k];
    };
    for (int n = 0; n < 3; ++n)
        for (int axis = 0; axis < 3; ++axis) to[8 * (3 * n + axis)] = gradients.data[n][axis];
    write(strain, 9);
    write(turning, 15);
""")
def keep_numbers(first: int, gradients: wp.mat33, strain: wp.mat33, turning: wp.mat33, kept: wp.array[wp.float32]):
    """Write rows of gradients, and two symmetric matrices (00, 11, 22, 01, 02, 12), eight numbers apart."""
    ...


@functools.cache
def keep_elements(rotation: wp.Function) -> wp.Kernel:
    """Write what products need, eight elements side by side."""

    @law_kernel()
    def keep_elements(
        # In
        elements: GeneralElements,
        u: wp.array[wp.vec4],
        # Out
        kept: wp.array[wp.float32],
    ):
        t = wp.tid()
        g = local_gradient(elements, t, u)
        r = rotation(identity3() + g)
        first = 8 * EXACT_NUMBERS * (t / 8) + t % 8
        gradients = wp.sqrt(elements.volume[t]) * (elements.rest_inverse[t] * wp.transpose(r))
        strain = corotated_strain(g, identity3(), r)
        turned = wp.transpose(r)
        keep_numbers(first, gradients, r * strain * turned, r * turning_of(strain) * turned, kept)

    return keep_elements


@functools.cache
def add_exact_product() -> wp.Kernel:
    """y += K p; a thread is eight elements."""
    call = "corot::add_exact_product(units, block, count, material, u, f)"
    return scatter_simd8(call, GeneralElements, KeptGradients, wp.int32, headers("tangents8"))
