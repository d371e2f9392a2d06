"""The force for the hand between two states of the simulation, and the energy through the device.

The loop runs faster than the simulation, and the simulation's tool follows the hand with a delay. If the hand has moved
since, the force of the last state is extrapolated along the direction in which the tissue pushes, with the stiffness in
the last states: the contact's compliance as the tool sees it.

After Courtecuisse, Jung, Allard, Duriez, Lee and Cotin, GPU-based real-time soft tissue deformation with cutting and
haptic feedback (2010), where the compliance comes from the solver's matrix; explicit steps have none, so that it is
measured.

A force that is held from one reading to the next does work on the hand that is known exactly at the next reading: the
observer adds it up. The controller then gives the next force. It damps a force that would put out energy if the hand
continued its motion, and scales down a force that could put out more than there is in any motion of the hand.

After Hannaford and Ryu, Time-domain passivity control of haptic interfaces (2002), for observer and damping; the bound
for any motion is that of Kim and Ryu, Robustly stable haptic interaction control using an energy-bounding algorithm
(2010), with a budget.
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


class PassivityControl:
    """Bounds the energy that leaves through the device.

    At any time ``t`` [s] since the beginning, the energy put out is at most the energy put in plus
    ``bound * (1 + t)``, as long as the hand moves no farther than ``reach`` and turns no farther than ``turn`` from one
    reading to the next. Energy that has been put in counts until the force is zero.

    Args:
        bound: [J].
        reach: [m].
        turn: [rad].

    Attributes:
        balance: Energy put in minus energy put out, as the controller counts it [J]; never below ``-bound``.
        put_out: Energy put out minus energy put in since the beginning [J].
        most_put_out: The largest value of ``put_out`` [J].
        beyond: Readings between which the hand moved farther than ``reach`` or ``turn``.
        damped: Readings at which a force was changed.
    """

    def __init__(self, bound: float, reach: float, turn: float):
        self.bound, self._reach, self._turn = bound, reach, turn
        self.balance = self.put_out = self.most_put_out = 0.0
        self.beyond = self.damped = 0
        self._force, self._torque = np.zeros(3), np.zeros(3)

    def observe(self, moved: Floats, turned: Floats, seconds: float) -> None:
        """Count the work of the last force along the hand's motion [m] and rotation [rad] in some time."""
        work = float(self._force @ moved + self._torque @ turned)
        self.put_out += work
        self.most_put_out = max(self.most_put_out, self.put_out)
        if self.balance < 0.0:
            self.balance = min(self.balance + self.bound * seconds, 0.0)
        self.balance -= work
        self.beyond += int(moved @ moved > self._reach**2 or turned @ turned > self._turn**2)

    def control(self, force: Floats, torque: Floats, moved: Floats, turned: Floats) -> tuple[Floats, Floats]:
        """The force [N] and torque [N m] to be held until the next reading, from those of the model.

        Args:
            force, torque: The model's force and torque.
            moved, turned: The hand's motion since the last reading [m], [rad], which it is expected to repeat.
        """
        given = force, torque
        if not force.any() and not torque.any():
            self.balance = min(self.balance, 0.0)
        arm = (self._reach / self._turn) ** 2
        work, square = float(force @ moved + torque @ turned), float(moved @ moved + arm * (turned @ turned))
        free = max(self.balance, 0.0) + 0.25 * self.bound
        if work > free and square > 0.0:
            damping = (work - free) / square
            force, torque = force - damping * moved, torque - damping * arm * turned
        most = float(np.linalg.norm(force)) * self._reach + float(np.linalg.norm(torque)) * self._turn
        left = max(self.balance + self.bound, 0.0)
        if most > left:
            force, torque = force * (left / most), torque * (left / most)
        self.damped += int(force is not given[0])
        self._force, self._torque = force, torque
        return force, torque
