"""Products with the corotated R K R^T on the CPU, rotations found once; see ``elements.simd8``.

With rotations held fixed, K is the stiffness of linear elasticity with the gradients of hat functions turned by R.
These gradients are kept, times the root of the volume, so that a product reads 36 bytes an element and does not
evaluate the law.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.simd8 import headers, scatter_simd8

wp.set_module_options({"enable_backward": False})

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

    ``subtrees.repair.turn_listed`` writes these.
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
