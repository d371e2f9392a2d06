"""Failures of worlds in a step, and the reports of them to users."""

from __future__ import annotations

import warnings

import numpy as np
import warp as wp

from warp_corot.errors import InputError, UnstableError
from warp_corot.kernels.newton import worlds
from warp_corot.solvers.guarding.mapped import Mapped

from .following import RETRIES, Following
from .library import newton


class Report:
    """Failures of the worlds of a model.

    Args:
        model: The model.

    Attributes:
        trouble: The failure of each world in the present step, and of what is in no world, int32 [worlds + 1]; see
            ``kernels.newton.worlds``.
    """

    def __init__(self, model: newton.Model):
        self._model, self._device = model, model.device
        self.trouble = wp.zeros(max(int(model.world_count), 1) + 1, dtype=wp.int32, device=self._device)
        self._found = wp.zeros(worlds.REPORTS, dtype=wp.int32, device=self._device)
        #: Whether there is one, which the host can read without waiting.
        self._seen = Mapped(1, self._device)

    @property
    def may_be_wrong(self) -> bool:
        """Whether a world may have failed in the present step."""
        # On the CPU a check costs less than a launch; a recorded step must handle all cases.
        return self._device.is_cuda or self._device.is_capturing or bool(self.trouble.numpy().any())

    @property
    def is_unstable(self) -> bool:
        """Whether a step's result was not finite; waits for the device."""
        return bool(self._found.numpy()[worlds.UNSTABLE])

    def forget_unstable(self) -> None:
        """The step is made again."""
        self._found[worlds.UNSTABLE : worlds.UNSTABLE + 1].zero_()

    def launch(self) -> None:
        """Launch the kernel that stores the failures of a step, at its end."""
        if self.may_be_wrong:
            outputs = [self._found, self._seen.array]
            wp.launch(worlds.report_trouble, len(self.trouble), [self.trouble], outputs, device=self._device)

    def check_earlier(self, following: Following | None) -> None:
        """Report errors of steps that have finished. On CUDA, outside captures; does not wait.

        If substeps follow the state, a world that failed continues with twice as many, and a warning says so.
        """
        if self._device.is_cpu or self._device.is_capturing or not self._seen.values[0]:
            return
        try:
            self.check(None, following)
        except UnstableError as error:
            if following is None or following.share < 0.5**RETRIES:
                raise
            warnings.warn(str(error), UserWarning, stacklevel=3)

    def check(self, stable_dt: float | None, following: Following | None) -> None:
        """See ``SolverCorotated.check``."""
        report = self._found.numpy().copy()
        if not report.any():
            return
        self._found.zero_()
        self._seen.values[0] = 0.0
        worst = int(np.flatnonzero(report)[-1])
        world = int(report[worst]) - 1
        where = f" in world {world}" if self._model.world_count > 1 and world < self._model.world_count else ""
        if worst == int(worlds.BAD_INPUT):
            raise InputError(f"state_in is not finite{where}; state_out keeps its former values there")
        if worst == int(worlds.TOO_MANY_PAIRS):
            raise InputError(
                "there are more pairs of soft bodies than Newton has room for: call pipeline.init_soft_self_contact "
                f"with larger vertex_buffer_pre_alloc and edge_buffer_pre_alloc{where}; no step was made"
            )
        if worst == int(worlds.TOO_MANY_CONTACTS):
            raise InputError(
                "there are more soft contacts than contacts.soft_contact_max: make the CollisionPipeline with a "
                "larger soft_contact_max; no step was made"
            )
        raise UnstableError(self._unstable(where, stable_dt, following))

    def _unstable(self, where: str, stable_dt: float | None, following: Following | None) -> str:
        """The message; from now on steps have more substeps if these follow the state and steps are not repeated."""
        hint = "" if stable_dt is None else f"; the largest stable step at rest is about {stable_dt:.3g} s"
        wrong = "not finite" if following is None else "not finite or beyond reason"
        if following is not None and self._device.is_cpu and not following.was_recorded:
            hint += f"; {2**RETRIES} times the substeps did not help"
        elif following is not None:
            following.share *= 0.5
            hint += "; from now on steps have twice the substeps, recorded ones when they are recorded again"
        return f"the step's result is {wrong}{where}; that state was not changed{hint}"
