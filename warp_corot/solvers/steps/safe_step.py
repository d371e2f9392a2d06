"""A step that stays stable: it follows the gauges' measurements of the bodies, on the device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import warp as wp

from warp_corot.kernels.stepping import pace as kernels

from .gauge import Gauge

if TYPE_CHECKING:
    from warp_corot.elasticity import Model
    from warp_corot.solvers.system import System

#: Steps between two measurements: usually; if one launch makes many steps, which a measurement interrupts; for bodies
#: that change fast; and as long as nothing is known of their motion. A measurement takes about as long as a step.
INTERVAL, BLOCK_INTERVAL = 32, 128
LIVELY_INTERVAL, LIVELY_BLOCK_INTERVAL = 8, 32
FIRST_INTERVAL = 8
_SCHEDULE = [int(place) for place in (kernels.CALM, kernels.CLOSENESS, kernels.FOLLOWED, kernels.CHECKED)]
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
        return float(control[kernels.SHARE] * control[kernels.ALLOWED])

    @property
    def at_rest(self) -> float:
        """The longest step: that of the bodies at rest [s]."""
        return float(self.pace.known.control[kernels.AT_REST])

    @property
    def range(self) -> tuple[float, float]:
        """The shortest and the longest allowed step so far [s]."""
        control = self.pace.known.control
        return float(control[kernels.SHORTEST]), float(control[kernels.LONGEST])

    @property
    def is_shortened(self) -> bool:
        """Whether the step differs from the allowed one, as at the end of a run."""
        control = self.pace.known.control
        return self.pace.dt != max(self.allowed, float(kernels.LEAST) * control[kernels.AT_REST])

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
        before = control[kernels.AT_REST]
        if before > 0.0:
            control[kernels.ALLOWED] *= longest / before
        else:
            control[:] = longest
            control[kernels.SHARE] = 1.0
            control[_SCHEDULE] = 0.0
        control[kernels.AT_REST] = longest
        self.pace.write_control(control)
        self.resume()
        self.pace.take_given()

    def restart(self) -> None:
        """Begin again with the step at rest."""
        for gauge in self.gauges:
            gauge.restart()
        control = self.pace.known.control.copy()
        control[kernels.ALLOWED], control[kernels.SHARE] = control[kernels.AT_REST], 1.0
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
        wp.launch(kernels.take_safe_step, dim=1, inputs=inputs, device=self.device)

    def resume(self) -> None:
        """Take the allowed step again, after shorter ones at the end of a run."""
        self.launch_resumption()
        self.pace.forget()

    def launch_resumption(self) -> None:
        """``resume``, to be recorded."""
        wp.launch(kernels.resume_step, dim=1, inputs=[self._control, self.pace.arrays], device=self.device)

    def launch_fit(self) -> None:
        """Launch the fit of the remaining steps to the end that ``pace.order`` has set; may be recorded."""
        inputs = [self.pace.orders, self._control, self.pace.arrays]
        wp.launch(kernels.fit_step, dim=1, inputs=inputs, device=self.device)

    @property
    def share(self) -> float:
        """The share of the allowed step that is taken after going back."""
        return float(self.pace.known.control[kernels.SHARE])

    @share.setter
    def share(self, value: float) -> None:
        control = self.pace.known.control.copy()
        control[kernels.SHARE] = value
        control[kernels.SHORTEST] = min(control[kernels.SHORTEST], value * control[kernels.ALLOWED])
        self.pace.write_control(control)

    @property
    def shares(self) -> tuple[float, float, float]:
        """``share``, the allowed step and the step at rest [s]."""
        control = self.pace.known.control
        return float(control[kernels.SHARE]), float(control[kernels.ALLOWED]), float(control[kernels.AT_REST])

    @property
    def schedule(self) -> Schedule:
        """When energies are checked."""
        calm, intervals, steps, allowed = self.pace.known.control[_SCHEDULE]
        return Schedule(int(calm), int(intervals), int(steps), float(allowed))

    @schedule.setter
    def schedule(self, value: Schedule) -> None:
        inputs = [*map(wp.float64, value), self._control]
        wp.launch(kernels.set_schedule, dim=1, inputs=inputs, device=self.device)
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
