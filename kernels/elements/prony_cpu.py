"""Maxwell elements on the CPU, in eight elements at a time; see ``eights`` and ``prony``."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.stepping.pace import DT, Pace

from .eights import frames, gathering
from .lanes import native, on_cpu
from .prony import PronyMaterial

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_prony_eights(Elements: type) -> wp.Kernel:
    """Add the nodal forces of the Maxwell elements to f; a thread is eight elements."""
    code = "const float time = material.elapsed.data[0];\n" + gathering(Elements) + frames(Elements)
    code += native("prony", "prony_stress", "scatter_eights")

    @wp.func_native(on_cpu(code))
    def eight_elements(
        units: Elements, block: int, count: int, material: PronyMaterial, u: wp.array[wp.vec4], f: wp.array[wp.vec4]
    ): ...

    @unique_kernel()
    def scatter_prony_eights(
        # In
        elements: Elements,
        count: int,
        material: PronyMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        eight_elements(elements, wp.tid(), count, material, u, f)

    return scatter_prony_eights


@functools.cache
def relax_eights(Elements: type) -> wp.Kernel:
    """Make the state at displacements u, after a step of the clock's length, the known one; a thread is eight
    elements."""

    @wp.func_native(on_cpu(gathering(Elements) + frames(Elements) + native("prony", "prony_relax")))
    def eight_elements(
        units: Elements, block: int, count: int, u: wp.array[wp.vec4], time: float, material: PronyMaterial
    ): ...

    @unique_kernel()
    def relax_eights(
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

    return relax_eights
