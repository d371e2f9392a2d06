"""Whether a state can be true, and the last one that could: finite, within reach, and without energy from nowhere."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from ..kernels.balance import find_changes
from .balance import Balance, Energies, Floats
from .integrator import NEVER, StepContext

if TYPE_CHECKING:
    from ..body import SoftBody
    from ..elasticity import ForceField

#: Energy that may come from nowhere between two checks, and in all, as shares of the most that gravity, loads and
#: supports ever moved or a user gave. A stable step errs by less than a tenth, and by up to a half while elements are
#: crushed and turned over; one that is not stable by more and more, many times within tens of steps.
GAIN = 0.25
DRIFT = 0.5
#: By how much the kinetic energy may exceed the whole, since fast vibrations are not in time with their displacements;
#: and from which excess on elastic energies are looked at.
MOTION = 0.5
LITTLE = 0.1
#: So much of it is let pass where the step may be made shorter.
STRICT = 0.02
#: So many times as much is let pass where rotations are shared, which have no energy.
SHARED = 4.0
#: Displacements beyond so many sizes of the body leave no digit of float32 for its strains.
REACH = 1e6


@dataclass(frozen=True)
class Fault:
    """What is wrong with a state.

    Attributes:
        what: In words.
        worlds: In which worlds.
        step: The first step after which it was seen, if that is known.
        is_slight: Whether the state may still be true, roughly.
    """

    what: str
    worlds: npt.NDArray[np.intp]
    step: int | None = None
    is_slight: bool = False


class Guard:
    """Checks states against the last good one, which it keeps on the device.

    Args:
        bodies, fields: The simulation's.
        context: What its steps share.
        state: Further arrays that belong to the state.
    """

    def __init__(
        self,
        bodies: Sequence[SoftBody],
        fields: Sequence[ForceField],
        context: StepContext,
        state: Sequence[wp.array],
    ):
        self.bodies, self.fields, self.context = tuple(bodies), tuple(fields), context
        self.worlds = bodies[0].worlds
        self._size = max(float(np.ptp(body.mesh.points, axis=0).max()) for body in bodies)
        self._balance = Balance(bodies, fields, context)
        self._more = tuple(state)
        self._kept: list[wp.array] = []
        self._references: list[wp.array] = []
        self._changed = wp.zeros(1, dtype=wp.int32, device=bodies[0].device)
        self._reference: Energies | None = None
        self._inverse_mass: list[wp.array] = []
        shared = any(getattr(field, "rotation_level", None) is not None for field in fields)
        self._leave = SHARED if shared else 1.0
        #: Energy from nowhere between the last two checks on elastic energies, and in all, as shares of what was moved;
        #: of the world that has most; and the same for what fast vibrations err by at any one time. Infinite while no
        #: check has found them.
        self.gain = self.surplus = self.untimely = np.inf
        self.restart()

    def restart(self) -> None:
        """Forget all: the next state is taken for good."""
        self._reference = None
        self._scale, self._drift, self._loads = (np.zeros(self.worlds) for _ in range(3))
        self._height, self._loads_before = np.zeros(self.worlds), np.zeros(self.worlds)
        self._counted: Floats | None = None
        self.gain = self.surplus = self.untimely = np.inf
        self._floor: Floats | None = None

    def forget(self) -> None:
        """The next state is taken for good: it does not follow from the last one."""
        self._reference = None

    def begin(self) -> bool:
        """Take the present state for good if it is not the one that was checked last: a user may have written to it.

        Returns whether it is another.
        """
        changed = self._reference is None or self._has_changed()
        if changed:
            self._reference = None
            self.context.support_work.zero_()
            found = self._find(whole=True)
            if self._counted is not None:
                found, changed = self._counted_on(found, self._counted), False
            else:
                self._loads, self._height = np.zeros(self.worlds), found.gravitational
                self._loads_before = np.zeros(self.worlds)
                # A world that begins wrong may be set right later.
            known = np.where(np.isfinite(found.exact), np.abs(found.exact), 0.0)
            self._scale = np.maximum(self._scale, known)
            self._counted = None
            self._keep(found)
        return changed

    def _counted_on(self, found: Energies, counted: Floats) -> Energies:
        """What a run that goes on counts from, which a checkpoint brought."""
        exact, gravitational, supports, self._loads_before, self._height, self._loads = counted
        return replace(found, exact=exact, gravitational=gravitational, supports=supports)

    def check(self, *, whole: bool, strict: bool = False, lenient: bool = False) -> Fault | None:
        """Look at the present state; a good one is kept.

        Args:
            strict: Whether less energy from nowhere is let pass than would be taken for an error.
            lenient: Whether energy from nowhere since the beginning is let pass, since a shorter step will do.
            whole: Whether elastic energies are found too. Without them the sum of the others must not exceed what there
                was and came in: elastic energies are never negative.
        """
        fault = self._not_finite()
        if fault is not None:
            return fault
        assert self._reference is not None
        found = self._find(whole=whole)
        # What is looked at besides, at the end of a short run, must not change where that run was made in one.
        leave = self._leave * (STRICT if strict and whole else 1.0)
        fault = self._beyond_reach(found) or self._from_nowhere(found, whole, leave, lenient)
        if fault is not None and not whole:
            whole, found = True, self._find(whole=True)
            fault = self._beyond_reach(found) or self._from_nowhere(found, whole, leave, lenient)
        if fault is None:
            self._keep(found if whole else None)
        return fault

    def go_back(self) -> None:
        """Put the last good state back."""
        for array, kept in zip(self._arrays(), self._kept, strict=True):
            wp.copy(array, kept)
        for body in self.bodies:
            body.node_forces.zero_()
            body.publish_positions()
        self.context.bad_step.fill_(NEVER)

    def settle(self) -> None:
        """Count from the present energies, whose kinetic one depends on the step, which is another now."""
        self._keep(self._find(whole=True))

    def not_finite(self) -> Fault | None:
        """Whether the state is not finite: the least that there is to look at."""
        return self._not_finite()

    def beyond_reach(self) -> Fault | None:
        """Whether nodes are where they cannot be: what can be seen of a state that users may write to."""
        return self._beyond_reach(self._find(whole=False))

    @property
    def state(self) -> dict[str, Floats]:
        """What a run that goes on needs besides the present state."""
        counted = np.full((6, self.worlds), np.nan)
        before = self._reference
        if before is not None and not self._has_changed():
            now = self._find(whole=False)
            supports = before.supports - now.supports
            loads = self._loads_before + now.loads
            counted[:] = before.exact, before.gravitational, supports, loads, self._height, self._loads
        return {"scale": self._scale, "drift": self._drift, "counted": counted}

    def resume(self, *, scale: Floats, drift: Floats, counted: Floats) -> None:
        """Go on from what ``state`` gave."""
        self._scale, self._drift = np.array(scale, float), np.array(drift, float)
        if np.isfinite(counted).all():
            self._counted = np.array(counted, float)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _arrays(self) -> list[wp.array]:
        """All that belongs to the state."""
        arrays: list[wp.array] = []
        for body, field in zip(self.bodies, self.fields, strict=True):
            arrays += [body.node_displacements, body.node_velocities, *field.state.values()]
        return [*arrays, self.context.support_work, *self._more]

    def _find(self, *, whole: bool) -> Energies:
        counted = self._reference is not None
        since = self._references if counted else [body.node_displacements for body in self.bodies]
        return self._balance.find(since, whole=whole)

    def _keep(self, found: Energies | None) -> None:
        """Keep the present state, and if its whole energies were found, count from these on."""
        arrays = self._arrays()
        if [a.shape for a in arrays] != [k.shape for k in self._kept]:
            self._kept = [wp.empty_like(array) for array in arrays]
            self._references = [wp.empty_like(body.node_displacements) for body in self.bodies]
            self._inverse_mass = [wp.empty_like(body.node_inverse_mass) for body in self.bodies]
        for array, kept in zip(arrays, self._kept, strict=True):
            wp.copy(kept, array)
        for body, kept in zip(self.bodies, self._inverse_mass, strict=True):
            wp.copy(kept, body.node_inverse_mass)
        if found is not None:
            self._reference = found
            for body, kept in zip(self.bodies, self._references, strict=True):
                wp.copy(kept, body.node_displacements)

    def _has_changed(self) -> bool:
        self._changed.zero_()
        place = 0
        for body, field, mass in zip(self.bodies, self.fields, self._inverse_mass, strict=True):
            u, v = self._kept[place : place + 2]
            place += 2 + len(field.state)
            inputs = [body.node_inverse_mass, mass, body.node_displacements, u, body.node_velocities, v]
            wp.launch(find_changes, dim=body.launch_nodes, inputs=inputs, outputs=[self._changed], device=body.device)
        return bool(self._changed.numpy()[0])

    def _not_finite(self) -> Fault | None:
        step = int(self.context.bad_step.numpy()[0])
        if step == NEVER:
            return None
        # Said once: who sets a good state again may go on.
        self.context.bad_step.fill_(NEVER)
        bad = self._not_finite_worlds()
        # Somebody may have set a good state before anybody looked.
        return Fault("the state is not finite", bad, step) if len(bad) else None

    def _not_finite_worlds(self) -> npt.NDArray[np.intp]:
        """The worlds in which something is not finite, as ``kernels.integrate.is_finite`` has it."""
        bad = np.zeros(self.worlds, bool)
        for body in self.bodies:
            sizes = np.abs(body.node_displacements.numpy().astype(np.float64)).sum(axis=1)
            bad |= ~(sizes.reshape(self.worlds, -1) <= 3e38).all(axis=1)
        return np.flatnonzero(bad)

    def _beyond_reach(self, found: Energies) -> Fault | None:
        bad = np.flatnonzero(~(found.reach <= REACH * self._size))
        if not len(bad):
            return None
        return Fault(f"nodes are {found.reach[bad].max():.3g} m from where they were at rest", bad)

    def _from_nowhere(self, found: Energies, whole: bool, leave: float, lenient: bool) -> Fault | None:
        before = self._reference
        assert before is not None
        if not self._balance.is_closed:
            self.gain = self.surplus = self.untimely = 0.0
            return None
        if self._floor is None:
            self._floor = self._balance.rounding()
        fallen = before.gravitational - found.gravitational
        loads = self._loads_before + found.loads
        given = before.exact + fallen + loads + found.supports - before.supports
        # What has come from nowhere is no measure of what may.
        moved = np.abs(self._height - found.gravitational) + np.abs(self._loads + loads)
        scale = np.maximum(self._scale, moved + found.supports_absolute)
        # Elastic energies are never negative.
        gain = found.kinetic - given
        bad = ~(gain <= (MOTION if whole else LITTLE) * self._leave * scale + self._floor)
        drift = self._drift
        if whole:
            drift = np.maximum(self._drift + found.exact - given, 0.0)
            gain = np.maximum(np.maximum(gain, found.exact - given), drift)
            bad |= ~(found.exact - given <= GAIN * leave * scale + self._floor)
            if not lenient:
                bad |= ~(drift <= DRIFT * self._leave * scale + 10.0 * self._floor)
        if bad.any():
            worlds = np.flatnonzero(bad)
            worst = worlds[np.argmax(gain[worlds])]
            most = f"gravity, loads and supports have moved {scale[worst]:.3g} J at most"
            is_slight = bool((gain[worlds] <= GAIN * self._leave * scale[worlds] + self._floor).all())
            return Fault(f"{gain[worst]:.3g} J of energy came from nowhere ({most})", worlds, is_slight=is_slight)
        if whole:
            known = 1.0 / np.maximum(scale, 1e-300)
            self.gain = float(np.max(np.maximum(found.exact - given - self._floor, 0.0) * known)) / self._leave
            self.surplus = float(np.max(np.maximum(drift - 10.0 * self._floor, 0.0) * known)) / self._leave
            self.untimely = float(np.max(np.maximum(found.untimely - self._floor, 0.0) * known)) / self._leave
        self._scale, self._drift = scale, drift
        if whole:
            self._loads = self._loads + loads
            self._loads_before = np.zeros(self.worlds)
        return None
