"""Products with the corotated R K R^T on the CPU, rotations found once; see ``elements.lanes``.

With rotations held fixed, K is the stiffness of linear elasticity with the gradients of hat functions turned by R.
These gradients are kept, times the root of the volume, so that a product reads 36 bytes an element and does not
evaluate the law.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import GeneralElements, local_gradient
from warp_corot.kernels.elements.lanes import headers, scatter_lanes
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.math.rotation import quick_rotation

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
    """Write the gradients; a thread is eight elements. Those without a good rotation are listed."""
    call = "corot::turn_gradients(units, block, count, u, f, missed)"
    return scatter_lanes(call, GeneralElements, IsotropicMaterial, wp.int32, headers("tangents8"))


@functools.cache
def add_kept_product() -> wp.Kernel:
    """y += K p; a thread is eight elements."""
    call = "corot::add_kept_product(units, block, count, material, u, f)"
    return scatter_lanes(call, GeneralElements, KeptGradients, wp.int32, headers("tangents8"))


@wp.kernel(enable_backward=False)
def turn_listed(
    # In
    elements: GeneralElements,
    u: wp.array[wp.vec4],
    # In and out
    listed: wp.array[wp.int32],
    # Out
    gradients: wp.array[wp.vec4],
):
    """The gradients of listed elements, by one thread, which empties the list: how many, then which."""
    for i in range(listed[0]):
        t = listed[i + 1]
        turn = quick_rotation(identity3() + local_gradient(elements, t, u))
        rows = elements.rest_inverse[t]
        root = wp.sqrt(elements.volume[t])
        for n in range(3):
            h = root * (turn * wp.vec3(rows[n, 0], rows[n, 1], rows[n, 2]))
            for axis in range(3):
                place = 18 * (t / 8) + 2 * (3 * n + axis) + (t % 8) / 4
                four = gradients[place]
                four[t % 4] = h[axis]
                gradients[place] = four
    listed[0] = 0
