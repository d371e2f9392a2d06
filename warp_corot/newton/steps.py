"""The launches of a step, failures of worlds in it, the reports of them to users, and everything besides tetrahedra."""

from __future__ import annotations

import math
import warnings
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError, UnstableError, depth_of_user
from warp_corot.kernels.newton import particles as kernels
from warp_corot.solvers.pace import Mapped
from warp_corot.solvers.recorded import FlushedSubnormals, Replays

from .contact import Contacts
from .library import ModelView, SolverBase, SolverSemiImplicit, Step, newton
from .substeps import RETRIES, Following, StiffParts
from .tetrahedra import Tetrahedra

#: A particle speed [m/s] that is a failure for any step.
RUNAWAY = float(kernels.RUNAWAY)
#: Fewer substeps are not recorded, since recording one takes as long as several.
FEW = 32
#: The flags of the arrays of a state.
FLAGS = {
    name: int(getattr(newton.StateFlags, name.upper())) for name in ("particle_q", "particle_qd", "body_q", "body_qd")
}
#: Effective number of contacts of a particle with others in a heap, for their total stiffness. A pair that moves
#: against each other counts twice, and opposite contacts count with the square of the cosine of their directions.
CONTACTS = 4.0
#: What there is no room for, and what to do.
_NO_ROOM = {
    int(kernels.TOO_MANY_PAIRS): "pairs of soft bodies than Newton has room for: call pipeline.init_soft_self_contact "
    "with larger vertex_buffer_pre_alloc and edge_buffer_pre_alloc",
    int(kernels.TOO_MANY_CONTACTS): "soft contacts than contacts.soft_contact_max: make the CollisionPipeline with a "
    "larger soft_contact_max",
}


class Steps:
    """Symplectic Euler for all particles of a model, together with everything else.

    Args:
        model: The model.
        tetrahedra, contacts, others: The parts of the model.
        report: Failures of worlds.
        damping: Rate of mass-proportional damping [1/s].

    Attributes:
        totals: The cost of implicit steps: steps, linear solves, iterations of these, and steps with a solve that did
            not converge, int64 [4].
    """

    def __init__(
        self,
        model: newton.Model,
        tetrahedra: Tetrahedra,
        contacts: Contacts,
        others: Others,
        report: Report,
        damping: float,
    ):
        self.model, self.tetrahedra, self.contacts, self.others = model, tetrahedra, contacts, others
        self.report, self.damping, self.device = report, damping, model.device
        self._launch = partial(wp.launch, device=self.device)
        self._flushed = FlushedSubnormals(self.device)
        #: Bodies that others move go on in each substep, and other solvers may allocate memory.
        self._can_replay = not others.has_particles and not model.body_count
        self._f = self._empty(wp.vec4, model.particle_count)
        self.totals = wp.zeros(4, dtype=wp.int64, device=self.device)
        self._particles_before = [self._empty(wp.vec3, model.particle_count) for _ in range(2)]
        self._nothing = [self._empty(wp.vec3) for _ in range(2)]
        self._no_memory = kernels.Memory()
        #: Where particles' motions are and what they are, if they are solved for.
        self._motions = [self._empty(wp.int32), self._empty(wp.vec4)]
        self._body_f = self._empty(wp.spatial_vector, model.body_count)
        self._moved = SimpleNamespace(body_q=self._empty(wp.transform, model.body_count), body_qd=None)
        #: Bodies within a step: their solver never overwrites those before it.
        self._bodies_made = [self._empty(dtype, model.body_count) for dtype in (wp.transform, wp.spatial_vector)]

    def launch(self, step: Step, count: int, following: Following | None = None) -> None:
        """Launch a step of ``count`` substeps. A failure in one substep of a world undoes and ends the world's step.

        Args:
            step: The arguments of ``SolverCorotated.step``.
            count: Number of substeps.
            following: The measurement of the number needed; None: the number is fixed.
        """
        with self._flushed():
            self._launch_step(step, count, following)

    def _launch_step(self, step: Step, count: int, following: Following | None) -> None:
        state_in, state_out, dt = step.state_in, step.state_out, step.dt
        if step.reported is not None:
            step.reported.zero_()
        before = self._launch_begin(step)
        if self.others.has_bodies:
            made = with_changes(state_out, body_q=self._bodies_made[0], body_qd=self._bodies_made[1])
            step = step._replace(state_out=made)
        replays = Replays(self.device)
        now, number, left, done, each = state_in, 0, count, 0.0, dt / count
        while left:
            due = following is not None and following.is_due()
            if number and not due and left >= FEW and self._can_replay:
                # All substeps until the next measurement are alike.
                replays.launch(each, partial(self._launch_substep, step, now, each, before, following))
            else:
                copied = number == 0 and before is self._particles_before
                self._launch_gathering(now, state_in, number, copied)
                if due and following is not None:
                    following.measure(self.contacts.particles(now), dt - done, each)
                    if self.device.is_cpu and not self.device.is_capturing:
                        left = following.count_for(dt - done)
                        each = (dt - done) / left
                self._launch_substep(step, now, each, before, following, done, gathered=True)
            number, left, done = number + 1, left - 1, done + each
            now = step.state_out
        if self.others.has_bodies:
            inputs = [self.model.body_world, self.report.trouble, state_in.body_q, state_in.body_qd]
            outputs = [state_out.body_q, state_out.body_qd]
            self._launch(kernels.FINISH_BODIES, self.model.body_count, [*inputs, *self._bodies_made], outputs)
        self.tetrahedra.write_attributes(state_out)
        if following is not None:
            following.made = number
        self.report.launch()

    def _launch_substep(
        self,
        step: Step,
        now: newton.State,
        each: float,
        before: list,
        following: Following | None,
        done: float = 0.0,
        *,
        gathered: bool = False,
    ) -> None:
        """Launch a substep after some time of the step [s], from positions that have been gathered or are to be."""
        if not gathered:
            self._launch_gathering(now, step.state_in, 1, False)
        substep = step._replace(state_in=now, dt=each)
        self._launch_forces(substep, step.state_in, each / step.dt, done)
        self._launch_motion(substep, RUNAWAY if following is None else min(RUNAWAY, following.reach / each))
        if self.report.may_be_wrong:
            # Particles in the worlds with a failure are where they were.
            inputs = [self.model.particle_world, self.report.trouble, *before, *self._nothing]
            outputs = [step.state_out.particle_q, step.state_out.particle_qd]
            self._launch(kernels.FINISH_PARTICLES, self.model.particle_count, inputs, outputs)

    def reset(self, state: newton.State, mask: wp.array, flags: int) -> None:
        """Reset what this package steps in the chosen worlds of a state; see ``SolverCorotated.reset``."""
        kinds = [("particle", kernels.RESET_PARTICLES)] + [("body", kernels.RESET_BODIES)] * self.others.has_bodies
        for kind, kernel in kinds:
            names = (f"{kind}_q", f"{kind}_qd")
            initial = [getattr(self.model, name) for name in names]
            # Those that are not reset are left out.
            values = [getattr(state, name)[: None if flags & FLAGS[name] else 0] for name in names]
            inputs = [getattr(self.model, f"{kind}_world"), mask, *initial]
            self._launch(kernel, len(initial[0]), inputs, values)
        self.contacts.forget()
        if flags & newton.StateFlags.PARTICLE:
            self.tetrahedra.write_attributes(state)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _empty(self, dtype: Any, count: int = 0) -> wp.array:
        return wp.empty(count, dtype=dtype, device=self.device)

    def _launch_begin(self, step: Step) -> list[wp.array]:
        """Launch everything that is done once in a step.

        Returns:
            Particles before the step: those of ``state_in``, or copies if the step overwrites them.
        """
        model, state_in, state_out = self.model, step.state_in, step.state_out
        particles = [state_in.particle_q, state_in.particle_qd]
        if {array.ptr for array in particles} & {state_out.particle_q.ptr, state_out.particle_qd.ptr}:
            particles = self._particles_before
        if model.body_count:
            self._check_bodies(state_in, kernels.BAD_INPUT)
        self.contacts.begin(step)
        self._activation = model.tet_activations
        if step.control is not None and step.control.tet_activations is not None:
            self._activation = step.control.tet_activations
        self.tetrahedra.look_at(self._activation)
        return particles

    def _launch_gathering(self, now: newton.State, state_in: newton.State, number: int, copied: bool) -> None:
        """Gather external forces and positions of particles; these are copied if the step begins with them and
        overwrites them."""
        tets = self.tetrahedra
        # If the state was finite before, the step made it infinite.
        wrong = int(kernels.UNSTABLE if number else kernels.BAD_INPUT)
        inputs = [self.contacts.particles(now), state_in.particle_f, tets.rest, wrong]
        inputs += [self._no_memory if number else self.contacts.memory]
        outputs = [tets.u, self._f, *(self._particles_before if copied else self._nothing)]
        self._launch(kernels.gather_particles, self.model.particle_count, inputs, outputs)

    def _bodies_after(self, done: float, substep: Step, given: newton.State) -> newton.State:
        """The bodies after some time of the step [s].

        Bodies that another solver moves go on with their velocities: if they jumped by the motion of a step, stiff
        contacts would throw light particles.
        """
        if self.others.has_bodies:
            return substep.state_in
        if not (done and self.model.body_count):
            return given
        self._moved.body_qd = given.body_qd
        inputs = [done, self.contacts.bodies(given)]
        self._launch(kernels.move_bodies, self.model.body_count, inputs, [self._moved.body_q])
        return self._moved

    def _launch_forces(self, substep: Step, given: newton.State, share: float, done: float) -> None:
        """Launch all other forces on particles, and the particles' forces on bodies.

        Args:
            substep: From the present state.
            given: The state that the step began with.
            share: The substep's share of the step.
            done: Time of the step that has passed [s].
        """
        self.tetrahedra.add_forces(substep.state_in, self._activation, self._f)
        self.contacts.add_forces(substep, self._bodies_after(done, substep, given), self._f, share)
        self._launch_reactions(given, share)

    def _launch_reactions(self, given: newton.State, share: float) -> None:
        """Launch the particles' forces on bodies."""
        target = given.body_f
        if self.others.has_bodies:
            target, share = self._body_f, 1.0
            wp.copy(target, given.body_f)
        if self.model.body_count:
            inputs = [share, self.contacts.reactions, target]
            self._launch(kernels.add_wrenches, self.model.body_count, inputs)

    def _launch_motion(self, substep: Step, fastest: float) -> None:
        model, others, particles = self.model, self.others, self.contacts.particles(substep.state_in)
        now, out, dt = substep.state_in, substep.state_out, substep.dt
        count = self._steps_of_others(dt)
        part = substep._replace(dt=dt / count)
        for _ in range(count if others.has_bodies or others.has_particles else 0):
            others.step(part, self._body_f if others.has_bodies else now.body_f)
            part = part._replace(state_in=out)
        if others.has_particles:
            self._launch(kernels.add_changes, model.particle_count, [dt, particles, others.moved[1], self._f])
        inputs = [dt, self.damping, model.particle_max_velocity, fastest, particles, self._f, *self._motions]
        self._launch(kernels.step_particles, model.particle_count, inputs, [out.particle_q, out.particle_qd])
        if others.has_bodies:
            self._check_bodies(out, kernels.UNSTABLE)

    def _steps_of_others(self, dt: float) -> int:
        """Number of steps in which everything else makes a substep."""
        return 1

    def _check_bodies(self, state: newton.State, wrong: int) -> None:
        self._launch(kernels.check_bodies, self.model.body_count, [self.contacts.bodies(state), int(wrong)])


class Others:
    """Steps of everything besides tetrahedra: rigid bodies and joints, springs, triangles and bending edges.

    Another of Newton's solvers steps these, on a view of the model without tetrahedra.

    Args:
        model: The model.
        rigid_solver: "semi-implicit", a user's solver, or None: bodies do not move.
        particle_contact: Whether particles collide with one another.

    Attributes:
        has_particles: Whether particles are integrated here, because something besides tetrahedra acts on them.
        has_bodies: Whether bodies are integrated here.
        stiff: Springs, triangles and bending edges in small motions.
        is_own: Whether the bodies' solver is the one that is made here.
        contact: Stiffness [N/m] and damping [N s/m] of each contact between particles.
        moved: Particles as the solvers of bodies have moved them in the last step, without the forces of this package:
            positions and velocities, vec3 [P].
    """

    def __init__(self, model: newton.Model, rigid_solver: SolverBase | str | None, particle_contact: bool):
        self.is_own = own = rigid_solver == "semi-implicit"
        if not own and rigid_solver is not None and not isinstance(rigid_solver, SolverBase):
            raise InputError(f"rigid_solver is {rigid_solver!r}; it must be 'semi-implicit', a solver or None")
        self.model, self.device = model, model.device
        self._particle_contact = particle_contact
        if own or rigid_solver is None:
            _warn_of_ignored(model)
        self._triangles = triangles = bool(model.tri_count) and bool(np.any(model.tri_materials.numpy()))
        self._edges = edges = bool(model.edge_count) and bool(np.any(model.edge_bending_properties.numpy()))
        self.has_particles = bool(model.spring_count) or triangles or edges or particle_contact
        self.has_bodies = bool(model.body_count) and rigid_solver is not None
        self._rigid = rigid_solver if isinstance(rigid_solver, SolverBase) else None
        self._solver: SolverSemiImplicit | None = None
        if self.has_particles or (own and model.body_count):
            view = ModelView(model, "warp_corot_others")
            stays = {"tet_count": False, "tri_count": triangles, "edge_count": edges}
            stays |= {"particle_count": self.has_particles, "body_count": own, "joint_count": own}
            for name in (name for name, is_here in stays.items() if not is_here):
                setattr(view, name, 0)
            if not particle_contact:
                view.particle_grid = None
            elif model.device.is_cpu and model.particle_grid is not None:
                # About as many cells as particles: clearing Newton's two million would dominate a step.
                size = 2 ** math.ceil(math.log2(max(model.particle_count, 1)) / 3)
                view.particle_grid = wp.HashGrid(*3 * [min(max(size, 8), 128)], device=model.device)
            try:
                self._solver = SolverSemiImplicit(view, enable_tri_contact=False)
            except ValueError as error:
                raise InputError(f"{error} Give another rigid_solver, or None.") from None
        #: Copies of contacts without those of particles, by the original contacts.
        self._rigid_contacts: tuple[newton.Contacts, newton.Contacts] | None = None
        count = model.particle_count if self._solver is not None or self._rigid is not None else 0
        self._no_forces, *self.moved = (wp.zeros(count, dtype=wp.vec3, device=model.device) for _ in range(3))
        self.refresh()

    def refresh(self) -> None:
        """Read the current stiffness and damping of everything."""
        model = self.model
        acts = self._particle_contact and model.particle_grid is not None
        self.contact = (CONTACTS * model.particle_ke, CONTACTS * model.particle_kd) if acts else (0.0, 0.0)
        self.stiff = StiffParts(model, self._triangles, self._edges)

    def step(self, substep: Step, body_f: wp.array | None) -> None:
        """Make a step of bodies with the given wrenches, and of particles into ``moved``."""
        if self.has_particles:
            self._no_forces.zero_()  # Newton's solver adds its own
        now = with_changes(substep.state_in, particle_f=self._no_forces, body_f=body_f)
        out = with_changes(substep.state_out, particle_q=self.moved[0], particle_qd=self.moved[1])
        rigid = self._without_soft(substep.contacts)
        if self._solver is not None:
            self._solver.step(now, out, substep.control, rigid, substep.dt)
        if self._rigid is not None and self.has_bodies:
            self._rigid.step(now, out, substep.control, rigid, substep.dt)

    @property
    def solvers(self) -> list[SolverBase]:
        """The solvers that step all this."""
        return [solver for solver in (self._solver, self._rigid) if solver is not None]

    def _without_soft(self, contacts: newton.Contacts | None) -> newton.Contacts | None:
        if contacts is None:
            return None
        if self._rigid_contacts is None or self._rigid_contacts[0] is not contacts:
            self._rigid_contacts = contacts, with_changes(contacts, soft_contact_max=0)
        return self._rigid_contacts[1]


def _warn_of_ignored(model: newton.Model) -> None:
    """Warn, in one line, of parts of a model that nothing steps."""
    counts = {"tendons": model.tendon_count, "muscles": model.muscle_count}
    there = [f"{count} {name}" for name, count in counts.items() if count]
    if there:
        warnings.warn(
            f"the model has {' and '.join(there)}, which are ignored here; another rigid_solver may step them",
            UserWarning,
            stacklevel=4,
        )


def with_changes(given: Any, **changes: Any) -> Any:
    """An object with the same attributes but for some; faster than ``copy.copy``, since it is made in every substep."""
    made = object.__new__(type(given))
    made.__dict__.update(vars(given), **changes)
    return made


class Report:
    """Failures of the worlds of a model.

    Args:
        model: The model.

    Attributes:
        trouble: The failure of each world in the present step, and of what is in no world, int32 [worlds + 1]; see
            ``kernels.newton.particles``.
    """

    def __init__(self, model: newton.Model):
        self._model, self._device = model, model.device
        self.trouble = wp.zeros(max(int(model.world_count), 1) + 1, dtype=wp.int32, device=self._device)
        self._found = wp.zeros(kernels.REPORTS, dtype=wp.int32, device=self._device)
        #: Whether there is one, which the host can read without waiting.
        self._seen = Mapped(1, self._device)

    @property
    def may_be_wrong(self) -> bool:
        """Whether a world may have failed in the present step."""
        # On the CPU a check costs less than a launch; a recorded step must handle all cases.
        return self._device.is_cuda or self._device.is_capturing or bool(self.trouble.numpy().any())

    def launch(self) -> None:
        """Launch the kernel that stores the failures of a step, at its end."""
        if self.may_be_wrong:
            arguments = [self.trouble, self._found, self._seen.array]
            wp.launch(kernels.report_trouble, len(self.trouble), arguments, device=self._device)

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
        """See ``SolverCorotated.check``. After an unstable step there are more substeps if these follow the state."""
        report = self._found.numpy().copy()
        if not report.any():
            return
        self._found.zero_()
        self._seen.values[0] = 0.0
        worst = int(np.flatnonzero(report)[-1])
        world = int(report[worst]) - 1
        where = f" in world {world}" if self._model.world_count > 1 and world < self._model.world_count else ""
        if worst == int(kernels.BAD_INPUT):
            raise InputError(f"state_in is not finite{where}; state_out keeps its former values there")
        if worst in _NO_ROOM:
            raise InputError(f"there are more {_NO_ROOM[worst]}{where}; no step was made")
        hint = "" if stable_dt is None else f"; the largest stable step at rest is about {stable_dt:.3g} s"
        wrong = "not finite" if following is None else "not finite or beyond reason"
        if following is not None:
            following.share *= 0.5
            hint += "; from now on steps have twice the substeps, recorded ones when they are recorded again"
        raise UnstableError(f"the step's result is {wrong}{where}; that state was not changed{hint}")


class Recordings:
    """The states between which recordings lead.

    A graph keeps the addresses of the states. If a frame swaps two states an odd number of times, its replay reads the
    same old state again and again, unless the result is copied back.

    Args:
        device: The model's device.
    """

    def __init__(self, device: wp.Device):
        self._device, self._told = device, False
        self._begin: wp.array | None = None
        #: Where recordings begin, and where they end.
        self._ways: dict[int, tuple[wp.array, wp.array]] = {}

    def follow(self, state_in: newton.State, state_out: newton.State) -> None:
        """Follow a step, if it is recorded; the steps of a recording come one after the other."""
        if not self._device.is_capturing:
            self._begin = None
            return
        self._begin = state_in.particle_q if self._begin is None else self._begin
        self._ways[self._begin.ptr] = self._begin, state_out.particle_q

    def check(self) -> None:
        """Warn, once, of a recording whose result no recording reads; waits for the device."""
        lost = (way for way in self._ways.values() if way[1].ptr not in self._ways)
        if self._told or self._device.is_capturing or all(np.array_equal(a.numpy(), b.numpy()) for a, b in lost):
            return
        self._told = True
        warnings.warn(
            "recorded steps end in another state than that from which they begin, and nothing copies it back: each "
            "replay begins where the first one did; record an even number of swaps, or end the recording with "
            "state_in.assign(state_out)",
            UserWarning,
            stacklevel=depth_of_user(),
        )
