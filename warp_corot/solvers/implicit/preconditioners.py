"""The preconditioners by the names that users pass, and the choice between these and the assembled matrix."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.implicit import lagged as kernels
from warp_corot.kernels.implicit.tangent import apply_blocks, invert_blocks
from warp_corot.solvers.halo import ALONE, Halo

from .assembled import AssembledSolve
from .multigrid import Multigrid
from .operator import Preconditioner, Springs
from .tangent import TangentOperator

if TYPE_CHECKING:
    from .block_system import BlockSystem


class BlockDiagonal:
    """z = B r with the inverse of each node's own block; blocks are made positive definite if necessary.

    Args:
        operator: The operator, for its sizes.
    """

    def __init__(self, operator: TangentOperator):
        self._operator, self.device = operator, operator.device
        # The arrays of a mesh that changes keep their length.
        self._inverses = wp.zeros(len(operator.inverse_mass), dtype=wp.mat33, device=self.device)

    def update(self, operator: TangentOperator) -> None:
        self._launch(invert_blocks, [operator.diagonal_blocks()], [self._inverses])

    def apply(self, r: wp.array, z: wp.array) -> None:
        self._launch(apply_blocks, [self._inverses, r], [z])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        count = self._operator.worlds * self._operator.node_count
        wp.launch(kernel, count, inputs, outputs, device=self.device)


class Seen:
    """An operator with some of its members replaced."""

    def __init__(self, operator: TangentOperator, **members: wp.array | None):
        self._operator = operator
        vars(self).update(members)

    def __getattr__(self, name: str) -> object:
        return getattr(self._operator, name)


class Lagged:
    """The preconditioner of an earlier state, as long as it is good enough.

    Args:
        preconditioner: The preconditioner that is set up now and then.
        operator: The operator of all solves.
        ranks: The ranks with other nodes of the body.

    Attributes:
        state: Arrays by name to be kept with the state of the body, so that a resumed run is the same.
    """

    def __init__(self, preconditioner: Multigrid, operator: TangentOperator, ranks: Halo = ALONE):
        self._ranks = ranks
        self.preconditioner, self._operator, self.device = preconditioner, operator, operator.device
        self._counts = wp.zeros(kernels.COUNTS, dtype=wp.int32, device=self.device)
        self._due = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._is_prepared = False
        # Arrays of a mesh that changes keep their length.
        length = len(operator.inverse_mass)
        self._kept = wp.zeros(length, dtype=wp.vec4, device=self.device)
        self._held = wp.zeros(length, dtype=wp.uint8, device=self.device)
        # Of tension only the present is known, which a resumed run would not find again.
        self._then = Seen(operator, displacements=self._kept, tension=None)

    @property
    def state(self) -> dict[str, wp.array]:
        return {"at": self._kept, "counts": self._counts, "due": self._due}

    def prepare(self) -> None:
        """Follow the mesh; not while launches are recorded. Launches must be recorded again after this."""
        self.preconditioner.follow()
        if self._is_prepared:
            self._due.fill_(int(kernels.PRESENT))
        elif not self._due.numpy()[0]:
            self._due.fill_(int(kernels.AGAIN))
        self._is_prepared = True

    def update(self, operator: TangentOperator) -> None:
        """Launch a set-up if one is due."""
        wp.launch(
            kernels.find_held_changes,
            len(self._held),
            [operator.inverse_mass, self._held, self._due],
            device=self.device,
        )
        self._ranks.max(self._due)
        wp.capture_if(self._due, self._set_up)

    def follow_springs(self, springs: Springs) -> None:
        """Make room for springs; not while launches are recorded, and after ``prepare``."""
        self.preconditioner.follow_springs(springs)

    def take_springs(self) -> None:
        """Launch the exchange of the springs in the preconditioner for the present ones."""
        self.preconditioner.take_springs()

    def apply(self, r: wp.array, z: wp.array) -> None:
        self.preconditioner.apply(r, z)

    def judge(self, iterations: wp.array, status: wp.array) -> None:
        """Launch the decision, after a solve, whether the next one is worth a set-up.

        Args:
            iterations, status: Results of the solve, int32 [worlds].
        """
        wp.launch(kernels.judge_solve, 1, [iterations, status, self._counts, self._due], device=self.device)

    def _set_up(self) -> None:
        operator = self._operator
        inputs = [operator.displacements, operator.inverse_mass, self._due, self._counts]
        wp.launch(kernels.keep_state, len(self._held), inputs, [self._kept, self._held], device=self.device)
        wp.launch(kernels.note_setup, 1, [self._due, self._counts], device=self.device)
        self.preconditioner.update(self._then)  # type: ignore[arg-type]


#: Elements that share their dilatation, preconditioned by plain ones that are compressible, since these lock.
PLAIN: dict[str, Any] = {"most_lambda": 4.0}
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
        options = IN_GROUPS
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


#: The time of an iteration of multigrid over that of an assembled one: on the CPU, the same with a shared dilatation,
#: which has twice as many entries in a row, and on CUDA. On an H200 it was 29 to 38 for organs of 20,000 and 100,000
#: elements.
COST_ON_CPU, SHARED_ON_CPU, COST = 5, 3, 32
#: So many times as much on the CPU with contact, whose springs multigrid takes into all its matrices before each solve.
WITH_CONTACT = 2
#: Multigrid is tried if assembled solves cost as much as so many of its iterations; never where soft surfaces meet,
#: whose contact it does not know, nor on the CPU with contact, which assembled solves know better there.
WORTH, NEVER = 10, 1 << 20
#: The length of a step times the largest frequency of a node among fixed ones, above which multigrid solves first. A
#: bunny of 20,000 elements has 70 at 5 kPa and 171 at 30 kPa, and takes 190 and 410 iterations on CUDA. With contact
#: solves need fewer digits: one of 5,000 elements and 1 MPa that falls takes half the time. The long steps of static
#: answers are beyond both.
STIFF, STIFF_WITH_CONTACT = 300.0, 3000.0


class ChosenSolve:
    """Both ways of solving, and the choice between them after each step.

    Args:
        assembled: The assembled matrix.
        operators: The operators of the bodies.
        lagged: Multigrid of each body.
        shares: Whether elements share their dilatation.
        dt: The length of a step [s].

    Attributes:
        diagonal: As for ``AssembledSolve``.
        is_open: Whether the choice is open; otherwise multigrid solves.
        state: Arrays by name to be kept with the state of the first body, so that a resumed run is the same.
    """

    def __init__(
        self,
        assembled: AssembledSolve,
        operators: Sequence[TangentOperator],
        lagged: Sequence[Lagged],
        *,
        shares: bool,
        dt: float,
    ):
        self._dt, self._is_prepared = dt, False
        self.assembled, self._operators, self._lagged = assembled, list(operators), list(lagged)
        self.device = assembled.device
        self._is_assembled = wp.ones(1, dtype=wp.int32, device=self.device)
        self._counts = wp.zeros(kernels.CHOICE_COUNTS, dtype=wp.int32, device=self.device)
        self.is_open = True
        on_cpu = (SHARED_ON_CPU if shares else COST_ON_CPU) * (WITH_CONTACT if assembled.touches else 1)
        # Threads share assembled solves, but not cycles of multigrid.
        self._cost = on_cpu * assembled.threads if self.device.is_cpu else COST

    @property
    def diagonal(self) -> wp.array:
        return self.assembled.diagonal

    @property
    def state(self) -> dict[str, wp.array]:
        return {"assembled": self._is_assembled, "choice": self._counts}

    def prepare(self) -> None:
        """Follow the meshes; not while launches are recorded. Launches must be recorded again after this."""
        self.assembled.follow()
        # A resumed run goes on with its choice.
        is_new = not self._is_prepared and not self._counts.numpy().any()
        most = STIFF_WITH_CONTACT if self.assembled.touches else STIFF
        if is_new and self._dt * self.assembled.largest_frequency() > most:
            self._is_assembled.zero_()
            self._counts[int(kernels.ASSEMBLED) : int(kernels.ASSEMBLED) + 1].fill_(int(kernels.DEAR))
        self._is_prepared = True

    def update(self) -> None:
        """Launch the update after new linearisations."""
        self._either(self.assembled.update, self._update_multigrid)

    def take_contact(self, system: BlockSystem) -> None:
        """Launch the exchange of the contacts of the system in the matrix for the present ones."""
        assert system.contact is not None
        contact = system.contact
        self._either(lambda: self.assembled.take_contact(contact), system.take_springs)

    def iterate(self, system: BlockSystem, x: wp.array) -> None:
        """Launch the iterations of a solve of the system that has begun."""
        self._either(lambda: self.assembled.iterate(system.solver, x), lambda: system.iterate(x))

    def judge(self, system: BlockSystem, iterations: wp.array, status: wp.array) -> None:
        """Launch the choice for the next step, after a step with these results, int32 [worlds]."""

        def judge_set_ups() -> None:
            system.judge_set_ups(iterations, status)

        self._either(None, judge_set_ups)
        if not self.is_open:
            return
        knows_more = system.couples or (self.assembled.touches and self.device.is_cpu)
        worth = NEVER if knows_more else WORTH
        inputs = [iterations, status, int(self.assembled.touches), worth, self._cost, self.assembled.couplings]
        wp.launch(kernels.choose, 1, inputs, [self._counts, self._is_assembled], device=self.device)

    def _update_multigrid(self) -> None:
        blocks = self.assembled.blocks.of(self.diagonal)
        for lagged, operator, own in zip(self._lagged, self._operators, blocks, strict=True):
            lagged.update(operator)
            if self.assembled.touches:
                wp.copy(own, operator.diagonal_blocks())

    def _either(self, assembled: Callable[[], None] | None, other: Callable[[], None]) -> None:
        if self.is_open:
            wp.capture_if(self._is_assembled, assembled, other)
        else:
            other()
