"""Viscous forces on the CPU, of eight elements at a time; see ``eights`` and ``viscosity``."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .eights import gathering
from .lanes import LANES, constants, native, on_cpu
from .law_lanes import INDEFINITE
from .viscosity import LEAST, ViscousMaterial, add_viscous_forces

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_viscous_eights(Elements: type) -> wp.Kernel:
    """Add viscous nodal forces to f; a thread is eight elements."""
    code = constants(INDEFINITE=INDEFINITE, LEAST=float(LEAST)) + gathering(Elements)
    code += native("invariants", "stretch", "rotation", "viscous", "viscous_elements", "scatter_eights")

    @wp.func_native(on_cpu(code, "return left_out;\n", otherwise="return 0;\n"))
    def eight_elements(
        units: Elements, block: int, count: int, material: ViscousMaterial, u: wp.array[wp.vec4], f: wp.array[wp.vec4]
    ) -> int: ...

    @unique_kernel()
    def scatter_viscous_eights(
        # In
        elements: Elements,
        count: int,
        material: ViscousMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        block = wp.tid()
        left_out = eight_elements(elements, block, count, material, u, f)
        lane = int(0)
        while left_out != 0:
            if (left_out & 1) != 0:
                t = LANES * block + lane
                add_viscous_forces(elements, t, material, u, f)
            left_out >>= 1
            lane += 1

    return scatter_viscous_eights
