"""The law of Holzapfel, Gasser and Ogden on the CPU, of eight elements at a time; see ``eights`` and ``fibres``."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .eights import frames, gathering
from .fibres import LEAST, MOST, ReinforcedMaterial
from .lanes import constants, native, on_cpu
from .law_lanes import NEO_HOOKEAN

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_reinforced_eights(Elements: type) -> wp.Kernel:
    """Add the nodal forces of matrix and fibres to f; a thread is eight elements."""
    code = constants(MOST=float(MOST), LEAST=float(LEAST)) + gathering(Elements) + frames(Elements)
    code += NEO_HOOKEAN + native("exp", "reinforced", "scatter_eights")

    @wp.func_native(on_cpu(code))
    def eight_elements(
        units: Elements,
        block: int,
        count: int,
        material: ReinforcedMaterial,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @unique_kernel()
    def scatter_reinforced_eights(
        # In
        elements: Elements,
        count: int,
        material: ReinforcedMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        eight_elements(elements, wp.tid(), count, material, u, f)

    return scatter_reinforced_eights
