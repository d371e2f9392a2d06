"""A warning if another solver also moves the bodies that this solver moves."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt

from warp_corot.errors import depth_of_user

from .library import newton

#: The number of first steps that are checked; and the number of steps in a row before which bodies must have moved for
#: the warning. (A reset moves them once, and in a new state they are where the model has them.)
LOOKS, IN_A_ROW = 8, 3


class Elsewhere:
    """Compares the bodies at the start of each of the first steps with those at the end of the step before.

    It does so on the CPU only: steps on CUDA do not wait for the device.

    Args:
        model: The model.
        has_bodies: Whether the solver moves bodies.
    """

    def __init__(self, model: newton.Model, has_bodies: bool):
        self._model = model
        self._left = LOOKS if has_bodies and model.device.is_cpu else 0
        self._in_a_row = 0
        self._poses: npt.NDArray[np.float32] | None = None

    def look(self, state: newton.State) -> None:
        """Check the bodies before a step, and warn if something else has moved them."""
        if not self._left or self._model.device.is_capturing:
            return
        if self._poses is not None:
            now = state.body_q.numpy()
            moved = np.any(now != self._poses, axis=1) & np.any(now != self._model.body_q.numpy(), axis=1)
            moved &= self._are_free()
            self._in_a_row = self._in_a_row + 1 if moved.any() else 0
        if self._in_a_row < IN_A_ROW:
            return
        self._left = 0
        warnings.warn(
            f"bodies have moved between the last {IN_A_ROW} steps, for example body {int(np.argmax(moved))}: "
            "something else moves them, and so does rigid_solver in these steps; "
            "rigid_solver=None leaves them to the other solver",
            UserWarning,
            stacklevel=depth_of_user(),
        )

    def keep(self, state: newton.State) -> None:
        """Keep the bodies after a step."""
        if self._left and not self._model.device.is_capturing:
            self._poses = state.body_q.numpy().copy()
            self._left -= 1

    def _are_free(self) -> npt.NDArray[np.bool_]:
        """Bodies that only this solver should move: not kinematic ones, nor those of a coupled solver."""
        model, flags = self._model, newton.BodyFlags
        bits = model.body_flags.numpy()
        return ((bits & int(flags.KINEMATIC | flags.PROXY)) == 0) & (model.body_inv_mass.numpy() > 0.0)
