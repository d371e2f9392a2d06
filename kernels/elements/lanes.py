"""Eight of a thing side by side in the lanes of a CPU's vector registers: native code that the fast CPU kernels share.

A CPU core is slow without vectorisation. The lanes here are the compiler's own vector type: code on them compiles in
about a second, needs no optimiser to find the vectors, and so is right and fast with any flags. The same in Warp's
8-lane vectors took ten times as long to compile and was as fast only where the optimiser saw through it.

Memory is read and written four floats of a lane at a time and transposed in registers: written float by float, lanes
would be read before the stores have arrived.

The result of a lane never depends on its neighbours, and forces are added lane after lane, so worlds that share
registers move exactly as each would alone.
"""

import functools
from pathlib import Path

import warp as wp

from warp_corot.kernels.modules import unique_kernel

LANES = 8

#: Native code in files of its own. Each file states its inputs and outputs. The files are parts of one function and
#: follow one another in it.
NATIVE = Path(__file__).parents[1] / "native"


#: Native code that gathers eight elements.
ELEMENTS = ("eights", "side_by_side", "rest_elements", "elements")


@functools.cache
def native(*names: str) -> str:
    """The native code of some files, in this order."""
    return "".join((NATIVE / f"{name}.h").read_text(encoding="utf-8") for name in names)


def constants(**values: float) -> str:
    """Native code that gives names to numbers."""
    kinds = {name: "int" if isinstance(value, int) else "float" for name, value in values.items()}
    return "".join(f"const {kinds[name]} {name} = {value!r};\n" for name, value in values.items())


#: Where native code finds Lamé's parameters: in ``IsotropicMaterial``, or in a material of which that is a part.
ISOTROPIC = "const auto& isotropic = material;\n"
ISOTROPIC_PART = "const auto& isotropic = material.isotropic;\n"


def on_cpu(*code: str, otherwise: str = "") -> str:
    """A native snippet on lanes; where Warp compiles it for a GPU, it is ``otherwise``."""
    on_lanes = f"#pragma clang fp contract(fast)\n{native('lanes')}{''.join(code)}"
    return f"#if !defined(__CUDA_ARCH__)\n{on_lanes}#else\n{otherwise}#endif\n"


@functools.cache
def scatter_lanes(code: str, Units: type, Material: type, missed_type: type) -> wp.Kernel:
    """The kernel that adds forces on the CPU; a thread is eight units.

    Args:
        code: C++ code for eight units. In: units, the number ``block`` of the eight, the ``count`` of all, material, u.
            Out: f, and ``missed``, what is left out.
        Units, Material: Structs of the units and of their material.
        missed_type: uint8: flags of a subtree's leaves; int32: a list of elements, their number first.
    """

    @wp.func_native(on_cpu(code))
    def eight_units(
        units: Units,
        block: int,
        count: int,
        material: Material,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
        missed: wp.array[missed_type],
    ): ...

    @unique_kernel()
    def scatter_lanes(
        # In
        units: Units,
        count: int,
        material: Material,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        missed: wp.array[missed_type],
    ):
        eight_units(units, wp.tid(), count, material, u, f, missed)

    return scatter_lanes
