"""Energy through a haptic device, watched and bounded.

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

Floats = npt.NDArray[np.float64]


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
