"""Bodies in motion: an elastic model, an integrator and gravity, stepped in recorded graphs."""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from .body import SoftBody
from .checks import checked_count
from .elasticity import Corotated, Model
from .errors import InputError, StabilityWarning, UnstableError, depth_of_user
from .indices import checked_indices
from .nodal import vec3_view
from .parts import checked_bodies, checked_gravity, checked_integrator, checked_models
from .remesh.online import OnlineRemesh
from .remesh.remeshing import Remeshing
from .solvers import Integrator, SymplecticEuler, largest_frequency
from .solvers.integrator import StepContext
from .solvers.recorded import GRAPH_STEPS, RecordedSteps

#: About how long a run goes on before it looks whether its state is still finite [s].
CHECK_SECONDS = 0.1

_NEVER = np.iinfo(np.int64).max


class Energy(NamedTuple):
    """Energies of all bodies together [J]; gravitational about the origin."""

    kinetic: float
    elastic: float
    gravitational: float

    @property
    def total(self) -> float:
        return self.kinetic + self.elastic + self.gravitational


@dataclass(frozen=True)
class _Hook:
    callback: Callable[[Simulation], None]
    every: int


class Simulation:
    """One or several soft bodies, stepped together.

    Args:
        bodies: A ``SoftBody`` or several on one device; they do not touch one another.
        model: Elastic model, or one for each body.
        integrator: Time integrator; with ``dt=None`` a stable step is found.
        gravity: [m/s^2]; None for 9.81 down the up axis of the first body's mesh.
        deterministic: Whether a run must come out the same bit by bit every time. On the CPU it always does; on CUDA
            forces are then added up in one order, which takes time and memory (``benchmarks/README.md``).
        remesh: How the bodies' meshes follow their motion; for several bodies also one each, None for those that stay
            as they are.

    Attributes:
        bodies: Tuple of the bodies.
        worlds: Copies of the bodies, the same number for each.
        dt: Time step [s]; with ``remesh`` and no step given it follows what the finest elements hold.
        stable_dt: Largest linearly stable step at rest [s], estimated; infinite where nothing can vibrate.
        gravity: Tuple [m/s^2].

    Raises:
        InputError: No body, one given twice, bodies on different devices or of different numbers of worlds, a number of
            models that is not the number of bodies, a body of which no node is free to move, non-finite gravity, a
            model that does not go with its mesh, something that is none of these, or bodies that cannot be remeshed as
            asked (see ``OnlineRemesh``).

    Warns:
        StabilityWarning: The given step is larger than ``stable_dt``.
        CapacityWarning: A mesh has no room left for what should be refined; once.
    """

    def __init__(
        self,
        bodies: SoftBody | Sequence[SoftBody],
        *,
        model: Model | Sequence[Model] | None = None,
        integrator: Integrator | None = None,
        gravity: npt.ArrayLike | None = None,
        deterministic: bool = False,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None = None,
    ):
        self.bodies = checked_bodies(bodies)
        self.device, self.worlds = self.bodies[0].device, self.bodies[0].worlds
        self.deterministic = bool(deterministic)
        self.models = checked_models(Corotated() if model is None else model, len(self.bodies))
        self.integrator = checked_integrator(SymplecticEuler() if integrator is None else integrator)
        self.gravity = checked_gravity(gravity, self.bodies[0].mesh.up_axis)

        self.remeshing = Remeshing(self.bodies, self.models, remesh, deterministic=self.deterministic)
        bound = zip(self.models, self.bodies, strict=True)
        self.fields = tuple(m.bind(body, deterministic=self.deterministic) for m, body in bound)
        self.remeshing.serve(self.fields)
        self.clock = wp.zeros(1, dtype=wp.int64, device=self.device)
        self._bad_step = wp.array([_NEVER], dtype=wp.int64, device=self.device)
        #: Steps that would have taken as long as the time before the first one of the present length.
        self._epoch = 0.0
        self.dt = self._found_step()
        self._bind_steppers()
        self._steps_before_reset = 0
        self._time_before_reset = 0.0
        self._check_steps = GRAPH_STEPS
        self._hooks: list[_Hook] = []

    # --- stepping --------------------------------------------------------------------------------------------------

    @property
    def body(self) -> SoftBody:
        """The first body."""
        return self.bodies[0]

    @property
    def remesh(self) -> tuple[OnlineRemesh | None, ...]:
        """How each body is remeshed, with numbers in place of None; the arrays of parameters are the live ones."""
        return tuple(None if each is None else each.options for each in self.remeshing.changing)

    @property
    def steps(self) -> int:
        """Time steps done, since the last ``reset()`` if there was one."""
        return int(self.clock.numpy()[0])

    @property
    def total_steps(self) -> int:
        """Time steps done, whatever has been reset since."""
        return self._steps_before_reset + self.steps

    @property
    def time(self) -> float:
        """Simulated time [s], since the last ``reset()`` if there was one."""
        return (self.steps - self._epoch) * self.dt

    @property
    def total_time(self) -> float:
        """Simulated time [s], whatever has been reset since."""
        return self._time_before_reset + self.time

    def step(self) -> None:
        """Advance by one time step.

        Inside somebody else's capture on this device the step's launches are recorded, nothing else: no hooks are
        called and nothing is checked. On CUDA the call does not wait for the device unless hooks are set or bodies are
        remeshed.

        Raises:
            InputError: Somebody is capturing, and there are bodies to be remeshed.
            UnstableError: On the CPU: the state is not finite any more.
        """
        if self.device.is_capturing:
            if self.remeshing.every:
                raise InputError("a simulation with remesh cannot be recorded by others: launches change with the mesh")
            self._recorded.launch(1, whole=True)
            return
        self._recorded.replay(1, whole=True)
        if self.device.is_cpu or self._hooks or self.remeshing.every:
            self._check_finite()
            if self.remeshing.every:
                self._remesh()
            self._call_hooks()

    def advance(self, seconds: float) -> None:
        """Advance by the whole number of steps nearest to ``seconds``; the state is there when the call returns.

        Raises:
            InputError: Negative or non-finite time.
            UnstableError: The state is not finite any more; the message says since which step.
        """
        if not (math.isfinite(seconds) and seconds >= 0):
            raise InputError(f"cannot advance by {seconds} s; it must be zero or a positive time")
        if self.device.is_capturing:
            raise InputError("advance cannot be called while its device is capturing; call step, which records")
        if self.remeshing.every:
            self.advance_until(self.total_time + seconds)
        else:
            self.advance_steps(round(seconds / self.dt))

    def advance_until(self, total_time: float) -> None:
        """Advance until ``total_time`` [s] is as near as whole steps bring it; as ``advance``."""
        count = max(round((total_time - self.total_time) / self.dt), 0)
        if not self.remeshing.every:
            self.advance_steps(count)
            return
        # A pass may change the step.
        while count > 0:
            self.advance_steps(min(count, self.remeshing.every - self.steps % self.remeshing.every))
            count = max(round((total_time - self.total_time) / self.dt), 0)

    def advance_steps(self, count: int) -> None:
        """Advance by ``count`` time steps; as ``advance``. Steps that a hook makes count."""
        count = checked_count(count, "count", least=0)
        end = self.total_steps + count
        done, left = self.steps, count
        while left > 0:
            rests = [hook.every for hook in self._hooks]
            if self.remeshing.every:
                rests.append(self.remeshing.every)
            due = min([done + left, done + self._check_steps, *((done // every + 1) * every for every in rests)])
            started = time.perf_counter()
            self._recorded.replay_runs(due - done)
            self._check_finite()
            if self.remeshing.is_due(due):
                self._remesh()
            if due - done == self._check_steps:
                longer = CHECK_SECONDS / (time.perf_counter() - started)
                self._check_steps = max(int(self._check_steps * min(longer, 4.0)), 1)
            done, left = due, left - (due - done)
            if self._hooks:
                # A hook may make steps itself or set the clock back.
                self._call_hooks()
                done, left = self.steps, end - self.total_steps
        wp.synchronize_device(self.device)

    def on_step(self, callback: Callable[[Simulation], None], every: int = 1) -> None:
        """Call ``callback(sim)`` after every ``every``-th step, counted from the beginning of the simulation.

        Raises:
            InputError: ``every`` is not a positive whole number, or the callback cannot be called.
        """
        if not callable(callback):
            raise InputError(f"callback is {callback!r}; it must be a function of the simulation")
        self._hooks.append(_Hook(callback, checked_count(every, "every", least=1)))

    def reset(self, worlds: npt.ArrayLike | wp.array | None = None) -> None:
        """Put worlds back to their initial state: rest, or what ``SoftBody.set_initial_state`` took as such.

        Their prescribed motions begin anew; materials, loads and held nodes stay as they are. A body that is remeshed
        goes back to the mesh of that state, with the loads and held nodes that this mesh had last. The clock goes on
        unless all worlds are reset by ``reset()``.

        Args:
            worlds: None for all; an index, indices or a mask bool [worlds]; or a Warp array int32 [worlds] on the
                device, not zero for worlds to be reset, for which nothing waits or comes back to the host.

        Raises:
            InputError: There is no such world, or an array of another type, length or device.
        """
        if isinstance(worlds, wp.array):
            if worlds.dtype != wp.int32 or worlds.shape != (self.worlds,) or worlds.device != self.device:
                raise InputError(
                    f"worlds is {worlds.dtype.__name__} {list(worlds.shape)} on {worlds.device}; "
                    f"it must be int32 [{self.worlds}] on {self.device}"
                )
            chosen = worlds
        else:
            mask = np.zeros(self.worlds, np.int32)
            mask[slice(None) if worlds is None else checked_indices(worlds, self.worlds, "world")] = 1
            chosen = wp.array(mask, dtype=wp.int32, device=self.device)
        if worlds is None:
            self._steps_before_reset, self._time_before_reset = self.total_steps, self.total_time
            self._epoch = 0.0
            self.clock.zero_()
            self._bad_step.fill_(_NEVER)
        for body, field in zip(self.bodies, self.fields, strict=True):
            body.reset(chosen, self.clock)
            field.reset(chosen)
        self._control_step()

    # --- looking ---------------------------------------------------------------------------------------------------

    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy of all bodies in the present state [J]."""
        kinetic = elastic = gravitational = 0.0
        for body, field in zip(self.bodies, self.fields, strict=True):
            body.adopt_positions()
            v = body.velocities.numpy().astype(np.float64)
            u = body.node_displacements[: body.node_count].numpy()[:, :3].astype(np.float64)
            kinetic += 0.5 * float(body.masses @ np.einsum("ni,ni->n", v, v))
            elastic += field.elastic_energy(body.node_displacements)
            gravitational -= float(body.masses @ ((body.rest_positions + u) @ np.asarray(self.gravity)))
        return Energy(kinetic, elastic, gravitational)

    def forces(self, body: SoftBody | None = None) -> wp.array:
        """Elastic nodal forces in the present state [N], vec3 [worlds * N]; of the first body or the one named."""
        chosen = self._index(body)
        self.bodies[chosen].adopt_positions()
        forces = self.fields[chosen].elastic_forces(self.bodies[chosen].node_displacements)
        return vec3_view(forces[: self.bodies[chosen].node_count])

    def von_mises(self, body: SoftBody | None = None) -> npt.NDArray[np.float32]:
        """Von Mises stress of each element in the present state [Pa], float32 [worlds * T]."""
        chosen = self._index(body)
        self.bodies[chosen].adopt_positions()
        return self.fields[chosen].von_mises(self.bodies[chosen].node_displacements)

    # --- keeping ---------------------------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Write everything needed to go on to one file (.npz, no pickle), whole or not at all; hooks are not kept.

        Raises:
            InputError: The folder is not there or cannot be written to.
        """
        from .io.checkpoint import save_checkpoint

        save_checkpoint(self, path)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        *,
        device: str | wp.Device | None = None,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None = None,
    ) -> Simulation:
        """Go on from a saved simulation; on the CPU bit by bit as if it had never stopped.

        Args:
            path: A file that ``save`` wrote.
            device: Where to go on; None: where it was saved.
            remesh: In place of what was saved, which does not hold a criterion of your own; the capacity stays.

        Raises:
            InputError: No such file, not a checkpoint, one of a newer version, no such device, or a criterion that is
                missing.
        """
        from .io.checkpoint import load_checkpoint

        return load_checkpoint(path, device, remesh)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _found_step(self) -> float:
        """The time step that was given, or one that is stable; ``stable_dt`` is found anew."""
        frequencies = [largest_frequency(body, f) for body, f in zip(self.bodies, self.fields, strict=True)]
        steps = [2.0 / w if w > 0 else math.inf for w in frequencies]
        self.stable_dt = min(steps)
        if self.integrator.dt is not None:
            given = float(self.integrator.dt)
            if given > self.stable_dt:
                warnings.warn(
                    f"the time step {given:.3g} s is beyond the largest stable one, about {self.stable_dt:.3g} s",
                    StabilityWarning,
                    stacklevel=depth_of_user(),
                )
            return given
        safe = min(m.step_safety * dt for m, dt in zip(self.models, steps, strict=True))
        return safe if math.isfinite(safe) else 1e-3

    def _bind_steppers(self) -> None:
        context = StepContext(self.dt, wp.vec3(*self.gravity), self.clock, self._bad_step)
        bound = zip(self.bodies, self.fields, strict=True)
        steppers = [self.integrator.bind(body, field, context) for body, field in bound]
        self._recorded = RecordedSteps(self.bodies, steppers, self.clock)

    def _remesh(self) -> None:
        """Let the meshes follow the motion, and the step the meshes, where that is due."""
        if self.remeshing.run(self.steps):
            self._control_step()

    def _control_step(self) -> None:
        """Find the stable step anew where the elements that limit it are others now."""
        if not self.remeshing.step_may_change():
            return
        before, self.dt = self.dt, self._found_step()
        if self.dt == before:
            return
        # What has been simulated, and how long ago worlds were reset, in steps of the new length.
        ratio, steps = before / self.dt, self.steps
        self._epoch = steps - (steps - self._epoch) * ratio
        for body in self.bodies:
            starts = body.world_starts.numpy()
            body.world_starts.assign(steps - (steps - starts) * ratio)
        self._bind_steppers()

    def _index(self, body: SoftBody | None) -> int:
        if body is None:
            return 0
        if body not in self.bodies:
            raise InputError("the body is not one of this simulation's")
        return self.bodies.index(body)

    def _check_finite(self) -> None:
        step = int(self._bad_step.numpy()[0])
        if step == _NEVER:
            return
        # Said once: who sets a good state again may go on.
        self._bad_step.fill_(_NEVER)
        bad = self._bad_worlds()
        if not len(bad):
            return  # somebody has set a good state before anybody looked
        more = f" and {len(bad) - 3} more" if len(bad) > 3 else ""
        where = f" in world {', '.join(map(str, bad[:3]))}{more}" if self.worlds > 1 else ""
        hint = f"dt is {self.dt:.3g} s, the largest stable step at rest about {self.stable_dt:.3g} s"
        when = f"step {step} (t = {(step - self._epoch) * self.dt:.4g} s)"
        raise UnstableError(f"the state is not finite since {when}{where}; {hint}")

    def _bad_worlds(self) -> npt.NDArray[np.intp]:
        """The worlds in which something is not finite, as ``kernels.integrate.is_finite`` has it."""
        bad = np.zeros(self.worlds, bool)
        for body in self.bodies:
            sizes = np.abs(body.node_displacements.numpy().astype(np.float64)).sum(axis=1)
            bad |= ~(sizes.reshape(self.worlds, -1) <= 3e38).all(axis=1)
        return np.flatnonzero(bad)

    def _call_hooks(self) -> None:
        steps = self.steps if self._hooks else 0
        for hook in tuple(self._hooks):
            if steps % hook.every == 0:
                hook.callback(self)
