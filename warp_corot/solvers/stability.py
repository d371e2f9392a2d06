"""How long a stable step is, at rest and while the state changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity.model import SmallForces
from warp_corot.errors import InputError
from warp_corot.kernels.stepping import pace as clock
from warp_corot.kernels.stepping import stability as kernels
from warp_corot.mesh.scattered import normal_numbers, padded

from .graphs import repeat
from .halo import ALONE, Halo
from .pace import Pace

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField, Model

    from .system import System


LANCZOS_STEPS = 30
#: The best of the last steps is taken, of this many.
LAST_STEPS = 8

# Probing displacements as a share of the smallest element's size: small enough to be linear, large enough for float32.
PROBE = 1e-3


def largest_frequency(body: SoftBody, field: SmallForces, ranks: Halo = ALONE, number: int = 0) -> float:
    """Largest angular frequency [rad/s] of small motions about rest; explicit central differences need dt < 2 / it.

    Zero if no node is free to move.

    Args:
        body, field: The body and its forces.
        ranks, number: The processes that have the other parts of the body, and its number there.
    """
    largest = largest_eigenvalue(
        field,
        body.conditions.inverse_mass,
        body.discretization.smallest_volume,
        body.sizes.nodes,
        body.sizes.launch_nodes,
        ranks,
        number,
        ranks.owned(body).numbers,
    )
    return float(np.sqrt(largest))


def largest_eigenvalue(
    forces: SmallForces,
    inverse_mass: wp.array,
    smallest_volume: float,
    nodes: int,
    launch_nodes: int | None = None,
    ranks: Halo = ALONE,
    number: int = 0,
    numbers: npt.NDArray[np.int64] | None = None,
) -> float:
    """The largest eigenvalue of M^-1 K [1/s^2], where K gives the forces of small displacements from rest.

    Lanczos' iteration on M^-1/2 K M^-1/2. The forces themselves apply K, so that the actual model and elements are
    measured. The Ritz value's residual is added to the result. Zero if no node is free to move.

    Args:
        forces: The forces.
        inverse_mass: Inverse masses of the nodes [1/kg], float32, zero for held ones; nodal arrays are equally long.
        smallest_volume: The volume of the smallest element [m^3], which sets the size of small displacements.
        nodes: Number of nodes.
        launch_nodes: Number of nodes that launches go through; None: ``nodes``.
        ranks, number: As for ``largest_frequency``.
        numbers: The numbers of the nodes in the whole body, which set the first motion; None: they are those here.
    """
    free = int(ranks.sum(int((inverse_mass[:nodes].numpy() > 0).sum())))
    if not free:
        return 0.0
    probe = PROBE * smallest_volume ** (1.0 / 3.0)
    iteration = _Lanczos(forces, inverse_mass, probe, launch_nodes or nodes, ranks, number, numbers)
    with forces.state_kept():
        iteration.find_rest_forces()
        iteration.launch(min(LANCZOS_STEPS, 3 * free))
    return max(_largest_value(*iteration.coefficients()), 0.0)


def _largest_value(diagonal: npt.NDArray[np.float64], off: npt.NDArray[np.float64]) -> float:
    """The largest Ritz value plus its residual, the smallest of the last few steps: rounding produces copies of values
    that were already found, with meaningless residuals.

    Raises:
        InputError: The forces are not finite.
    """
    bounds = []
    if not (np.isfinite(diagonal).all() and np.isfinite(off).all()):
        raise InputError("forces of small motions are not finite; moduli must be within the range of float32")
    for size in range(max(len(diagonal) - LAST_STEPS, 0) + 1, len(diagonal) + 1):
        tridiagonal = np.diag(diagonal[:size]) + np.diag(off[1:size], 1) + np.diag(off[1:size], -1)
        values, vectors = np.linalg.eigh(tridiagonal)
        bounds.append(values[-1] + off[size] * abs(vectors[-1, -1]))
    return float(max(min(bounds), values[-1]))


class _Lanczos:
    """The iteration's vectors on the device, vec4, as long as launches: the present, the previous and the next one."""

    def __init__(
        self,
        forces: SmallForces,
        inverse_mass: wp.array,
        probe: float,
        count: int,
        ranks: Halo,
        number: int,
        numbers: npt.NDArray[np.int64] | None,
    ):
        self._ranks, self._number = ranks, number
        self.forces, self.inverse_mass, self.probe, self.count = forces, inverse_mass, probe, count
        self.device = inverse_mass.device
        self.q, self.before, self.next = (wp.empty(count, dtype=wp.vec4, device=self.device) for _ in range(3))
        places = len(inverse_mass)
        self.u, self.f, self._rest = (wp.zeros(places, dtype=wp.vec4, device=self.device) for _ in range(3))
        parts = count if ranks.is_reproducible else min(count, kernels.PARTS)
        self._parts, self._sums, self._largest, self._diagonal, self._off = (
            wp.empty(size, dtype=wp.float64, device=self.device)
            for size in (parts, kernels.FOLDED, kernels.FOLDED, LANCZOS_STEPS, LANCZOS_STEPS + 1)
        )
        self._scale = wp.empty(1, dtype=wp.float32, device=self.device)
        self._step = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._steps = 0
        self._launch(kernels.random_motion, [0, inverse_mass, self.q])
        if numbers is not None:
            motion = padded(normal_numbers(numbers, 0), count)
            motion[inverse_mass.numpy()[:count] == 0.0] = 0.0
            self.q.assign(motion)
        self._sum(self.q, self.q, self._off, root=True)
        self._launch(kernels.normalise, [self._off, self.q])

    def find_rest_forces(self) -> None:
        """Find the forces at rest, which active stress makes; they are subtracted from those of displacements."""
        self.forces.add_forces(self.u, self._rest)
        self._launch(kernels.scale_by, [-1.0, self._rest])

    def launch(self, steps: int) -> None:
        """Launch all steps of the iteration."""
        repeat(self._launch_step, steps, self.device, self._ranks)
        self._steps = steps

    def _launch_step(self) -> None:
        inverse_mass = self.inverse_mass
        self._launch(kernels.largest_motions, [inverse_mass, self.q, self._parts], len(self._parts))
        self._launch(kernels.fold, [self._parts, self._sums, self._largest], kernels.FOLDED)
        self._ranks.max(self._largest)
        self._launch(kernels.take_scale, [self.probe, self._largest, self._scale], 1)
        self._launch(kernels.probe_motion, [self._scale, inverse_mass, self.q, self.u])
        self._ranks.exchange(self._number, self.u)
        wp.copy(self.f, self._rest, count=self.count)
        self.forces.add_forces(self.u, self.f)
        arguments = [self._scale, self._off, self._step, inverse_mass, self.f, self.before, self.next]
        self._launch(kernels.apply_stiffness, arguments)
        self._sum(self.q, self.next, self._diagonal)
        self._launch(kernels.take_away, [self._diagonal, self._step, self.q, self.next])
        self._sum(self.next, self.next, self._off, after=1, root=True)
        self._launch(kernels.take_next, [self._off, self._step, self.next, self.q, self.before])
        self._launch(kernels.count_step, [self._step], 1)

    def coefficients(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Diagonal and off-diagonal entries of the meaningful steps [1/s^2], with one more off-diagonal at either end.

        Waits for the device.
        """
        diagonal, off = self._diagonal.numpy()[: self._steps], self._off.numpy()[: self._steps + 1]
        ended = off[1:] <= 1e-6 * np.maximum.accumulate(np.abs(diagonal))
        size = int(np.argmax(ended)) + 1 if ended.any() else self._steps
        return diagonal[:size], off[: size + 1]

    def _sum(self, a: wp.array, b: wp.array, numbers: wp.array, *, after: int = 0, root: bool = False) -> None:
        """Launch the step's entry of ``numbers``: a . b, or its square root with ``root``."""
        self._launch(kernels.inner_products, [a, b, self._parts], len(self._parts))
        self._launch(kernels.fold, [self._parts, self._sums, self._largest], kernels.FOLDED)
        if not (ranks := self._ranks).is_alone:
            total = ranks.sum(float(self._sums.numpy().sum()), self._parts.numpy() if ranks.is_reproducible else None)
            self._sums.assign(np.array([total] + [0.0] * (len(self._sums) - 1)))
        self._launch(kernels.take_sum, [self._sums, int(root), self._step, after, numbers], 1)

    def _launch(self, kernel: wp.Kernel, arguments: list, dim: int | None = None) -> None:
        count = self.count if dim is None else dim
        wp.launch(kernel, dim=count, inputs=arguments, device=self.device)


#: Adds the forces of displacements, vec4, to the second array.
AddForces = Callable[[wp.array, wp.array], None]

#: Iterations to find the largest curvature at rest. They find it to 1 %; a value that is too small makes later steps
#: shorter, not longer.
REST_TURNS = 32


class Curvature:
    """Finds the largest curvature of forces, by launches that may be recorded.

    Args:
        places: Length of nodal arrays.
        found: The result, float32 [2], zero before; see ``Gauge``.
        ranks, number: The processes that have the other parts of the body, and its number there.

    Attributes:
        directions: The directions in which nodes are moved, vec4, which go on from one measurement to the next.
        scale: The size of the probing motion, float32 [1].
    """

    def __init__(self, places: int, found: wp.array, ranks: Halo = ALONE, number: int = 0):
        self.found, self._ranks, self._number = found, ranks, number
        self.directions, self._probed, self._forces = (
            wp.zeros(places, dtype=wp.vec4, device=found.device) for _ in range(3)
        )
        self.scale = wp.zeros(1, dtype=wp.float32, device=found.device)

    def fit(self, inverse_mass: npt.NDArray[np.floating], smallest_volume: float) -> None:
        """Scale the probing motion to a mesh: the lightest free node moves a share of the smallest element."""
        lightest = self._ranks.max(float(inverse_mass.max(initial=0.0)))
        size = smallest_volume ** (1.0 / 3.0)
        self.scale.fill_(PROBE * size / np.sqrt(lightest) if lightest > 0 else 0.0)

    def find(self, add_forces: AddForces, inverse_mass: wp.array, u: wp.array, f: wp.array, count: int) -> None:
        """Measure at displacements u of ``count`` nodes, where the forces are f [N], both vec4."""
        outputs = [self.directions, self._probed, self._forces]
        wp.launch(kernels.probe_directions, count, [self.scale, inverse_mass, u], outputs, device=u.device)
        self._ranks.exchange(self._number, self._probed)
        add_forces(self._probed, self._forces)
        inputs = [inverse_mass, u, self._probed, f, self._forces]
        wp.launch(kernels.find_curvatures, count, inputs, [self.directions, self.found], device=u.device)

    def at_rest(self, add_forces: AddForces, inverse_mass: wp.array, count: int) -> float:
        """The largest curvature without displacements [1/s^2]; waits for the device."""
        u, f = (wp.zeros_like(self.directions) for _ in range(2))
        add_forces(u, f)

        def find_afresh() -> None:
            self.found.zero_()
            self.find(add_forces, inverse_mass, u, f, count)

        repeat(find_afresh, REST_TURNS, u.device, self._ranks)
        self._ranks.max(self.found)
        value = float(self.found.numpy()[0])
        self.found.zero_()
        return value


class Gauge(Curvature):
    """Finds the largest curvature and the largest strain of a body, by launches that may be recorded.

    Args:
        body: The body.
        field: Its force field.
        found: The result, float32 [2], zero before: ``CURVATURE`` and ``STRAIN`` of ``kernels.stepping.pace``.
        ranks, number: The processes that have the other parts of the body, and its number there.
    """

    def __init__(self, body: SoftBody, field: ForceField, found: wp.array, ranks: Halo = ALONE, number: int = 0):
        super().__init__(len(body.state.displacements), found, ranks, number)
        self.body, self.field = body, field
        if (numbers := ranks.owned(body).numbers) is not None:
            drawn = normal_numbers(numbers, 20130705)
            self.directions.assign(padded(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), len(self.directions)))
        self._rest_directions = self.directions
        self.rescale()
        # Loading within a recording would end it on some drivers.
        wp.load_module(kernels.find_strains(body.discretization.element_kind).module, body.device)

    def rescale(self) -> None:
        """Scale the probing motion to the present mesh."""
        inverse = self.body.conditions.inverse_mass[: self.body.node_count].numpy()
        self.fit(inverse, self.body.discretization.smallest_volume)

    def restart(self) -> None:
        """Continue from the directions that were found at rest."""
        wp.copy(self.directions, self._rest_directions)

    def launch(self, pace: Pace, ahead: int) -> None:
        """Measure in the present state, whose elastic forces are in ``body.state.forces``.

        Args:
            pace: The length of the steps to come.
            ahead: Number of steps before the next measurement.
        """
        body, state = self.body, self.body.state
        self.find(self.field.add_forces, *self._nodes(state.displacements, state.forces))
        # Each part of a body numbers its elements in its own way, so all of them are measured there.
        turns = int(kernels.TURNS) if self._ranks.is_alone else 1
        wp.launch(
            kernels.find_strains(body.discretization.element_kind),
            dim=-(-body.sizes.launch_elements // turns),
            inputs=[
                body.discretization.elements,
                state.displacements,
                self._ranks.exchange(self._number, state.velocities, copies=True),
                pace.arrays,
                ahead,
                turns,
                body.sizes.launch_elements,
            ],
            outputs=[self.found],
            device=body.device,
        )

    def curvature_at_rest(self) -> float:
        """The largest curvature about the rest shape [1/s^2]; waits for the device."""
        with self.field.state_kept():
            value = self.at_rest(self.field.add_forces, *self._nodes())
        self._rest_directions = wp.clone(self.directions)
        return value

    def _nodes(self, *vectors: wp.array) -> tuple:
        return self.body.conditions.inverse_mass, *vectors, self.body.sizes.launch_nodes


#: Steps between two measurements: usually; if one launch makes many steps, which a measurement interrupts; for bodies
#: that change fast; and as long as nothing is known of their motion. A measurement takes about as long as a step.
INTERVAL, BLOCK_INTERVAL = 32, 128
LIVELY_INTERVAL, LIVELY_BLOCK_INTERVAL = 8, 32
FIRST_INTERVAL = 8
_SCHEDULE = [int(place) for place in (clock.CALM, clock.CLOSENESS, clock.FOLLOWED, clock.CHECKED)]
#: The step if nothing can vibrate [s].
ANY_STEP = 1e-3


#: In place of a number of calm checks: some bodies change fast; there was no check yet.
LIVELY, UNKNOWN = -1, -2
#: After this many calm checks in a row, measurements are half as frequent.
CALM_CHECKS = 2


class Schedule(NamedTuple):
    """When energies are checked, and the result of the last check.

    Attributes:
        calm: How many checks in a row found the bodies calm, or LIVELY or UNKNOWN.
        intervals: Measurements between two checks; zero if not chosen yet.
        steps: Steps done at the last check.
        allowed: The step that the state allowed then [s].
    """

    calm: int
    intervals: int
    steps: int
    allowed: float


class SafeStep:
    """The step of a simulation whose user gave none.

    Args:
        system: The simulation's system, whose step it sets.
        models: The models of its bodies.
        stable: The largest stable step of each body at rest [s]; infinite if it cannot vibrate.
    """

    def __init__(
        self,
        system: System,
        models: Sequence[Model],
        stable: Sequence[float],
    ):
        self.device, self.pace = system.device, system.pace
        self._models = models
        count = len(system.bodies)
        self._found = wp.zeros((count, 2), dtype=wp.float32, device=self.device)
        self._at_rest = wp.zeros((count, 4), dtype=wp.float64, device=self.device)
        self._control, self._system = system.pace.control, system
        bound = zip(system.bodies, system.fields, strict=True)
        ranks = system.ranks
        self.gauges = [Gauge(body, field, self._found[k], ranks, k) for k, (body, field) in enumerate(bound)]
        self.find_rest(stable)

    @property
    def allowed(self) -> float:
        """The step, except where the end of a run shortens it [s]."""
        control = self.pace.known.control
        return float(control[clock.SHARE] * control[clock.ALLOWED])

    @property
    def at_rest(self) -> float:
        """The longest step: that of the bodies at rest [s]."""
        return float(self.pace.known.control[clock.AT_REST])

    @property
    def range(self) -> tuple[float, float]:
        """The shortest and the longest allowed step so far [s]."""
        control = self.pace.known.control
        return float(control[clock.SHORTEST]), float(control[clock.LONGEST])

    @property
    def is_shortened(self) -> bool:
        """Whether the step differs from the allowed one, as at the end of a run."""
        control = self.pace.known.control
        return self.pace.dt != max(self.allowed, float(clock.LEAST) * control[clock.AT_REST])

    def find_rest(self, stable: Sequence[float]) -> None:
        """Set the stable steps of the bodies at rest [s], with which measurements are compared."""
        rows = []
        for gauge, model, step in zip(self.gauges, self._models, stable, strict=True):
            gauge.rescale()
            curvature = gauge.curvature_at_rest()
            longest = step if math.isfinite(step) else ANY_STEP / model.step_safety
            rows.append([longest, curvature, model.step_safety, model.strained_safety])
        longest = min(row[0] * row[2] for row in rows)
        self._at_rest.assign(np.array(rows))
        control = self.pace.known.control.copy()
        before = control[clock.AT_REST]
        if before > 0.0:
            control[clock.ALLOWED] *= longest / before
        else:
            control[:] = longest
            control[clock.SHARE] = 1.0
            control[_SCHEDULE] = 0.0
        control[clock.AT_REST] = longest
        self.pace.write_control(control)
        self.resume()
        self.pace.take_given()

    def restart(self) -> None:
        """Begin again with the step at rest."""
        for gauge in self.gauges:
            gauge.restart()
        control = self.pace.known.control.copy()
        control[clock.ALLOWED], control[clock.SHARE] = control[clock.AT_REST], 1.0
        control[_SCHEDULE] = 0.0
        self.pace.write_control(control)
        self.resume()
        self.pace.take_given()

    def launch(self, ahead: int) -> None:
        """Measure, and set a step that is safe for ``ahead`` steps; may be recorded.

        The elastic forces of the present displacements are in ``node_forces`` of each body.
        """
        for gauge in self.gauges:
            gauge.launch(self.pace, ahead)
        for each in self._system.constraints:
            each.measure()
        self._system.ranks.max(self._found)
        if self._system.constraints:
            self._system.ranks.max(self._system.motion_rates)
        inputs = [self._at_rest, self._found, self._system.motion_rates, self._control, self.pace.arrays]
        wp.launch(clock.take_safe_step, dim=1, inputs=inputs, device=self.device)

    def resume(self) -> None:
        """Take the allowed step again, after shorter ones at the end of a run."""
        self.launch_resumption()
        self.pace.forget()

    def launch_resumption(self) -> None:
        """``resume``, to be recorded."""
        wp.launch(clock.resume_step, dim=1, inputs=[self._control, self.pace.arrays], device=self.device)

    def launch_fit(self) -> None:
        """Launch the fit of the remaining steps to the end that ``pace.order`` has set; may be recorded."""
        inputs = [self.pace.orders, self._control, self.pace.arrays]
        wp.launch(clock.fit_step, dim=1, inputs=inputs, device=self.device)

    @property
    def share(self) -> float:
        """The share of the allowed step that is taken after going back."""
        return float(self.pace.known.control[clock.SHARE])

    @share.setter
    def share(self, value: float) -> None:
        control = self.pace.known.control.copy()
        control[clock.SHARE] = value
        control[clock.SHORTEST] = min(control[clock.SHORTEST], value * control[clock.ALLOWED])
        self.pace.write_control(control)

    @property
    def shares(self) -> tuple[float, float, float]:
        """``share``, the allowed step and the step at rest [s]."""
        control = self.pace.known.control
        return (
            float(control[clock.SHARE]),
            float(control[clock.ALLOWED]),
            float(control[clock.AT_REST]),
        )

    @property
    def schedule(self) -> Schedule:
        """When energies are checked."""
        calm, intervals, steps, allowed = self.pace.known.control[_SCHEDULE]
        return Schedule(int(calm), int(intervals), int(steps), float(allowed))

    @schedule.setter
    def schedule(self, value: Schedule) -> None:
        inputs = [*map(wp.float64, value), self._control]
        wp.launch(clock.set_schedule, dim=1, inputs=inputs, device=self.device)
        self.pace.note_control(_SCHEDULE, value)

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays from which the control of the step continues."""
        gauges = {
            f"{name}{k}": array
            for k, gauge in enumerate(self.gauges)
            for name, array in (("directions", gauge.directions), ("scale", gauge.scale))
        }
        return {"control": self._control, "at_rest": self._at_rest, **gauges}
