"""The relaxation of Maxwell elements on the CPU, in eight elements at a time; see ``simd8`` and ``prony``."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.stepping.pace import DT, Pace

from .elements import ForestElements
from .prony import PronyMaterial
from .simd8 import headers, on_cpu

wp.set_module_options({"enable_backward": False})


@functools.cache
def relax_simd8(Elements: type) -> wp.Kernel:
    """Make the state at displacements u, after a step of the clock's length, the known one; a thread is eight
    elements."""

    traversal = "ForestEight" if Elements is ForestElements else "ListableGeneralEight"

    @wp.func_native(on_cpu(f"corot::relax_eight<corot::{traversal}>(material, units, block, count, u, time);"))
    def eight_elements(
        units: Elements, block: int, count: int, u: wp.array[wp.vec4], time: float, material: PronyMaterial
    ): ...

    @unique_kernel(native=headers("elements8", "added"))
    def relax_simd8(
        # In
        elements: Elements,
        count: int,
        u: wp.array[wp.vec4],
        pace: Pace,
        # In and out
        material: PronyMaterial,
    ):
        block = wp.tid()
        eight_elements(elements, block, count, u, float(pace.seconds[DT]), material)
        if block == 0:
            material.elapsed[0] = 0.0

    return relax_simd8
