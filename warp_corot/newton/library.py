"""The only module that imports Newton, and the arguments of a step with Newton's types."""

from __future__ import annotations

from typing import NamedTuple

import warp as wp

from warp_corot.errors import InputError


class MissingNewton(InputError, ImportError):
    """Newton is not installed, or is too old."""


try:
    import newton
    from newton.solvers import SolverBase, SolverSemiImplicit
    from newton.solvers.experimental.coupled import CouplingInterface, ModelView
except ImportError as error:
    raise MissingNewton(
        f'warp_corot.newton needs Newton 1.8 or newer: pip install "warp-corot[newton]" ({error})'
    ) from None

__all__ = [
    "CouplingInterface",
    "MissingNewton",
    "ModelView",
    "SolverBase",
    "SolverSemiImplicit",
    "Step",
    "newton",
]


class Step(NamedTuple):
    """The arguments of ``SolverCorotated.step`` or of one of its substeps, and the array for the mean wrenches of
    contacts in the step."""

    state_in: newton.State
    state_out: newton.State
    control: newton.Control | None
    contacts: newton.Contacts | None
    dt: float
    reported: wp.array | None = None
