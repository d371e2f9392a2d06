"""Bodies in motion: an elastic model, an integrator and gravity, stepped in recorded graphs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from os import PathLike
from typing import NoReturn

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.mass_split import solver_of
from warp_corot.contact.options import Contact, may_meet
from warp_corot.contact.reading import ContactPoint, contact_points
from warp_corot.contact.tool import Obstacle
from warp_corot.cutting.blade import Blade, checked_blades
from warp_corot.cutting.blades import Blades
from warp_corot.discretization.sizes import vec3_view
from warp_corot.elasticity import Corotated, Model
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_flag, checked_number, refuse_tape
from warp_corot.inputs.loading import (
    CONTACT,
    CONTACT_ON_CPU,
    EXPLICIT,
    IMPLICIT,
    IMPLICIT_ON_FORESTS,
    PAIRS_ON_CPU,
    STEPS,
    STEPS_ON_CPU,
    LoadedKernel,
    begin_loading,
    load,
    wait_for,
)
from warp_corot.inputs.simulation_lock import SIMULATION_LOCK, under_lock
from warp_corot.kernels.contact.search import count_crushed, pair_finder
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.stepping.integrate import STEP_SYMPLECTIC_EULER
from warp_corot.kernels.stepping.stability import find_strains
from warp_corot.remesh.remeshing import OnlineRemesh, Remeshing
from warp_corot.solvers import Integrator, SymplecticEuler
from warp_corot.solvers.guard import Guard
from warp_corot.solvers.pace import Pace
from warp_corot.solvers.recorded import RecordedSteps, Segment
from warp_corot.solvers.stability import ANY_STEP, SafeStep
from warp_corot.solvers.system import NEVER, Forces, System

from .cutting import Cutting
from .energy import Energy, Solves, WorldEnergies, find_energies
from .parts import (
    check_constraints,
    check_implicit,
    checked_bodies,
    checked_contact,
    checked_curvature,
    checked_gravity,
    checked_integrator,
    checked_models,
    chosen_worlds,
)
from .running import Hooks, Running


class Simulation(Cutting):
    """One or several soft bodies, stepped together.

    Args:
        bodies: A ``SoftBody`` or several on one device.
        model: Elastic model, or one for each body.
        integrator: Time integrator, ``SymplecticEuler()`` if none is given, or an implicit one such as
            ``BackwardEuler(dt=0.01)``. With ``dt=None`` the step follows the state: it is measured again during the
            run, and if the state still goes wrong, the run is repeated with half the step. A given step stays; if it is
            too long, the run ends with an error.
        gravity: [m/s^2]; None for 9.81 against the up axis of the first body's mesh.
        deterministic: Whether every run must give the same result bit by bit. The CPU always does; on CUDA, forces are
            then added up in a fixed order, which takes time and memory (``benchmarks/README.md``); but for points of
            grasps and of the page's hands that share nodes.
        remesh: How the bodies' meshes follow their motion; for several bodies also one each, None for meshes that
            never change.
        obstacles: Rigid obstacles of the bodies: shapes at rest, such as ``Ground`` and ``Box``, and tools, which move.
        contact: The options of contact; None: ``Contact()`` if there are obstacles, else no contact.
        cuts: Blades that cut the bodies; an empty list prepares these for ``cut``.

    Attributes:
        bodies: Tuple of the bodies.
        worlds: Copies of the bodies, the same number for each.
        stable_dt: Largest linearly stable step at rest [s], estimated; infinite where nothing can vibrate, and for
            implicit integrators.
        gravity: Tuple [m/s^2].
        ranks: The processes that make the same steps with other parts of the bodies.

    Raises:
        InputError: There is no body, one is given twice, bodies have different devices or numbers of worlds, the number
            of models is not the number of bodies, a body has no free node, gravity is not finite, a model does not
            support its mesh, an argument has another type, a body cannot be remeshed this way (see ``OnlineRemesh``),
            or the integrator does not support contact or remeshing.

    Warns:
        StabilityWarning: The given step is larger than ``stable_dt``.
        CapacityWarning: A mesh has no room left for refinement; once.
    """

    #: Whether this process prints and writes.
    is_root = True

    def __init__(
        self,
        bodies: SoftBody | Sequence[SoftBody],
        *,
        model: Model | Sequence[Model] | None = None,
        integrator: Integrator | None = None,
        gravity: npt.ArrayLike | None = None,
        deterministic: bool = False,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None = None,
        obstacles: Obstacle | Sequence[Obstacle] = (),
        contact: Contact | None = None,
        cuts: Blade | Sequence[Blade] | None = None,
    ):
        with SIMULATION_LOCK:
            self.bodies = checked_bodies(bodies, self.ranks)
            self.device, self.worlds = self._found_device(), self.bodies[0].worlds
            self.deterministic = checked_flag(deterministic, "deterministic")
            self.models = checked_models(Corotated() if model is None else model, len(self.bodies))
            self.integrator = checked_integrator(SymplecticEuler() if integrator is None else integrator)
            self.gravity = checked_gravity(gravity, self.bodies[0].mesh.up_axis)
            touching = checked_contact(obstacles, contact)
            ordered = self.deterministic and self.device.is_cuda
            blades = checked_blades(cuts)
            changes = remesh is not None or blades is not None
            check_implicit(self.integrator, remeshes=changes, ordered=ordered)
            #: Functions that are called after steps.
            self.hooks = Hooks()
            given = self.integrator.dt
            self.pace = Pace(ANY_STEP if given is None else float(given), self.device)
            self._make(remesh, touching, blades)

    def _make(
        self,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
        touching: tuple[tuple[Obstacle, ...], Contact] | None,
        blades: tuple[Blade, ...] | None,
    ) -> None:
        """Make all that makes steps of the bodies as they are now."""
        self.remeshing = self._made_passes(remesh, blades)
        self._make_steps(touching, blades)
        #: Makes the steps.
        self.running = Running(self)

    def _made_passes(
        self, remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None, blades: tuple[Blade, ...] | None
    ) -> Remeshing:
        """The passes over the bodies' meshes."""
        return Remeshing(self.bodies, self.models, remesh, deterministic=self.deterministic, blades=blades)

    def _found_device(self) -> wp.Device:
        """The device of the steps."""
        return self.bodies[0].device

    def _divided(self) -> tuple[SoftBody, ...]:
        """The bodies as this process steps them: whole, or its parts of them."""
        return self.bodies

    def _make_steps(
        self, touching: tuple[tuple[Obstacle, ...], Contact] | None, blades: tuple[Blade, ...] | None
    ) -> None:
        """Make all of this that does not go on when parts of bodies are divided anew."""
        self.parts = self._divided()
        given = self.integrator.dt
        bound = zip(self.models, self.parts, strict=True)
        self.fields = tuple(m.bind(body, deterministic=self.deterministic) for m, body in bound)
        if self.parts is self.bodies:
            self.remeshing.serve(self.fields)
        for field in self.fields:
            field.divide()
        self.system = System(self.parts, self.fields, self.pace, self.gravity, self.ranks)
        loading = self._load_kernels(touching)
        stable = self._find_stable_steps()
        #: Keeps bodies out of obstacles and out of one another; None without contact.
        self.contact: Contacts | None = None
        if touching is not None:
            own = self.ranks.is_alone or not self.integrator.is_implicit
            self.contact = Contacts(self.system, *touching, stable_dt=self.stable_dt, dt=given, on_surfaces=own)
            self.system.constraints.append(self.contact)
        #: Blades that cut the bodies; None without.
        self.blades: Blades | None = None
        if blades:
            longest = self.stable_dt if given is None else float(given)
            self.blades = Blades(blades, self.system, self.remeshing.changed, longest)
            self.system.forces.append(self.blades)
        #: Chooses the step, if none was given.
        self.safe_step = SafeStep(self.system, self.models, stable) if given is None else None
        self.guard = Guard(self.system)
        self.stepper = self.integrator.bind(self.system)
        wait_for(loading)
        check_constraints(self.system, self.stepper, self.integrator)
        self.recorded = RecordedSteps(self.system, self.stepper, self.guard, self.safe_step)

    def _load_kernels(self, touching: tuple[tuple[Obstacle, ...], Contact] | None) -> list[Future]:
        """Load the kernels that steps are known to launch, several modules at a time; returns those to wait for."""
        explicit, chosen, on_cpu = not self.integrator.is_implicit, self.integrator.dt is None, self.device.is_cpu
        names = [*(STEPS_ON_CPU if on_cpu else STEPS), *(EXPLICIT if chosen else ()), *(() if explicit else IMPLICIT)]
        meet = False
        if touching and explicit:
            meet = on_cpu and may_meet(len(self.parts), touching[1])
            names = [*(CONTACT_ON_CPU if on_cpu else CONTACT), *(PAIRS_ON_CPU if meet else ()), *names]
        if not explicit and any(body.discretization.element_kind is ForestElements for body in self.parts):
            names += IMPLICIT_ON_FORESTS
        kernels: list[LoadedKernel] = [STEP_SYMPLECTIC_EULER[wp.vec4]] if explicit else []
        kernels += [find_strains(body.discretization.element_kind) for body in self.parts if chosen]
        kernels += [count_crushed(body.discretization.element_kind) for body in self.parts if touching]
        if meet:
            kernels.append(pair_finder(self.device.is_cpu))
        if touching and explicit:
            kernels.append(solver_of(self.device, *touching, len(self.parts)))
        kernels += [kernel for field in self.fields for kernel in field.kernels]
        # Explicit steps need the forces at once, to find their length.
        load(names, self.device, kernels if explicit else ())
        return begin_loading((), self.device, kernels)

    # --- stepping --------------------------------------------------------------------------------------------------

    def __reduce_ex__(self, protocol: object) -> NoReturn:
        raise InputError(
            "a Simulation lives on a device and can be neither copied nor pickled; "
            "sim.save(path) and Simulation.load(path) make another in the same state"
        )

    @property
    def body(self) -> SoftBody:
        """The first body."""
        return self.bodies[0]

    @property
    def remesh(self) -> tuple[OnlineRemesh | None, ...]:
        """How each body is remeshed, with numbers in place of None; arrays of parameters are live."""
        changing = self.remeshing.changing
        return tuple(None if each is None or not each.is_remeshed else each.options for each in changing)

    @property
    def solves(self) -> Solves | None:
        """The total cost of an implicit integrator's solves; None for others. Waits for the device."""
        totals = getattr(self.stepper, "totals", None)
        return None if totals is None else Solves(*(int(total) for total in totals.numpy()))

    @property
    def kept(self) -> dict[str, wp.array]:
        """Everything that a checkpoint keeps, by name, besides the states of bodies and fields."""
        return self.pace.state | ({} if self.safe_step is None else self.safe_step.state) | self.stepper.kept

    def step(self) -> None:
        """Advance by one time step.

        If the caller is capturing on this device, only the step's launches are recorded: no hooks are called, nothing
        is checked, and the step has the length that the last run left. On CUDA the call does not wait for the device
        unless hooks are set or bodies are remeshed.

        Raises:
            InputError: The caller is capturing and bodies are remeshed; or a ``wp.Tape`` is recording, because steps
                have no adjoint.
            UnstableError: On the CPU: the state is no longer finite, or nodes are far beyond reach, which is checked
                every few hundred steps. Unlike ``advance``, this call repeats no step and checks no energies, because
                users may write to the state between steps.
        """
        with SIMULATION_LOCK:
            refuse_tape()
            if self.device.is_capturing:
                if self.changes_every:
                    raise InputError(
                        "a simulation with remesh or blades cannot be recorded by others: launches change with the mesh"
                    )
                self.pace.is_shared = True
                self.recorded.launch(Segment(1, adopts=True, publishes=True))
                return
            self.running.step()
            looks = self.device.is_cpu or bool(self.hooks.intervals) or bool(self.changes_every)
            if looks:
                self.running.look()
                if self.changes_every:
                    self.follow_motion()
        if looks:
            self.hooks.call(self)

    def advance(self, seconds: float) -> None:
        """Advance by ``seconds``; the state is ready when the call returns.

        The end is exact: the last steps are a little shorter. With a given step, the nearest whole number of steps is
        made.

        Raises:
            InputError: The time is negative or not finite, or a ``wp.Tape`` is recording.
            UnstableError: The state went wrong: it is not finite, or it has energy from nowhere. If no step was given,
                shorter steps did not help.

        Warns:
            StabilityWarning: The state went wrong, and the run was repeated with half the step; once.
        """
        if not 0 <= checked_number(seconds, "seconds", "s") < math.inf:
            raise InputError(f"cannot advance by {seconds} s; it must be zero or a positive time")
        with SIMULATION_LOCK:
            if self.device.is_capturing:
                raise InputError("advance cannot be called while its device is capturing; call step, which records")
        self.advance_until(self.total_time + seconds)

    def advance_until(self, total_time: float) -> None:
        """Advance until ``total_time`` [s], like ``advance``; do nothing if that time is past."""
        with SIMULATION_LOCK:
            refuse_tape()
        if not checked_number(total_time, "total_time", "s") < math.inf:
            raise InputError(f"cannot advance until {total_time} s; it must be a finite time")
        if self.safe_step is not None:
            self.running.make_until(total_time)
        else:
            self.running.make(max(round((total_time - self.total_time) / self.dt), 0))

    def advance_steps(self, count: int) -> None:
        """Advance by ``count`` time steps, like ``advance``. Steps that a hook makes count."""
        with SIMULATION_LOCK:
            refuse_tape()
        self.running.make(checked_count(count, "count", least=0))

    def on_step(self, callback: Callable[[Simulation], None], every: int = 1) -> None:
        """Call ``callback(sim)`` after every ``every``-th step, counted from the beginning of the simulation.

        Raises:
            InputError: ``every`` is not a positive whole number, or the callback is not callable.
        """
        self.hooks.add(callback, every)

    @under_lock
    def reset(self, worlds: npt.ArrayLike | wp.array | None = None) -> None:
        """Put worlds back to their initial state: rest, or the state at ``SoftBody.set_initial_state``.

        Their prescribed motions begin again; materials, loads and held nodes stay. A remeshed body returns to the mesh
        of its initial state, with the loads and held nodes that this mesh had last. The clock continues unless
        ``reset()`` resets all worlds.

        Args:
            worlds: None for all; an index, indices or a mask bool [worlds]; or a Warp array int32 [worlds] on the
                device, nonzero for worlds to be reset; then the host does not wait for the device.

        Raises:
            InputError: There is no such world, or the array has another type, length or device.
        """
        chosen = chosen_worlds(worlds, self.worlds, self.device)
        if worlds is None:
            self.steps_before_reset, self.time_before_reset = self.total_steps, self.total_time
            self.pace.restart()
            if self.safe_step is not None:
                self.safe_step.restart()
            self.system.bad_step.fill_(NEVER)
            self.guard.restart()
        for body, field in zip(self.parts, self.fields, strict=True):
            body.reset(chosen, self.pace)
            field.reset(chosen)
        for constraint in self.system.constraints:
            constraint.reset(chosen)
        if self.blades is not None:
            self.blades.reset(chosen)
        self._control_step()

    # --- looking ---------------------------------------------------------------------------------------------------

    @under_lock
    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy of all bodies in the present state [J]."""
        return self.world_energies().together

    @under_lock
    def world_energies(self) -> WorldEnergies:
        """The energies of each world [J], float64 [worlds]."""
        own = find_energies(self.parts, self.fields, self.gravity, self.ranks)
        return WorldEnergies(*self.ranks.sum(np.array(own)))

    def collect(self) -> None:
        """Bring the state of all nodes into the bodies; of a simulation on one process it is there already."""

    @under_lock
    def forces(self, body: SoftBody | None = None) -> wp.array:
        """Elastic nodal forces in the present state [N], vec3 [worlds * N], of the first or the given body."""
        chosen = self._index(body)
        self.bodies[chosen].state.adopt_positions()
        forces = self.fields[chosen].elastic_forces(self.bodies[chosen].state.displacements)
        return vec3_view(forces[: self.bodies[chosen].node_count])

    @under_lock
    def von_mises(self, body: SoftBody | None = None) -> npt.NDArray[np.float32]:
        """Von Mises stress of each element in the present state [Pa], float32 [worlds * T]."""
        chosen = self._index(body)
        self.parts[chosen].state.adopt_positions()
        return self.fields[chosen].von_mises(self.parts[chosen].state.displacements)

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Shapes and tools that bodies touch, as they were given."""
        return () if self.contact is None else self.contact.obstacles.given

    def contacts(self) -> list[ContactPoint]:
        """The contacts of the last step, with places, normals, gaps and forces; waits for the device."""
        return [] if self.contact is None else contact_points(self.contact)

    # --- keeping ---------------------------------------------------------------------------------------------------

    @under_lock
    def save(self, path: str | PathLike[str]) -> None:
        """Write everything needed to continue to one file (.npz, no pickle), whole or not at all; hooks are not saved.

        Raises:
            InputError: The folder does not exist or is not writable.
        """
        from warp_corot.io.checkpoint.archive import save_checkpoint

        save_checkpoint(self, path)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        *,
        device: str | wp.Device | None = None,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None = None,
    ) -> Simulation:
        """Continue a saved simulation; on the CPU bit by bit as if it had never stopped.

        Args:
            path: A file that ``save`` wrote.
            device: The device; None: the one on which it was saved.
            remesh: Replaces the saved options, which do not include a criterion of your own; the capacity stays.

        Raises:
            InputError: The file does not exist, is not a checkpoint or has another version, the device does not exist,
                or a criterion is missing.
        """
        from warp_corot.io.checkpoint.archive import load_checkpoint

        return load_checkpoint(path, device, remesh)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def add_forces(self, forces: Forces) -> None:
        """Add forces besides elasticity to every step from now on.

        The forces are a part of recorded steps, and their work counts in the balance of energy. If they have a number
        ``curvature``, the largest stiffness over a node's mass [1/s^2], the stable step is found again with it.

        Args:
            forces: An object with a method ``add_forces``; see ``solvers.system.Forces``.

        Raises:
            InputError: It has no such method, or its curvature is negative or not finite.

        Warns:
            StabilityWarning: The given step is now larger than the stable one.
        """
        curvature = checked_curvature(forces)
        self.system.forces.append(forces)
        self.system.changes += 1
        if curvature > 0.0:
            self._find_step()
