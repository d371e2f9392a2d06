"""The preconditioners that users name."""

from __future__ import annotations

from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

from .block_diagonal import BlockDiagonal
from .operator import LinearOperator, Preconditioner

#: By name.
PRECONDITIONERS = {"diagonal": BlockDiagonal}
#: What is taken if none is named.
DEFAULT = "diagonal"


def preconditioner_of(name: Any, operator: LinearOperator) -> Preconditioner:
    """A preconditioner by its name, or what is chosen for the operator's mesh for None.

    Raises:
        InputError: There is none of this name.
    """
    if name is None:
        return PRECONDITIONERS[DEFAULT](operator)
    check_preconditioner(name)
    return PRECONDITIONERS[name](operator)


def check_preconditioner(name: Any) -> None:
    """Check a name, or None.

    Raises:
        InputError: There is no preconditioner of this name.
    """
    if name is not None and name not in PRECONDITIONERS:
        names = ", ".join(map(repr, PRECONDITIONERS))
        raise InputError(f"preconditioner is {shown(name)}; it must be None or one of {names}")
