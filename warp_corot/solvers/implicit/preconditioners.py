"""The preconditioners that users name."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.elements.elements import ForestElements

from .block_diagonal import BlockDiagonal
from .multigrid import Multigrid
from .operator import Preconditioner
from .tangent import TangentOperator

#: Plain elements lock where those that share their dilatation do not: these are preconditioned by compressible ones.
MOST_LAMBDA = 9.0


def _multigrid(operator: TangentOperator) -> Multigrid:
    stiffening = 0.0 if operator.viscosity is None else operator.viscosity.seconds
    most = MOST_LAMBDA if operator.field.shares_dilatation else np.inf
    return Multigrid(operator.body, is_turned=not operator.field.is_linear, stiffening=stiffening, most_lambda=most)


#: By name.
PRECONDITIONERS: dict[str, Callable[[TangentOperator], Preconditioner]] = {
    "multigrid": _multigrid,
    "diagonal": BlockDiagonal,
}


def preconditioner_of(name: Any, operator: TangentOperator) -> Preconditioner:
    """A preconditioner by its name; for None multigrid where the mesh is a forest, else the block diagonal.

    Raises:
        InputError: There is none of this name, or it is multigrid and the mesh is no forest.
    """
    check_preconditioner(name)
    if name is None:
        name = "multigrid" if operator.body.discretization.element_kind is ForestElements else "diagonal"
    return PRECONDITIONERS[name](operator)


def check_preconditioner(name: Any) -> None:
    """Check a name, or None.

    Raises:
        InputError: There is no preconditioner of this name.
    """
    if name is not None and name not in PRECONDITIONERS:
        names = ", ".join(map(repr, PRECONDITIONERS))
        raise InputError(f"preconditioner is {shown(name)}; it must be None or one of {names}")
