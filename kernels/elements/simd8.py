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
import math
import re
from pathlib import Path
from typing import NamedTuple

import warp as wp

from warp_corot.kernels.modules import unique_kernel

LANES = 8

NATIVE = Path(__file__).parents[1] / "native"


@functools.cache
def native(name: str) -> str:
    """The text of a header that is a part of a function."""
    return (NATIVE / f"{name}.h").read_text(encoding="utf-8")


@functools.cache
def headers(*names: str, types: str = "", cuda: bool = False) -> wp.ModuleBuildOptions:
    """Options of a module for the CPU that includes headers, and compiles again if one of them has changed.

    Args:
        names: The headers.
        types: C++ that follows them.
        cuda: Whether the module includes them on CUDA, too.
    """
    found = {NATIVE / f"{name}.h": None for name in names}
    includes = "".join(f'#include "{path.as_posix()}"\n' for path in found)
    for path in (waiting := list(found)):
        for name in re.findall(r'#include "(.*)"', path.read_text(encoding="utf-8")):
            if NATIVE / name not in found:
                found[NATIVE / name] = None
                waiting.append(NATIVE / name)
    return wp.ModuleBuildOptions(
        extra_cpu_preamble=includes + types,
        extra_cuda_preamble=includes if cuda else "",
        extra_build_dependencies=list(found),
    )


#: What modules of kernels that call laws of single elements include.
LAW_HEADERS = headers("single", cuda=True)
#: The decorator of such kernels.
law_kernel = functools.partial(unique_kernel, native=LAW_HEADERS)


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


# --- laws, as C++ with their material --------------------------------------------------------------------------------
#
# The laws of ``native`` for eight elements in the lanes of registers, as C++ with their material.


class NativeLaw(NamedTuple):
    """A law with its material.

    Attributes:
        code: The C++ expression; ``material`` is the struct that a kernel reads.
        header: The header that has it.
        leaves_out: Whether it leaves elements out, where it cannot find their rotation.
    """

    code: str
    header: str = "laws"
    leaves_out: bool = False


FIBRES = NativeLaw("corot::fibres(material)", "law_fibres")
ORTHOTROPIC = NativeLaw("corot::orthotropic(material)", "law_orthotropic", True)
PRONY = NativeLaw("corot::prony(material)", "added")
PRESTRESS = NativeLaw("corot::prestressed(material)", "added")
VISCOUS = NativeLaw("corot::viscous(material)", "added", True)

#: The structs of isotropic laws by their names.
LAWS = {"corotated": "Corotated", "linear": "Linear", "stvk": "StVenantKirchhoff", "neo-hookean": "NeoHookean"}
#: No law, for what has a shared dilatation alone.
STRESSLESS = "stressless"

#: An isotropic law: a name, or the terms (share, alpha) of Ogden's.
IsotropicLaw = str | tuple[tuple[float, float], ...]


#: A term of Ogden's law continues as a parabola where it would be this many times as stiff as at rest.
STIFFENING = 1000.0


def stretch_limits(alpha: float) -> tuple[float, float]:
    """Smallest and largest principal stretch at which a term with this exponent is the plain law."""
    low = STIFFENING ** (-1.0 / (2.0 - alpha)) if alpha < 0.0 else 0.5 if alpha < 2.0 else 0.01
    high = STIFFENING ** (1.0 / max(alpha - 2.0, 1.0))
    return low, high


def part_of_volume(share: float, alpha: float) -> float:
    """v_p of a term, see ``native/law_ogden.h``."""
    return 2.0 * share / alpha if alpha > 0.0 else share


def bare(law: IsotropicLaw) -> NativeLaw:
    """An isotropic law whose stress takes Lamé's parameters."""
    if isinstance(law, str):
        return NativeLaw(f"corot::{LAWS[law]}{{}}", leaves_out=law == "corotated")
    rows = []
    for share, alpha in law:
        low, high = ((stretch**2 - 1.0) / 2.0 for stretch in stretch_limits(alpha))
        m = 2.0 * share / alpha
        rest, power = m - part_of_volume(share, alpha), 0.5 * alpha - 1.0
        rows.append((m, rest, power, low, high, math.log1p(2.0 * low), math.log1p(2.0 * high)))
    terms = ", ".join("{" + ", ".join(f"{number!r}f" for number in row) + "}" for row in rows)
    volume_part = sum(part_of_volume(*term) for term in law)
    return NativeLaw(f"corot::Ogden<{len(law)}>{{{{{terms}}}, {volume_part!r}f}}", "law_ogden")


def elastic(law: IsotropicLaw, material: str = "material") -> NativeLaw:
    """An isotropic law with an ``IsotropicMaterial``."""
    if law == STRESSLESS:
        return NativeLaw("corot::Stressless{}")
    of_numbers = bare(law)
    return of_numbers._replace(code=f"corot::elastic({of_numbers.code}, {material})")
