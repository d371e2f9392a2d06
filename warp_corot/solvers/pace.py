"""The clock of a simulation, seen from the host."""

from __future__ import annotations

import warp as wp

from ..kernels import pace as kernels


class Pace:
    """Steps done, their length and the time now, kept on the device.

    Args:
        dt: Length of a step [s].
        device: Where.

    Attributes:
        arrays: What kernels take.
    """

    def __init__(self, dt: float, device: wp.Device):
        self.device = device
        self.arrays = kernels.Pace()
        self.arrays.counts = wp.zeros(2, dtype=wp.int64, device=device)
        self.arrays.seconds = wp.array([dt, 0.0], dtype=wp.float64, device=device)

    @property
    def steps(self) -> int:
        """Steps done; waits for the device."""
        return int(self.arrays.counts.numpy()[0])

    @property
    def dt(self) -> float:
        """The length of the next step [s]; waits for the device."""
        return float(self.arrays.seconds.numpy()[0])

    @property
    def time(self) -> float:
        """The time now [s]; waits for the device."""
        return self.time_at(self.steps)

    def time_at(self, steps: int) -> float:
        """The time after so many steps in all, if no step after the last change of their length is left out [s]."""
        dt, then = self.arrays.seconds.numpy()
        return float(then + (steps - int(self.arrays.counts.numpy()[1])) * dt)

    def set_step(self, dt: float) -> None:
        """Let the steps from here on be of another length [s]."""
        wp.launch(kernels.set_step, dim=1, inputs=[wp.float64(dt), self.arrays], device=self.device)

    def set_time(self, time: float) -> None:
        """Let the time now be exactly this [s]."""
        wp.launch(kernels.set_time, dim=1, inputs=[wp.float64(time), self.arrays], device=self.device)

    def restart(self) -> None:
        """Begin again at time and step zero; the length of a step stays."""
        self.arrays.counts.zero_()
        self.set_time(0.0)

    def advance(self, steps: int) -> None:
        """Launch that so many steps have been made."""
        wp.launch(kernels.advance_clock, dim=1, inputs=[steps, self.arrays], device=self.device)

    @property
    def state(self) -> dict[str, wp.array]:
        """Arrays from which it goes on."""
        return {"counts": self.arrays.counts, "seconds": self.arrays.seconds}
