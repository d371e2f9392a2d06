"""How long a stable step is, at rest and while the state changes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity.model import SmallForces
from warp_corot.errors import InputError
from warp_corot.kernels.stepping import pace as clock
from warp_corot.kernels.stepping import stability as kernels
from warp_corot.mesh.scattered import normal_numbers, padded

from .halo import ALONE, Halo
from .pace import Pace, Schedule, StepControl

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField, Model

    from .system import System


LANCZOS_STEPS = 30
#: The best of the last steps is taken, of this many.
LAST_STEPS = 8
#: The iteration ends where the next motion is this share of the last one: then all eigenvalues are found.
ENDED = 1e-6

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
    is_free = inverse_mass[:nodes].numpy() > 0
    free = int(ranks.sum(int(is_free.sum())))
    if not free:
        return 0.0
    probe, count, device = PROBE * smallest_volume ** (1.0 / 3.0), launch_nodes or nodes, inverse_mass.device
    motion = normal_numbers(np.arange(nodes) if numbers is None else numbers, 0)
    q, before, after = (wp.zeros(count, dtype=wp.vec4, device=device) for _ in range(3))
    q.assign(padded(np.where(is_free[:, None], motion, 0.0), count))
    u, f, at_rest = (wp.zeros(len(inverse_mass), dtype=wp.vec4, device=device) for _ in range(3))
    shape = (count if ranks.is_reproducible else min(count, kernels.PARTS), 2)
    parts = wp.empty(shape, dtype=wp.float64, device=device)

    def launch(kernel: wp.Kernel, *arguments: Any) -> None:
        wp.launch(kernel, count, arguments, device=device)

    def sums(a: wp.array, b: wp.array) -> tuple[float, float]:
        """a . b and the largest component of M^-1/2 b; waits for the device."""
        wp.launch(kernels.find_sums, len(parts), [inverse_mass, a, b], [parts], device=device)
        found = parts.numpy()
        total = ranks.sum(float(found[:, 0].sum()), found[:, 0] if ranks.is_reproducible else None)
        return total, ranks.max(float(found[:, 1].max()))

    square, largest = sums(q, q)
    launch(kernels.scale_by, 1.0 / math.sqrt(square), q)
    diagonal, off = [], [math.sqrt(square)]
    with forces.state_kept():
        # Active stress makes forces at rest, which are subtracted from those of displacements.
        forces.add_forces(u, at_rest)
        for step in range(min(LANCZOS_STEPS, 3 * free)):
            scale = probe * off[-1] / largest if largest > 0.0 else 1.0
            launch(kernels.weigh, scale, inverse_mass, q, u)
            ranks.exchange(number, u)
            f.zero_()
            launch(kernels.add_scaled, -1.0, at_rest, f)
            forces.add_forces(u, f)
            launch(kernels.weigh, -1.0 / scale, inverse_mass, f, after)
            if step > 0:
                launch(kernels.add_scaled, -off[-1], before, after)
            diagonal.append(sums(q, after)[0])
            launch(kernels.add_scaled, -diagonal[-1], q, after)
            square, largest = sums(after, after)
            if not math.isfinite(square):
                raise InputError("forces of small motions are not finite; moduli must be within the range of float32")
            off.append(math.sqrt(square))
            if off[-1] <= ENDED * max(map(abs, diagonal)):
                break
            launch(kernels.scale_by, 1.0 / off[-1], after)
            q, before, after = after, q, before
    return max(_largest_value(np.array(diagonal), np.array(off)), 0.0)


def _largest_value(diagonal: npt.NDArray[np.float64], off: npt.NDArray[np.float64]) -> float:
    """The largest Ritz value plus its residual, the smallest of the last few steps: rounding produces copies of values
    that were already found, with meaningless residuals."""
    bounds = []
    for size in range(max(len(diagonal) - LAST_STEPS, 0) + 1, len(diagonal) + 1):
        tridiagonal = np.diag(diagonal[:size]) + np.diag(off[1:size], 1) + np.diag(off[1:size], -1)
        values, vectors = np.linalg.eigh(tridiagonal)
        bounds.append(values[-1] + off[size] * abs(vectors[-1, -1]))
    return float(max(min(bounds), values[-1]))


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

        for _ in range(REST_TURNS):
            self.found.zero_()
            self.find(add_forces, inverse_mass, u, f, count)
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
#: The step if nothing can vibrate [s].
ANY_STEP = 1e-3


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
    def control(self) -> StepControl:
        """The numbers that set the step."""
        return self.pace.known.control

    @property
    def is_shortened(self) -> bool:
        """Whether the step differs from the allowed one, as at the end of a run."""
        return self.pace.dt != max(self.control.dt, float(clock.LEAST) * self.control.at_rest)

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
        control = self.control
        if control.at_rest > 0.0:
            control = control._replace(allowed=control.allowed * longest / control.at_rest, at_rest=longest)
        else:
            control = StepControl(longest, 1.0, longest, longest, longest)
        self._begin_from(control)

    def restart(self) -> None:
        """Begin again with the step at rest."""
        for gauge in self.gauges:
            gauge.restart()
        self.pace.schedule = Schedule()
        self._begin_from(self.control._replace(allowed=self.control.at_rest, share=1.0))

    def _begin_from(self, control: StepControl) -> None:
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

    def take_share(self, share: float) -> None:
        """Set the share of the allowed step that is taken from here on."""
        control = self.control
        shortest = min(control.shortest, share * control.allowed)
        self.pace.write_control(control._replace(share=share, shortest=shortest))
        self.resume()

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays from which the control of the step continues."""
        gauges = {
            f"{name}{k}": array
            for k, gauge in enumerate(self.gauges)
            for name, array in (("directions", gauge.directions), ("scale", gauge.scale))
        }
        return {"control": self._control, "at_rest": self._at_rest, **gauges}
