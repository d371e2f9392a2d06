"""Eight of a thing side by side in the lanes of a CPU's vector registers: C++ that the fast CPU kernels share.

A CPU core is slow without vectorisation. The lanes here are the compiler's own vector type: code on them compiles in
about a second, needs no optimiser to find the vectors, and so is right and fast with any flags. The same in Warp's
8-lane vectors took ten times as long to compile and was as fast only where the optimiser saw through it.

The code is in the headers of ``native``: laws, which work on any scalar, and traversals, which gather eight elements or
subtrees and scatter their forces. A kernel here is one call of a traversal with a law. The result of a lane never
depends on its neighbours, and forces are added lane after lane, so worlds that share registers move exactly as each
would alone.
"""

import functools
import re
from pathlib import Path

import warp as wp

from warp_corot.kernels.modules import unique_kernel

LANES = 8

NATIVE = Path(__file__).parents[1] / "native"


@functools.cache
def native(name: str) -> str:
    """The text of a header that is a part of a function."""
    return (NATIVE / f"{name}.h").read_text(encoding="utf-8")


@functools.cache
def headers(*names: str, types: str = "") -> wp.ModuleBuildOptions:
    """Options of a module for the CPU that includes headers, and compiles again if one of them has changed.

    Args:
        names: The headers.
        types: C++ that follows them.
    """
    found = {NATIVE / f"{name}.h": None for name in names}
    includes = "".join(f'#include "{path.as_posix()}"\n' for path in found)
    for path in (waiting := list(found)):
        for name in re.findall(r'#include "(.*)"', path.read_text(encoding="utf-8")):
            if NATIVE / name not in found:
                found[NATIVE / name] = None
                waiting.append(NATIVE / name)
    return wp.ModuleBuildOptions(extra_cpu_preamble=includes + types, extra_build_dependencies=list(found))


def constants(**values: float) -> str:
    """C++ that gives names to numbers."""
    kinds = {name: "int" if isinstance(value, int) else "float" for name, value in values.items()}
    return "".join(f"const {kinds[name]} {name} = {value!r};\n" for name, value in values.items())


def on_cpu(*code: str, otherwise: str = "") -> str:
    """A snippet for the CPU, in which ``four`` are four floats; on a GPU it is ``otherwise``."""
    four = "typedef float four __attribute__((vector_size(16), aligned(4)));\n"
    begin = f"#if !defined(__CUDA_ARCH__)\n#pragma clang fp contract(fast)\n{four}"
    return f"{begin}{''.join(code)}\n#else\n{otherwise}#endif\n"


@functools.cache
def scatter_simd8(
    call: str, Units: type, Material: type, missed_type: type, native: wp.ModuleBuildOptions
) -> wp.Kernel:
    """The kernel that adds forces on the CPU; a thread is eight units.

    Args:
        call: A call in C++ that computes eight units. In: units, the number ``block`` of the eight, the ``count`` of
            all, material, u. Out: f, and ``missed``, what is left out.
        Units, Material: Structs of the units and of their material.
        missed_type: uint8: flags of a subtree's leaves; int32: a list of elements, their number first.
        native: The headers that the call needs.
    """

    @wp.func_native(on_cpu(call, ";"))
    def eight_units(
        units: Units,
        block: int,
        count: int,
        material: Material,
        u: wp.array[wp.vec4],
        f: wp.array[wp.vec4],
        missed: wp.array[missed_type],
    ): ...

    @unique_kernel(native=native)
    def scatter_simd8(
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

    return scatter_simd8
