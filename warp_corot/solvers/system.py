"""The system that steps together: bodies, their forces and the work of these; and the interface of integrators."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.kernels.stepping.balance import count_constraints, count_work, separate_forces
from warp_corot.kernels.stepping.integrate import Dynamics

from .halo import ALONE, Halo
from .pace import Pace

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody


class ForcesWork:
    """Counts the work of a system's forces and constraints.

    Args:
        bodies, pace, gravity: The system's.

    Attributes:
        accounts: The work of forces on the nodes of each body, and the sum of its absolute values [J]: float64 [2, n],
            world after world.
        of_constraints: The work of constraints on bodies that were touched, by the number of the body. It stays when a
            constraint is removed.
        others: All forces besides elasticity in the last step [N], vec4, for each body.
    """

    def __init__(self, bodies: Sequence[SoftBody], pace: Pace, gravity: wp.vec3):
        self._bodies, self._pace, self._gravity = bodies, pace, gravity
        self.accounts: list[wp.array] = []
        self.others: list[wp.array] = []
        self.of_constraints: dict[int, wp.array] = {}
        self._elastic: list[wp.array] = []

    def prepare(self, counted: bool) -> None:
        """Make room for the present arrays of nodes; not while launches are recorded.

        Args:
            counted: Whether there are forces whose work is counted.
        """
        lengths = [len(body.state.displacements) for body in self._bodies]
        for k, (body, length) in enumerate(zip(self._bodies, lengths, strict=True)):
            if body.state.is_touched and (k not in self.of_constraints or self.of_constraints[k].shape[1] != length):
                self.of_constraints[k] = wp.zeros((2, length), dtype=wp.float64, device=body.device)
        if not counted:
            return
        if lengths == [len(array) for array in self.others]:
            return
        device = self._bodies[0].device
        self.others, self._elastic = ([wp.zeros(n, dtype=wp.vec4, device=device) for n in lengths] for _ in range(2))
        self.accounts = [wp.zeros((2, n), dtype=wp.float64, device=device) for n in lengths]

    def launch_begin(self) -> None:
        """Launch the copy of the forces so far, which are elastic."""
        for body, elastic in zip(self._bodies, self._elastic, strict=True):
            wp.copy(elastic, body.state.forces)

    def launch_separation(self) -> None:
        """Launch the difference since then: the other forces."""
        for body, elastic, others in zip(self._bodies, self._elastic, self.others, strict=True):
            inputs = [elastic, body.state.forces]
            wp.launch(separate_forces, body.sizes.launch_nodes, inputs, [others], device=body.device)

    def launch_count(self, offset: int, damping: float) -> None:
        """Launch the sum of their work, after the forces of constraints, which change the motion."""
        for k, body in enumerate(self._bodies):
            inputs = [dynamics_of(body, self._gravity, damping), self._pace.arrays, offset, self._elastic[k]]
            outputs = [self.others[k], self.accounts[k]]
            wp.launch(count_work, body.sizes.launch_nodes, inputs, outputs, device=body.device)

    def launch_constraints(self, offset: int, damping: float) -> None:
        """Launch the sum of the constraints' work, after all of them have added their forces."""
        for k, account in self.of_constraints.items():
            body = self._bodies[k]
            inputs = [dynamics_of(body, self._gravity, damping), self._pace.arrays, offset, body.state.contact_forces]
            wp.launch(count_constraints, body.sizes.launch_nodes, inputs, [account], device=body.device)


def dynamics_of(body: SoftBody, gravity: wp.vec3, damping: float) -> Dynamics:
    """What moves the nodes of a body in a step with this damping [1/s], as a struct for kernels."""
    conditions, state, found = body.conditions, body.state, Dynamics()
    found.damping, found.gravity, found.inverse_mass = damping, gravity, conditions.inverse_mass
    found.rest, found.f, found.u, found.v = state.rest, state.forces, state.displacements, state.velocities
    if conditions.has_loads:
        loads = conditions.loads
        found.load_stride = loads.strides[0] // 4
        # Another program's array may have any stride, also zero.
        size = 3 + abs(found.load_stride) * (len(loads) - 1)
        found.load = wp.array(ptr=loads.ptr, dtype=wp.float32, shape=size, device=body.device, copy=False)
    return found


#: No step: a number after all steps.
NEVER = np.iinfo(np.int64).max


class Forces(Protocol):
    """Forces besides elasticity on the nodes of one or several bodies, such as damping or springs.

    Their work counts in the balance of energy. Two kinds of forces do their own accounting. Forces that only take
    energy out say ``is_dissipative = True``. Others add their work to ``support_work`` of the system and have a method
    ``complete_work``, which launches the work up to the present state.

    Forces that remember something between steps list its arrays in ``restored``.

    Forces whose launches may change have an attribute ``revision`` that changes with them. ``curvature`` may say how
    stiff a force is; see ``Simulation.add_forces``.
    """

    def add_forces(self) -> None:
        """Launch the kernels that add the forces in the present state to the bodies' ``state.forces`` [N]."""
        ...


class Constraint(Protocol):
    """Forces that react to the motion that all other forces would cause in a step, such as contact.

    Its forces are part of ``state.forces`` and, alone, of ``state.contact_forces``, from which their work is counted. A
    constraint that counts it itself says ``counts_work = True``. Subclasses need only the methods that do something.

    Attributes:
        launch_revision: Changes whenever its launches do, so that steps must be recorded again.
        state: Arrays from which it continues, by name; they are kept and restored with the state of the bodies.
    """

    @property
    def launch_revision(self) -> int: ...

    @property
    def state(self) -> dict[str, wp.array]: ...

    def prepare(self) -> None:
        """Follow changes of the bodies' meshes; called before steps are launched, never while they are recorded."""
        return

    def launch(self, offset: int, damping: float) -> None:
        """Launch the kernels that add its forces to ``state.forces`` and ``state.contact_forces`` of the bodies, after
        all other forces, and after prescribed nodes have the velocities of the step.

        Args:
            offset: Number of launched steps that the clock does not count yet.
            damping: Rate of mass-proportional damping of the step [1/s].
        """
        return

    @property
    def is_full(self) -> bool:
        """Whether the last run needed more room than there is, so that forces are missing."""
        ...

    def grow(self) -> None:
        """Make the room that the last run needed.

        Raises:
            UnstableError: No room is enough: something goes too far in one step.
        """
        return

    def forget(self) -> None:
        """Forget what the last steps left, because they are taken back."""
        return

    def measure(self) -> None:
        """Launch the measurement of how fast things move for their size; see ``System.motion_rates``."""
        return

    def publish(self) -> None:
        """Launch the update of what users read after a run of steps."""
        return

    def reset(self, chosen: wp.array) -> None:
        """Forget what belongs to worlds that are reset, nonzero in int32 [worlds]."""
        return


class System:
    """All bodies of a simulation, on one device.

    Args:
        bodies: The bodies.
        fields: The elastic force field of each.
        pace: The clock and the length of a step; steps recorded in one run add their offset.
        gravity: [m/s^2].
        ranks: The processes that make the same steps with other parts of the bodies.

    Attributes:
        forces: Forces besides elasticity.
        constraints: Forces that react to the motion from all these forces, in this order.
        changes: A counter; increment it after adding to these lists or removing from them after the first step.
        motion_rates: How many times per second things would pass the thinnest thing that they may touch: as known
            before the run and as measured [1/s], float32 [2]. A step lasts a small share of that time.
        device, worlds: The device, and the number of worlds of all bodies.
        support_work: Work of moving supports, and of forces that do their own accounting, and the sum of its absolute
            values [J], float64 [2].
        offset: The number of the step being launched, since the clock was last advanced.
        lag: How far velocities are behind displacements, in half steps: 1 for symplectic Euler.
        is_implicit: Whether steps are implicit.
        bad_step: The first step after which something was not finite, int64 [1] on the device.
    """

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        fields: Sequence[ForceField],
        pace: Pace,
        gravity: Sequence[float],
        ranks: Halo = ALONE,
    ):
        self.ranks = ranks
        self.bodies, self.fields, self.pace, self.gravity = tuple(bodies), tuple(fields), pace, wp.vec3(*gravity)
        self.forces: list[Forces] = []
        self.constraints: list[Constraint] = []
        self.changes = self.offset = 0
        self.lag, self.is_implicit = 1.0, False
        self._work = ForcesWork(self.bodies, pace, self.gravity)
        self.device, self.worlds = bodies[0].device, bodies[0].worlds
        self.motion_rates = wp.zeros(2, dtype=wp.float32, device=self.device)
        self.support_work = pace.support_work
        shapes = {} if ranks.is_alone else {body: (2, len(body.state.forces)) for body in bodies}
        self._work_of_supports = {
            body: wp.zeros(shape, dtype=wp.float64, device=self.device) for body, shape in shapes.items()
        }
        self.bad_step = wp.array([NEVER], dtype=wp.int64, device=self.device)

    @property
    def launch_revision(self) -> int:
        """Changes whenever the launches of a step change, so that steps must be recorded again."""
        others = sum(each.launch_revision for each in self.constraints) + self.changes + len(self.forces)
        others += sum(getattr(each, "revision", 0) for each in self.forces)
        if self.is_implicit:
            # Solvers follow the mesh, also where launches have the same sizes.
            others += sum(body.version for body in self.bodies)
        return sum(body.launch_revision for body in self.bodies) + others

    @property
    def accounts(self) -> list[wp.array]:
        """The work of forces and of constraints on each body, and of its supports where each node has its own; see
        ``ForcesWork``."""
        return [
            *self._work_of_supports.values(),
            *(self._work.accounts if self.counted else []),
            *self._work.of_constraints.values(),
        ]

    def constraint_accounts(self, k: int) -> list[wp.array]:
        """The work of constraints on a body, if it may be touched; see ``ForcesWork``."""
        return [self._work.of_constraints[k]] if k in self._work.of_constraints else []

    @property
    def state(self) -> list[wp.array]:
        """All arrays from which constraints continue, with the accounts."""
        others = [array for each in self.constraints for array in each.state.values()]
        others += [array for each in self.forces for array in getattr(each, "restored", ())]
        return self.accounts + others + [body.state.contact_forces for body in self.bodies if body.state.is_touched]

    def prepare(self) -> None:
        """Update what constraints know of the bodies; not while launches are recorded."""
        for each in self.constraints:
            each.prepare()
        self._work.prepare(bool(self.counted))

    @property
    def counted(self) -> list[Forces]:
        """The forces that do not do their own accounting."""
        return [each for each in self.forces if not _counts_itself(each)]

    def add_other_forces(self, offset: int, damping: float, moving: Sequence[int]) -> None:
        """Launch forces besides elasticity, and then constraints; see ``Constraint.launch``.

        Args:
            offset, damping: As for ``Constraint.launch``.
            moving: The bodies whose prescribed nodes get the velocities of the step here.
        """
        self.offset = offset
        for forces in self.forces:
            if _counts_itself(forces):
                forces.add_forces()
        # The work of supports includes the forces so far, but not those that are counted below.
        for k in moving:
            body = self.bodies[k]
            body.conditions.follow_trajectories(self.pace, offset, self.support_work_of(body))
        counted = self.counted
        if counted:
            self._work.launch_begin()
            for forces in counted:
                forces.add_forces()
            self._work.launch_separation()
        for each in self.constraints:
            each.launch(offset, damping)
        if counted:
            self._work.launch_count(offset, damping)
        if not any(getattr(each, "counts_work", False) for each in self.constraints):
            self._work.launch_constraints(offset, damping)

    def dynamics(self, body: SoftBody, damping: float) -> Dynamics:
        """What moves the nodes of a body in an explicit step with this damping [1/s], as a struct for kernels."""
        return dynamics_of(body, self.gravity, damping)

    def support_work_of(self, body: SoftBody) -> wp.array:
        """Where steps add up the work of a body's supports: ``support_work``, or two places for each node, which add up
        in an order that does not depend on the number of ranks."""
        own = self._work_of_supports.get(body)
        return self.support_work if own is None else own.flatten()

    def pushing(self, k: int) -> wp.array | None:
        """Forces on a body besides elasticity in the last step [N], vec4, for the balance of energy.

        None if there were none.
        """
        if self.counted:
            return self._work.others[k]
        state = self.bodies[k].state
        return state.contact_forces if state.is_touched else None

    def restart_work(self, work: npt.NDArray[np.float64] | None = None) -> None:
        """Count the work of supports and constraints from here on; that of supports on from what was counted before."""
        self.pace.restart_work(work)
        for account in self.accounts:
            account.zero_()

    @property
    def rewritten(self) -> int:
        """Changes whenever keyframes change that existing launches read."""
        return sum(body.conditions.rewritten for body in self.bodies)

    def add_elastic_forces(self, k: int, offset: int = 0) -> None:
        """Launch the elastic forces of the k-th body, of the ``offset``-th step since the clock was last advanced."""
        body, state, field = self.bodies[k], self.bodies[k].state, self.fields[k]
        body.conditions.follow_activations(self.pace, offset)
        field.add_forces(state.displacements, state.forces)

    def complete_work(self) -> None:
        """Launch the update of ``support_work`` to the present state."""
        for each in self.forces:
            complete = getattr(each, "complete_work", None)
            if complete is not None:
                complete()

    def adopt_positions(self) -> None:
        """Adopt positions that a user wrote since they were published."""
        for body in self.bodies:
            body.state.adopt_positions()

    def publish_positions(self) -> None:
        """Write positions from displacements, and what users read about constraints."""
        for body in self.bodies:
            body.state.publish_positions()
        for each in self.constraints:
            each.publish()


def _counts_itself(forces: Forces) -> bool:
    """Whether forces see to the balance of energy themselves."""
    return getattr(forces, "is_dissipative", False) or hasattr(forces, "complete_work")


#: Steps recorded in one graph where a launch is not many steps.
GRAPH_STEPS = 64


class Stepper(ABC):
    """Time steps of all bodies of a system as launches that can be recorded."""

    #: Whether steps launch the forces of the system's constraints.
    resolves_constraints = False
    #: The most steps of one recording.
    graph_steps = GRAPH_STEPS

    @property
    def kept(self) -> dict[str, wp.array]:
        """Arrays that a step leaves for the next one besides the state of bodies and fields, by name."""
        return {}

    @property
    def many_a_launch(self) -> bool:
        """Whether many steps are one launch, for every body."""
        return False

    def prepare(self) -> None:  # noqa: B027 (most need nothing)
        """Copy what launches read of the bodies' conditions to the device; called before steps are recorded."""

    def continue_from(self, other: Stepper) -> None:  # noqa: B027 (most need nothing)
        """Take over what another stepper of the same integrator has counted, in whose place this one is."""

    def fall_back(self) -> bool:
        """Make steps sturdier until ``recover`` is called; whether they can be."""
        return False

    def recover(self) -> None:  # noqa: B027 (most need nothing)
        """Make steps as usual again."""

    @abstractmethod
    def forces(self, offset: int = 0) -> None:
        """Launch the elastic forces of the ``offset``-th step since the clock was last advanced."""

    @abstractmethod
    def steps(self, count: int, *, forces_known: bool = False) -> None:
        """Launch steps, the first ones since the clock was last advanced.

        Args:
            count: Number of steps.
            forces_known: Whether ``forces`` has been launched for the first of them.
        """


class Integrator(ABC):
    """The description of a time integrator: a frozen dataclass of plain values with a step ``dt`` [s] or None."""

    dt: float | None
    #: Whether steps of any length are stable.
    is_implicit: ClassVar[bool] = False

    def stable_step(self, frequency: float) -> float:
        """The largest stable step [s] of a body whose largest angular frequency at rest is this [rad/s]; infinite for
        zero."""
        return 2.0 / frequency if frequency > 0.0 else math.inf

    @abstractmethod
    def bind(self, system: System) -> Stepper:
        """The stepper of a system."""
