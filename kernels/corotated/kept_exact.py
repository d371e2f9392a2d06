"""Products with the exact derivative of corotated forces on the CPU, rotations found once; see ``elements.simd8``.

With gradients of hat functions turned by R and G' = dF R^T, the stress is [t]x sigma(e') + sigma(sym(G' - [t]x e')) of
the turned strain e' = R e R^T, where t = R W R^T axial(G') and W is the matrix of ``tangent.rotation_differential``.
All of this is kept, so that a product reads 84 bytes an element and finds no determinant.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain
from warp_corot.kernels.elements.elements import GeneralElements, local_gradient
from warp_corot.kernels.elements.simd8 import headers, scatter_simd8
from warp_corot.kernels.math.matrices import identity3
from warp_corot.kernels.modules import unique_kernel

from .kept_gradients import KeptGradients
from .tangent import stretch_turning

wp.set_module_options({"enable_backward": False})

#: Numbers that an element keeps, and places of eight elements in their array, vec4.
NUMBERS, PLACES = wp.constant(21), 42


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

    @unique_kernel()
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
        first = 8 * NUMBERS * (t / 8) + t % 8
        gradients = wp.sqrt(elements.volume[t]) * (elements.rest_inverse[t] * wp.transpose(r))
        strain = corotated_strain(g, identity3(), r)
        adjugate, det, scale = stretch_turning(strain)
        turned = wp.transpose(r)
        keep_numbers(first, gradients, r * strain * turned, (scale / det) * (r * adjugate * turned), kept)

    return keep_elements


@functools.cache
def add_exact_product() -> wp.Kernel:
    """y += K p; a thread is eight elements."""
    call = "corot::add_exact_product(units, block, count, material, u, f)"
    return scatter_simd8(call, GeneralElements, KeptGradients, wp.int32, headers("tangents8"))
