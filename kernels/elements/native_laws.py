"""The laws of ``native`` for eight elements in the lanes of registers, as C++ with their material."""

import math
from typing import NamedTuple

from .ogden import part_of_volume, stretch_limits


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
PRONY = NativeLaw("corot::prony(material)", "added")
PRESTRESS = NativeLaw("corot::prestressed(material)", "added")
VISCOUS = NativeLaw("corot::viscous(material)", "added", True)

#: The structs of isotropic laws by their names.
LAWS = {"corotated": "Corotated", "linear": "Linear", "stvk": "StVenantKirchhoff", "neo-hookean": "NeoHookean"}
#: No law, for what has a shared dilatation alone.
STRESSLESS = "stressless"

#: An isotropic law: a name, or the terms (share, alpha) of Ogden's.
IsotropicLaw = str | tuple[tuple[float, float], ...]


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
