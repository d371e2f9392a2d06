"""The force between two states of the simulation: a plane at the tool, and the tissue's stiffness across it.

The loop runs faster than the simulation, and the simulation's tool follows the hand with a delay. If the hand has moved
since, the force of the last state is extrapolated along the direction in which the tissue pushes, with the stiffness in
the last states: the contact's compliance as the tool sees it.

After Courtecuisse, Jung, Allard, Duriez, Lee and Cotin, GPU-based real-time soft tissue deformation with cutting and
haptic feedback (2010), where the compliance comes from the solver's matrix; explicit steps have none, so that it is
measured.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .exchange import ToolState

Floats = npt.NDArray[np.float64]

#: Weight of the older states in means over states.
MEMORY = 0.9
#: Depths that vary by less [m] say little about a stiffness.
SPREAD = 3e-5
#: Forces below this [N] count as zero.
NO_FORCE = 1e-9


class LocalModel:
    """The contact plane and the stiffness at a tool.

    Args:
        stiffness: The expected stiffness, before anything is measured [N/m].
        most: The largest stiffness that is used [N/m].

    Attributes:
        stiffness: The present estimate [N/m].
        normal: The direction in which the tissue pushes the tool, [3]; zero where nothing touches.
    """

    def __init__(self, stiffness: float, most: float):
        self._expected, self._most = min(stiffness, most), most
        self._force, self._torque = np.zeros(3), np.zeros(3)
        self._position = np.zeros(3)
        self.normal, self._origin = np.zeros(3), np.zeros(3)
        self.stiffness = self._expected
        #: Means over the last states, and their variance and covariance.
        self._depth = self._push = self._square = self._product = 0.0

    def follow(self, state: ToolState) -> None:
        """Take a new state of the simulation."""
        size = float(np.linalg.norm(state.force))
        self._position, self._force, self._torque = state.position, state.force, state.torque
        if size < NO_FORCE:
            self._leave()
            return
        normal = state.force / size
        touched = self.normal.any()
        if touched:
            normal = MEMORY * self.normal + (1.0 - MEMORY) * normal
            length = float(np.linalg.norm(normal))
            normal = normal / length if length > 0.1 else state.force / size
        else:
            self._origin = state.position.copy()
        self.normal = normal
        self._measure(float((self._origin - state.position) @ normal), float(state.force @ normal), first=not touched)

    def forces(self, position: Floats) -> tuple[Floats, Floats]:
        """Force [N] and torque [N m] on the tool in the hand at a position [m]; the tissue never pulls."""
        if not self.normal.any():
            return np.zeros(3), np.zeros(3)
        deeper = float((self._position - position) @ self.normal)
        push = float(self._force @ self.normal)
        continued = push + self.stiffness * deeper
        if continued <= 0.0 or push <= 0.0:
            return np.zeros(3), np.zeros(3)
        return self._force + self.stiffness * deeper * self.normal, self._torque * min(continued / push, 1.0)

    def _measure(self, depth: float, push: float, *, first: bool) -> None:
        """Measure the slope of force over depth in the last states, if the depths vary enough."""
        if first:
            self._depth, self._push = depth, push
            return
        new = 1.0 - MEMORY
        off_depth, off_push = depth - self._depth, push - self._push
        self._depth += new * off_depth
        self._push += new * off_push
        self._square = MEMORY * (self._square + new * off_depth * off_depth)
        self._product = MEMORY * (self._product + new * off_depth * off_push)
        found = (self._product + SPREAD**2 * self._expected) / (self._square + SPREAD**2)
        self.stiffness = float(np.clip(found, 0.0, self._most))

    def _leave(self) -> None:
        self.normal, self.stiffness = np.zeros(3), self._expected
        self._depth = self._push = self._square = self._product = 0.0
