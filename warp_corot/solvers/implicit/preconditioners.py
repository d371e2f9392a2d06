"""The preconditioners by the names that users pass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.elements.elements import ForestElements

from .block_diagonal import BlockDiagonal
from .multigrid import Multigrid
from .operator import Preconditioner
from .tangent import TangentOperator

#: Elements that share their dilatation, preconditioned by plain ones that are compressible, since these lock.
PLAIN: dict[str, Any] = {"most_lambda": 4.0}
#: The same where they share it at nodes. As the two differ, better smoothing saves no iterations there.
AT_NODES: dict[str, Any] = {"degree": 2, "rise": 0, **PLAIN}
#: Elements that share their dilatation in groups. A larger lambda would take smoothers that multigrid does not have.
#: Left to conjugate gradients, it costs fewer iterations.
IN_GROUPS: dict[str, Any] = {"most_shared": 40.0}
#: A short cycle on the CPU: its sweeps, and the number of nodes of a level that is not made coarser.
SHORT: dict[str, Any] = {"sweeps": 1, "few_nodes": 24}
#: Cycles on the CPU for solves that need few digits: two pairs of sweeps cost half as much as Chebyshev's iteration of
#: degree 5, and take a third to a half more iterations.
SWEPT: dict[str, Any] = {"sweeps": 2}
#: The smoother's degree on the finest level of several ranks, which cannot sweep: of short cycles, and of others.
SHORT_DEGREE, DEGREE = 2, 5
#: The number of elements from which on the finest level goes over subtrees on CUDA, where it can. On an H200 a Newton
#: step of 73,728 elements takes 1.90 ms in place of 1.86 (2.16 and 2.67 with a shared dilatation), one of 147,456
#: elements 2.3 and 2.4 (2.8 and 4.2); smaller bodies were not measured.
FEWEST_OVER_SUBTREES = 1 << 16


def _multigrid(operator: TangentOperator, short_cycles: bool, few_digits: bool) -> Multigrid:
    stiffening = 0.0 if operator.viscosity is None else operator.viscosity.seconds
    shares = operator.field.shares_dilatation
    members = operator.field.find_members
    options: dict[str, Any] = {}
    is_short = short_cycles and operator.device.is_cpu
    if is_short:
        # Solves that begin near the answer take few iterations, which are worth less than what they cost.
        options, members = SHORT | (PLAIN if shares else {}), None
    elif shares:
        options = AT_NODES if members is None else IN_GROUPS
    elif few_digits and operator.device.is_cpu:
        options = SWEPT
    is_turned = not operator.field.is_linear
    over_ranks = {"degree": SHORT_DEGREE if is_short else DEGREE, "is_turned": is_turned, **options}
    if (make := operator.ranks.owned(operator.body).multigrid) is not None:
        return make(over_ranks | {"stiffening": stiffening, "members": members})
    if operator.device.is_cuda and operator.body.sizes.elements >= FEWEST_OVER_SUBTREES and options in ({}, IN_GROUPS):
        options = options | {"assembled": False}
    return Multigrid(operator.body, is_turned=is_turned, stiffening=stiffening, members=members, **options)


#: The preconditioners by name.
PRECONDITIONERS: dict[str, Callable[[TangentOperator, bool, bool], Preconditioner]] = {
    "multigrid": _multigrid,
    "diagonal": lambda operator, *_: BlockDiagonal(operator),
}


def preconditioner_of(
    name: Any, operator: TangentOperator, *, short_cycles: bool = False, few_digits: bool = False
) -> Preconditioner:
    """A preconditioner by its name; for None, multigrid if the mesh is a forest, else the block diagonal.

    Args:
        name: One of ``PRECONDITIONERS``, or None.
        operator: The operator.
        short_cycles: Whether solves begin near the answer and need few digits.
        few_digits: Whether solves need few digits.

    Raises:
        InputError: There is none with this name, or it is multigrid and the mesh is not a forest.
    """
    check_preconditioner(name)
    if name is None:
        is_forest = operator.body.discretization.element_kind is ForestElements
        name = "multigrid" if is_forest and operator.ranks.owned(operator.body).has_multigrid else "diagonal"
    return PRECONDITIONERS[name](operator, short_cycles, few_digits)


def check_preconditioner(name: Any) -> None:
    """Check a name, or None.

    Raises:
        InputError: There is no preconditioner of this name.
    """
    if name is not None and not (isinstance(name, str) and name in PRECONDITIONERS):
        names = ", ".join(map(repr, PRECONDITIONERS))
        raise InputError(f"preconditioner is {shown(name)}; it must be None or one of {names}")
