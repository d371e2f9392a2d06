"""A step that stays stable by itself: it follows what gauges find of the bodies, on the device."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels import pace as kernels
from ..kernels.gauge import SHIFT_VELOCITIES
from .gauge import Gauge
from .pace import Pace

if TYPE_CHECKING:
    from ..body import SoftBody
    from ..elasticity import ForceField, Model

#: Steps from one measurement to the next, and the same where many steps are one launch, which is cut short by it. A
#: measurement takes about as long as a step.
INTERVAL = 32
BLOCK_INTERVAL = 128
_SCHEDULE = [int(kernels.CALM), int(kernels.CLOSENESS), int(kernels.FOLLOWED)]
#: The step where nothing can vibrate [s].
ANY_STEP = 1e-3


class SafeStep:
    """The step of a simulation that was given none.

    Args:
        bodies, fields, models: The simulation's.
        pace: Whose step it sets.
        stable: The largest stable step of each body at rest [s], infinite where nothing can vibrate.
        gravity: [m/s^2].
    """

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        fields: Sequence[ForceField],
        models: Sequence[Model],
        pace: Pace,
        stable: Sequence[float],
        gravity: wp.vec3,
    ):
        self.device = pace.device
        self.pace = pace
        self._bodies, self._models, self._gravity = bodies, models, gravity
        self._found = wp.zeros((len(bodies), 2), dtype=wp.float32, device=self.device)
        self._at_rest = wp.zeros((len(bodies), 4), dtype=wp.float64, device=self.device)
        self._control = wp.zeros(int(kernels.CONTROLS), dtype=wp.float64, device=self.device)
        self.gauges = [
            Gauge(body, field, self._found[k]) for k, (body, field) in enumerate(zip(bodies, fields, strict=True))
        ]
        self.find_rest(stable)

    @property
    def allowed(self) -> float:
        """The step that is taken while no end of a run shortens it [s]; waits for the device."""
        control = self._control.numpy()
        return float(control[kernels.SHARE] * control[kernels.ALLOWED])

    @property
    def at_rest(self) -> float:
        """The longest step there is, that of the bodies at rest [s]; waits for the device."""
        return float(self._control.numpy()[kernels.AT_REST])

    @property
    def range(self) -> tuple[float, float]:
        """The shortest and the longest of the steps that were allowed so far [s]; waits for the device."""
        control = self._control.numpy()
        return float(control[kernels.SHORTEST]), float(control[kernels.LONGEST])

    def find_rest(self, stable: Sequence[float]) -> None:
        """Take the largest stable steps of the bodies at rest [s] for what measurements are compared with."""
        rows = []
        for gauge, model, step in zip(self.gauges, self._models, stable, strict=True):
            gauge.rescale()
            curvature = gauge.curvature_at_rest()
            longest = step if math.isfinite(step) else ANY_STEP / model.step_safety
            rows.append([longest, curvature, model.step_safety, model.strained_safety])
        longest = min(row[0] * row[2] for row in rows)
        self._at_rest.assign(np.array(rows))
        control = self._control.numpy().copy()
        before = control[kernels.AT_REST]
        if before > 0.0:
            control[kernels.ALLOWED] *= longest / before
        else:
            control[:] = longest
            control[kernels.SHARE], control[kernels.SHORTENED], control[kernels.GIVEN] = 1.0, 0.0, 0.0
            control[_SCHEDULE] = 0.0
        control[kernels.AT_REST] = longest
        self._control.assign(control)
        self.resume()
        self.take_given()

    def restart(self) -> None:
        """Begin again with the step at rest."""
        for gauge in self.gauges:
            gauge.restart()
        control = self._control.numpy().copy()
        control[kernels.ALLOWED], control[kernels.SHARE] = control[kernels.AT_REST], 1.0
        control[_SCHEDULE] = 0.0
        self._control.assign(control)
        self.resume()
        self.take_given()

    def launch(self, ahead: int) -> None:
        """Measure, and take a step that is safe for ``ahead`` steps; may be recorded.

        The elastic forces of the present displacements are in ``node_forces`` of each body.
        """
        for gauge in self.gauges:
            gauge.launch(self.pace, ahead)
        inputs = [self._at_rest, self._found, self._control, self.pace.arrays]
        wp.launch(kernels.take_safe_step, dim=1, inputs=inputs, device=self.device)
        self._shift_velocities()

    def resume(self) -> None:
        """Take the step that the state allows, after one that ended a run in time; velocities stay as they are."""
        wp.launch(kernels.resume_step, dim=1, inputs=[self._control, self.pace.arrays], device=self.device)

    def retime(self) -> None:
        """Take the step that the state allows and shift velocities to it; ``node_forces`` as for ``launch``."""
        self.resume()
        self._shift_velocities()

    def _shift_velocities(self) -> None:
        for body in self._bodies:
            inputs = [
                self._gravity,
                body.node_inverse_mass,
                int(body.has_loads),
                body.node_loads,
                body.node_forces,
                self._control,
            ]
            kernel = SHIFT_VELOCITIES[body.node_loads.dtype]
            wp.launch(kernel, body.launch_nodes, inputs, [body.node_velocities], device=self.device)

    @property
    def share(self) -> float:
        """The share of what the state allows that is taken after going back; waits for the device."""
        return float(self._control.numpy()[kernels.SHARE])

    @share.setter
    def share(self, value: float) -> None:
        control = self._control.numpy().copy()
        control[kernels.SHARE] = value
        control[kernels.SHORTEST] = min(control[kernels.SHORTEST], value * control[kernels.ALLOWED])
        self._control.assign(control)

    @property
    def shares(self) -> tuple[float, float, float]:
        """``share``, the step that the state allows and that at rest [s], read at once; waits for the device."""
        control = self._control.numpy()
        return float(control[kernels.SHARE]), float(control[kernels.ALLOWED]), float(control[kernels.AT_REST])

    @property
    def schedule(self) -> tuple[int, int, int]:
        """How many checks in a row found the bodies calm, measurements from one check on energies to the next (zero if
        none was chosen), and steps done at the last one; waits for the device."""
        calm, intervals, steps = self._control.numpy()[_SCHEDULE]
        return int(calm), int(intervals), int(steps)

    @schedule.setter
    def schedule(self, value: tuple[int, int, int]) -> None:
        control = self._control.numpy().copy()
        control[_SCHEDULE] = value
        self._control.assign(control)

    def take_given(self) -> None:
        """Let the next change of the step leave velocities as they are: a user gave them."""
        self._control[kernels.GIVEN : kernels.GIVEN + 1].fill_(1.0)

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays from which it goes on."""
        gauges = {
            f"{name}{k}": array
            for k, gauge in enumerate(self.gauges)
            for name, array in (("directions", gauge.directions), ("scale", gauge.scale))
        }
        return {"control": self._control, "at_rest": self._at_rest, **gauges}
