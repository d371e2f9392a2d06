"""Corotated forces of orthotropic elements on the CPU, eight to the lanes of vector registers; see ``elements.simd8``.

Both kinds of elements come as general ones, with M multiplied into their rest matrix: F M = M + (d1 d2 d3) B. An
element of which no rotation is found adds nothing and is put on a list, which ``forces.repair_forces`` goes through.
Elements whose rotation is nearly indefinite are left out, too (see ``anisotropic``): det(tr(S) I - S) = q / 2 below
``NEARLY_INDEFINITE`` |S|^3.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.cpu import rest_inverse_of
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements, frame, rest_volume
from warp_corot.kernels.elements.simd8 import headers, scatter_simd8
from warp_corot.kernels.modules import unique_kernel

from .anisotropic import FibreMaterial, OrthotropicMaterial, axes_of, filled

wp.set_module_options({"enable_backward": False})

#: Corotated forces of orthotropic elements, whose inverse rest matrix is Dm^-1 M, and forces of their active stress.
scatter_anisotropic_simd8 = scatter_simd8(
    "corot::scatter_orthotropic(units, block, count, material, u, f, missed)",
    GeneralElements,
    FibreMaterial,
    wp.int32,
    headers("law_orthotropic"),
)


@wp.func
def turn_element(
    elements: Any,
    material: OrthotropicMaterial,
    t: int,
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    rest_inverse[t] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)) * axes_of(material, t))
    volume[t] = filled(material, t) * rest_volume(elements, t)


@functools.cache
def turn_elements(Elements: type) -> wp.Kernel:
    """Elements of either kind as ``scatter_anisotropic_simd8`` wants them: Dm^-1 M, and the filled volume."""

    @unique_kernel()
    def turn_elements(
        # In
        elements: Elements,
        material: OrthotropicMaterial,
        # Out
        rest_inverse: wp.array[wp.mat33],
        volume: wp.array[wp.float32],
    ):
        turn_element(elements, material, wp.tid(), rest_inverse, volume)

    return turn_elements


@unique_kernel()
def turn_changed(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    now: wp.array[wp.int32],
    before: wp.array[wp.int32],
    elements: ForestElements,
    material: OrthotropicMaterial,
    # Out
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    """The same for leaves that have changed, and for the padding in their places; nothing if ``goes`` is 0."""
    count = wp.max(now[0], before[0])
    if goes[0] == 0:
        count = 0
    for t in range(wp.tid(), count, threads):
        turn_element(elements, material, t, rest_inverse, volume)
