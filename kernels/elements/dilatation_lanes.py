"""The passes of ``shared_dilatation`` that go through elements on the CPU, eight to the lanes of vector registers."""

import functools

import warp as wp

from .constitutive import CONTINUED_BELOW, IsotropicMaterial
from .dilatation import Dilatation
from .elements import GeneralElements
from .lanes import COMPILER_FLAGS, ISOTROPIC, constants, native, on_cpu

wp.set_module_options({"enable_backward": False})


def law_of(of: Dilatation, has_log: bool = False) -> str:
    """The native code of a law's dilatation; ``has_log``: after neo-Hookean's, which has the logarithm already."""
    if has_log:
        return native(*(name for name in of.lanes if name != "log"))
    return constants(CONTINUED_BELOW=CONTINUED_BELOW) + native(*of.lanes)


@functools.cache
def measure_in_lanes(of: Dilatation) -> wp.Kernel:
    """``measure_elements`` without a direction; a thread is eight elements."""
    code = on_cpu(law_of(of) + native("elements", "element_dilatation", "store_dilatation"))

    @wp.func_native(code)
    def measure_eight(
        units: GeneralElements,
        block: int,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def measure_in_lanes(
        # In
        units: GeneralElements,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        u: wp.array[wp.vec4],
        # Out
        shared: wp.array[wp.vec4],
    ):
        measure_eight(units, wp.tid(), count, places, live, u, shared)

    return measure_in_lanes


@functools.cache
def scatter_in_lanes(of: Dilatation) -> wp.Kernel:
    """``scatter_pressures``; a thread is eight elements."""
    passes = native("elements", "element_dilatation", "dilatation_stresses", "element_forces")

    @wp.func_native(on_cpu(law_of(of) + ISOTROPIC + passes))
    def scatter_eight(
        units: GeneralElements,
        block: int,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
    ): ...

    @wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
    def scatter_in_lanes(
        # In
        units: GeneralElements,
        count: int,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        scatter_eight(units, wp.tid(), count, places, live, material, u, shared, f)

    return scatter_in_lanes
