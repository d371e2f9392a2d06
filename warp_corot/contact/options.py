"""The options of contact."""

from __future__ import annotations

import math
from dataclasses import dataclass

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_flag, checked_number

#: What contact acts on.
SURFACE, TETRAHEDRA = "surface", "tetrahedra"


@dataclass(frozen=True)
class Contact:
    """Contact of a simulation's bodies with obstacles and with one another.

    Attributes:
        friction: Coulomb's coefficient of friction >= 0 of all contacts; an obstacle may have its own.
        self_contact: Whether bodies touch themselves, too. They touch one another in any case.
        flat_edges: Whether soft surfaces also touch where flat edges of both cross. Then pressure passes evenly between
            any two meshes, however coarse; there are several times as many pairs.
        on: What contact acts on. "surface": a body's own surface, if its mesh was made from a domain. "tetrahedra": the
            boundary of its tetrahedra, which reaches beyond that surface. Meshes without another surface always use
            the boundary, and so do implicit steps on several ranks.

    Raises:
        InputError: A value out of its range.
    """

    friction: float = 0.3
    self_contact: bool = False
    flat_edges: bool = False
    on: str = SURFACE

    def __post_init__(self) -> None:
        checked_friction(self.friction)
        checked_flag(self.self_contact, "self_contact")
        checked_flag(self.flat_edges, "flat_edges")
        checked_choice(self.on, "on", (SURFACE, TETRAHEDRA))


def may_meet(bodies: int, options: Contact) -> bool:
    """Whether soft surfaces may touch: those of several bodies, or of one that touches itself."""
    return bodies > 1 or options.self_contact


def checked_friction(given: float) -> float:
    """A coefficient of friction.

    Raises:
        InputError: It is negative or not finite.
    """
    if not 0.0 <= checked_number(given, "friction") < math.inf:
        raise InputError(f"friction is {given}; it must be zero or a positive number")
    return float(given)
