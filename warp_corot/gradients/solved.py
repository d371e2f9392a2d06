"""A state of rest in the requested precision; SciPy is imported only for float64."""

from __future__ import annotations

from typing import Any

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated, Model
from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

from .rest_state import RestState

FLOAT32, FLOAT64 = "float32", "float64"


def solved_state(body: SoftBody, *, precision: str = FLOAT32, model: Model | None = None, **options: Any) -> Any:
    """A ``RestState`` or a ``PreciseState`` of a body.

    Args:
        body: The body.
        precision: As for ``static_gradient``.
        model: As for ``solve_static``.
        options: Other arguments of ``RestState``.

    Raises:
        InputError, ConvergenceError: As ``static_gradient``.
    """
    if precision not in (FLOAT32, FLOAT64):
        raise InputError(f"precision is {shown(precision)}; it must be {FLOAT32!r} or {FLOAT64!r}")
    if precision == FLOAT64 and isinstance(body, SoftBody):
        from warp_corot.solvers.implicit.precise import checked_float64_law

        checked_float64_law(body, Corotated() if model is None else model)
    solved = RestState(body, model=model, **options)
    if precision == FLOAT32:
        return solved
    from .precise import PreciseState

    return PreciseState(solved)
