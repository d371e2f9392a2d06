"""The only module that imports Newton."""

from __future__ import annotations

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
    "newton",
]
