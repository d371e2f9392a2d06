"""``SolverCorotated``: corotational tetrahedra in any Newton scene."""

from __future__ import annotations

import math
import warnings
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_count, checked_number, refuse_tape, shown
from warp_corot.kernels.newton.rows import sum_by_shape
from warp_corot.simulation.energy import Solves

from .contact import Contacts
from .implicit import ImplicitSteps
from .library import CouplingInterface, ModelView, SolverBase, Step, newton
from .scene import STATE, attribute_of, register_custom_attributes
from .steps import Others, Recordings, Report, Steps
from .substeps import SAFETY, Following, stable_steps
from .tetrahedra import LAME, Tetrahedra

#: Factor by which a recorded substep may exceed the safe one; below the smallest margin of the safe substep.
EXCESS = 1.1
#: A step with more substeps would take minutes.
MOST_SUBSTEPS = 1_000_000
INTEGRATORS = ("explicit", "implicit")


class SolverCorotated(SolverBase, CouplingInterface):
    """Corotated linear elasticity for the tetrahedra of a Newton model, by symplectic Euler or backward Euler.

    Every tetrahedron has its own rotation (forests from ``add_forest`` may share rotations); the force is the
    gradient of W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I, for every F, inverted ones too. The solver
    adds ``k_damp`` as a viscosity that leaves rigid motion alone, ``Control.tet_activations`` as in Newton's other
    solvers (k_lambda a cof F), soft contacts with regularised Coulomb friction, attachments of particles to bodies,
    external forces, and gravity of each world. Particles without mass are kinematic, inactive ones frozen.

    Newton's ``SolverSemiImplicit`` steps rigid bodies, joints, rigid contacts, and springs, triangles and bending edges
    with stiffness, on a view of the model without tetrahedra; reactions of soft contacts and
    attachments act on the bodies in the same step. Contacts come from ``newton.CollisionPipeline``, whose
    ``soft_contact_gap`` should exceed any motion between two ``collide``: what is found late, deep in a shape, is let
    out at 0.25 m/s. Soft bodies and cloth collide with one another only on request.

    Substeps follow the state: every 64 substeps, two force evaluations find the current stiffness of the elements, and
    their strains and strain rates tell how soon it may change; where shapes may be met, no particle goes farther in a
    substep than half the smallest element. All worlds share the substep. On the CPU a step uses
    a measurement at once; on CUDA, where it does not wait, a later step does. A recorded step has the substeps that
    it needed when it was recorded, and at least half as many more as at rest; ``check`` warns if these were too few.

    A world is stepped completely or not at all: if a value is not finite, or a particle moves farther in a substep
    than the largest body is long, the state of the world stays unchanged. On the CPU ``step`` then raises an error; on
    CUDA, where the world has missed a step by then, ``check`` does, and a later ``step`` only warns unless substeps are
    given. If they are not, all later steps have twice as many. There are no gradients.

    With ``integrator="implicit"`` a step is one step of backward Euler, or ``substeps`` of them, stable at any length.
    Elastic forces are linearised once; contacts, attachments and damping are those of the end of the step. These forces
    and the motion of the bodies on which they act are found together; in that solve only these forces, gravity and
    given forces act on the bodies. The semi-implicit solver of bodies then takes steps of at most 0.5 ms. Only
    tetrahedra are implicit: models with springs, cloth or bending edges of any stiffness, ``particle_contact`` and
    ``self_contact_margin`` are refused.

    Newton's positions are float32, and small motions vanish in their rounding. An undamped beam of 19 cm, 5 kPa and
    1000 kg/m^3 with initial velocity v = a (z/L)^2 keeps its energy to 1 % over 20,000 steps down to a = 0.012 m/s; at
    1 mm/s its energy doubles. ``Simulation`` stores displacements and does better.

    Example::

        solver = warp_corot.newton.SolverCorotated(model)
        solver.step(state_in, state_out, control, contacts, dt)

    Args:
        model: A model with tetrahedra.
        lame: Meaning of k_mu and k_lambda: "documented", Lamé's parameters, as in Newton's documentation; or
            "semi-implicit", their effect in ``SolverSemiImplicit`` for small strains: mu = 3/4 k_mu,
            lambda = k_lambda - 5/8 k_mu.
        damping: Rate of mass-proportional damping [1/s], besides k_damp.
        integrator: "explicit", symplectic Euler, or "implicit", backward Euler.
        substeps: Number of substeps of a step; None: as many as the current state needs to be stable, see
            ``safe_dt``; with ``integrator="implicit"``, one.
        rotation_level: Level of shared rotations in forests; see ``Corotated``.
        rigid_solver: The solver of rigid bodies: "semi-implicit"; another solver, made for this model, which also gets
            their forces; or None: no solver, and reactions are added to ``state_in.body_f`` for another program, which
            moves the bodies. If another program moves them in spite of a solver given here, both do.
        particle_contact: Whether particles collide with one another, as in ``SolverSemiImplicit``. Newton's default
                radius of 0.1 m makes the particles of finer meshes repel one another.
        self_contact_margin: Distance [m] at which the surfaces of soft bodies and cloth begin to push one another and
            themselves, like ``margin`` of ``CollisionPipeline.init_soft_self_contact``, which finds the pairs; None:
            they pass through one another.
        stable_dt: The largest stable step [s], if known; None: found from elements and masses.
        cuts: None: a cut makes new particles, but the number of a model's particles is fixed. ``Simulation`` cuts.

    Attributes:
        stable_dt: The largest stable step about rest [s], of tetrahedra, springs, triangles (cloth) and bending edges
                with their damping. It excludes joints, and so do ``contact_dt`` and ``substeps=None``. Contacts with
                shapes and attachments of any stiffness need no shorter steps.
        contact_dt: The same [s]; with ``particle_contact``, with contacts between particles.

    Raises:
        InputError: No tetrahedra, a material that is not positive definite, or an option out of its range.
    """

    SUPPORTED_OBSERVABLES = frozenset({SolverBase.ObservableKind.CONTACT_F})

    def __init__(
        self,
        model: newton.Model,
        *,
        lame: str = "documented",
        damping: float = 0.0,
        integrator: str = "explicit",
        substeps: int | None = None,
        rotation_level: int | None = None,
        rigid_solver: SolverBase | str | None = "semi-implicit",
        particle_contact: bool = False,
        self_contact_margin: float | None = None,
        stable_dt: float | None = None,
        cuts: None = None,
    ):
        _check_options(model, lame, damping, integrator, substeps, stable_dt, self_contact_margin, cuts)
        super().__init__(model)
        self._substeps = None if substeps is None else int(substeps)
        self._given_stable_dt = stable_dt
        self.tetrahedra = Tetrahedra(model, lame, rotation_level)
        self._others = Others(model, rigid_solver, particle_contact)
        self._report, self._recordings = Report(model), Recordings(self.device)
        self._contacts = Contacts(model, self._report, self_contact_margin, moves=self._others.has_bodies)
        self._is_implicit = integrator == "implicit"
        parts = (model, self.tetrahedra, self._contacts, self._others, self._report, damping)
        self._steps = ImplicitSteps(*parts) if self._is_implicit else Steps(*parts)
        follows = substeps is None and not self._is_implicit
        self._following = Following(model, self.tetrahedra) if follows else None
        self._shape_wrenches = wp.zeros(model.shape_count, dtype=wp.spatial_vectorf, device=self.device)
        self._all_worlds = wp.ones(max(int(model.world_count), 1) + 1, dtype=wp.bool, device=self.device)
        self._seen: list[np.ndarray] = []
        self._has_changed()
        self._find_stable_steps()

    @property
    def substeps(self) -> int | None:
        """Number of substeps of a step; None if it follows the state."""
        return self._substeps

    @property
    def safe_dt(self) -> float:
        """The current substep of ``substeps=None`` [s]; on CUDA the value known without waiting.

        At rest 0.9 of ``contact_dt``; shorter if elements are stiffer, or strained so much that they may soon be.
        With given substeps it stays 0.7 of ``contact_dt``. It is infinite with ``integrator="implicit"``.
        """
        if self._is_implicit:
            return math.inf
        return SAFETY * self.contact_dt if self._following is None else self._following.substep

    @property
    def recorded_dt(self) -> float:
        """The longest step that would be recorded with a single substep now [s]."""
        return self.safe_dt if self._following is None else self._following.recorded_substep

    @property
    def substeps_made(self) -> int:
        """Number of substeps of the last step that was launched or recorded."""
        return self._substeps or 1 if self._following is None else self._following.made

    @property
    def solves(self) -> Solves:
        """The cost of implicit steps so far; waits for the device. All zero with ``integrator="explicit"``."""
        return Solves(*(int(count) for count in self._steps.totals.numpy()))

    def shape_wrenches(self, contacts: newton.Contacts, observables: Any) -> wp.array:
        """Launch the sums of the soft contacts' mean wrenches in a step, and give them, spatial_vector [S].

        ``contact_f`` of ``observables`` has those of single contacts, from entry ``contacts.rigid_contact_max`` on.

        Args:
            contacts: The contacts of the step.
            observables: The container that the step wrote, made with ``{"contact_f"}``.

        Returns:
            Of each shape, on its body [N, N m]; an array that the next call uses again.

        Raises:
            InputError: The container has no contact forces, or those of other contacts.
        """
        wrenches = getattr(observables, "contact_f", None)
        if wrenches is None or observables.contacts is not contacts:
            raise InputError(
                "observables has no contact_f of these contacts: make it by solver.observables({'contact_f'}, "
                "contacts=contacts) and give it to solver.step"
            )
        self._shape_wrenches.zero_()
        inputs = [contacts.soft_contact_count, contacts.soft_contact_shape, contacts.rigid_contact_max, wrenches]
        outputs = [self._shape_wrenches]
        wp.launch(sum_by_shape, contacts.soft_contact_max, inputs, outputs, device=self.device)
        return self._shape_wrenches

    @property
    def body_reactions(self) -> wp.array:
        """Wrenches of soft contacts and attachments on the bodies in the last substep [N, N m], spatial_vector [B]."""
        return self._contacts.reactions

    def step(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
        dt: float,
        *,
        observables: Any = None,
    ) -> None:
        """Step from one state to the other, which may be the same.

        Forces in ``state_in`` act throughout the step and are not changed. The step only launches kernels and may be
        captured.

        Args:
            state_in, state_out: States of the model.
            control: Activations and joint controls; None: the model's.
            contacts: The result of ``newton.CollisionPipeline``; None: no contact.
            dt: Time step [s].
            observables: None, or a container of this solver, whose ``contact_f`` gets the mean wrenches of soft
                contacts in the step; those of rigid contacts, which another solver finds, are zero. A wrench acts on
                the shape's body, about its centre of mass, or about the origin if the shape has no body.

        Raises:
            InputError: A time step that is not stable, arrays on another device, or states without attributes that the
                solver needs; then nothing was launched. On the CPU, except in a capture, also: a state that is not
                finite, or more contacts than the buffer holds; as in ``check``.
            UnstableError: On the CPU, except in a capture: the step's result is not finite.
        """
        refuse_tape()
        self.validate_observables(observables, contacts)
        reported = None if observables is None else observables.contact_f
        step, following = Step(state_in, state_out, control, contacts, dt, reported), self._following
        _check_step(step, self.model)
        self._report.check_earlier(following)
        count = self._count_for(dt)
        self._steps.launch(step, count, following)
        self._recordings.follow(state_in, state_out)
        if self.device.is_cpu and not self.device.is_capturing:
            self.check()

    def check(self) -> None:
        """Report errors since the last call, and warn of recorded steps with too few substeps, and of recordings whose
        replays do not go on from one another.

        Waits for the device.

        Worlds with an error keep their former state. If the state handed in for a world was not finite,
        ``state_out`` keeps its former values there.

        Raises:
            InputError: Invalid states or contacts were handed in.
            UnstableError: A step's result was not finite, or beyond reason.
        """
        excess = 0.0 if self._following is None else self._following.take_excess()
        if excess > EXCESS:
            warnings.warn(
                f"a recorded step has too few substeps: {excess:.2g} times as many would be safe; "
                "record it again in the current state, or give SolverCorotated more substeps",
                UserWarning,
                stacklevel=2,
            )
        self._recordings.check()
        self._report.check(self.stable_dt, self._following)
        if self._following is not None and self._following.was_recorded:
            self._following.recover()

    def reset(
        self,
        state: newton.State,
        world_mask: wp.array | None = None,
        flags: int | None = None,
    ) -> None:
        """Reset chosen worlds of a state to the model's initial state, rotations and stresses included.

        Args:
            state: The state, changed in place.
            world_mask: bool [world_count + 1], the last entry for things in no world; None: all.
            flags: ``newton.StateFlags`` of what is reset: PARTICLE_Q, PARTICLE_QD, and, if this solver steps the
                bodies, BODY_Q and BODY_QD; None: all.
        """
        mask = self._all_worlds if world_mask is None else _checked_mask(world_mask, self.model)
        self._steps.reset(state, mask, int(newton.StateFlags.ALL if flags is None else flags))
        for solver in self._others.solvers:
            solver.reset(state, world_mask, flags)

    def write_attributes(self, state: newton.State) -> None:
        """Write rotations and stresses for a state's positions into it; ``step`` does so for ``state_out``.

        Use it for states that this solver does not write, for example those of Newton's coupled solvers.
        """
        self.tetrahedra.write_attributes(state)

    def notify_model_changed(self, flags: int) -> None:
        """Read changes of the model; stable steps are found again if they may have changed.

        ``ModelFlags.MODEL_PROPERTIES`` stands for changed materials of elements or masses, ``CONSTRAINT_PROPERTIES``
        for changed stiffness of attachments. Every step reads gravity, activations and forces of contact from the
        model. This waits for the device, except in a capture, in which materials are not updated.

        Raises:
            InputError: As in the constructor.
        """
        for solver in self._others.solvers:
            solver.notify_model_changed(flags)
        if self.device.is_capturing:
            return
        bits = newton.ModelFlags
        if flags & (bits.CONSTRAINT_PROPERTIES | bits.MODEL_PROPERTIES):
            self._contacts.refresh()
        if flags & bits.MODEL_PROPERTIES and self._has_changed():
            self.tetrahedra.refresh()
            self._others.refresh()
            self._find_stable_steps()

    @classmethod
    def register_custom_attributes(cls, builder: newton.ModelBuilder) -> None:
        """See ``warp_corot.newton.register_custom_attributes``."""
        register_custom_attributes(builder)

    def coupling_supports_inertial_property_refresh(self) -> bool:
        """True: every step reads masses from the model."""
        return True

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _has_changed(self) -> bool:
        """Whether materials of elements or masses differ from those of the last call."""
        model, before = self.model, self._seen
        arrays = [model.tet_materials, model.particle_inv_mass, model.spring_stiffness, model.spring_damping]
        arrays += [model.tri_materials, model.edge_bending_properties]
        self._seen = [np.array([model.particle_ke, model.particle_kd])]
        self._seen += [array.numpy().copy() for array in arrays if array is not None]
        return len(before) != len(self._seen) or not all(map(np.array_equal, before, self._seen))

    def _find_stable_steps(self) -> None:
        given = self._given_stable_dt
        if given is None:
            self.stable_dt, self.contact_dt = stable_steps(self.tetrahedra, self._others.stiff, self._others.contact)
        else:
            self.stable_dt = self.contact_dt = float(given)
        if self._following is not None:
            self._following.find_rest(self.contact_dt)

    def _count_for(self, dt: float) -> int:
        """Number of substeps of a step of dt [s]."""
        if isinstance(dt, bool) or not 0.0 < checked_number(dt, "dt", "s") < math.inf:
            raise InputError(f"dt is {dt!r}; it must be a positive number of seconds")
        dt, count = float(dt), self._substeps or 1
        if self._following is not None:
            count = self._following.count_for(dt)
            if count > MOST_SUBSTEPS:
                substeps = f"{count:.2g} substeps of {dt / count:.3g} s"
                raise InputError(f"dt is {dt:g} s, which takes {substeps}; take a step of less time")
        elif not self._is_implicit and dt / count > self.stable_dt:
            each = f", {count} substeps of {dt / count:.3g} s" if count > 1 else ""
            needed = math.ceil(dt / (SAFETY * self.contact_dt))
            raise InputError(
                f"dt is {dt:.3g} s{each}; the largest stable step is about {self.stable_dt:.3g} s: "
                f"make shorter steps, or SolverCorotated(..., substeps={needed}), or substeps=None"
            )
        return count


# --- checks of arguments ---------------------------------------------------------------------------------------------


def _check_options(
    model: Any, lame: Any, damping: Any, integrator: Any, substeps: Any, stable_dt: Any, margin: Any, cuts: Any
) -> None:
    """Check the options of ``SolverCorotated``."""
    if not isinstance(model, newton.Model | ModelView):
        raise InputError(f"model is {_named(model)}; it must be a newton.Model, the result of builder.finalize()")
    if cuts is not None:
        raise InputError(
            "cuts is given, but a cut makes new particles, and the number of a Newton model's particles is fixed; "
            "warp_corot.Simulation(..., cuts=[blade]) cuts"
        )
    checked_choice(lame, "lame", LAME)
    checked_choice(integrator, "integrator", INTEGRATORS)
    if not 0.0 <= checked_number(damping, "damping", "1/s") < math.inf:
        raise InputError(f"damping is {damping!r}; it must be zero or a positive rate in 1/s")
    if substeps is not None:
        checked_count(substeps, "substeps", 1)
    if stable_dt is not None and not checked_number(stable_dt, "stable_dt", "s") > 0.0:
        raise InputError(f"stable_dt is {stable_dt!r}; it must be a positive number of seconds or None")
    if margin is None:
        return
    if not 0.0 < checked_number(margin, "self_contact_margin", "m") < math.inf:
        raise InputError(f"self_contact_margin is {margin!r}; it must be a positive distance in m or None")
    if integrator == "implicit":
        raise InputError(
            "self_contact_margin is given, and integrator is 'implicit', in whose steps soft bodies do not touch one "
            "another: use integrator='explicit', or no self_contact_margin"
        )


def _check_step(step: Step, model: newton.Model) -> None:
    """Check that the arguments of ``SolverCorotated.step`` except dt belong to the model and are on its device."""
    found, control, contacts = [], step.control, step.contacts
    for name, state in (("state_in", step.state_in), ("state_out", step.state_out)):
        if getattr(state, "particle_q", model) is model:
            raise InputError(f"{name} is {_named(state)}; it must be a newton.State, the result of model.state()")
        found.append((name, state.particle_q, "particles", model.particle_count))
        found += [(name, attribute_of(state, each), f"warp_corot.{each}", model.tet_count) for each in STATE]
    if control is not None:
        found.append(("control", control.tet_activations, "tet_activations", model.tet_count))
    for name, array, what, count in found:
        has = 0 if array is None else len(array)
        if has != count and (array is not None or what == "particles"):
            raise InputError(f"{name} has {has} {what}; the model has {count}")
        if getattr(array, "device", model.device) != model.device:
            raise InputError(f"{name} is on {array.device}; the model is on {model.device}")
    if contacts is not None and contacts.soft_contact_max and contacts.soft_contact_count.device != model.device:
        raise InputError(f"contacts are on {contacts.soft_contact_count.device}; the model is on {model.device}")


def _checked_mask(world_mask: Any, model: newton.Model) -> wp.array:
    """A mask of worlds, bool [world_count + 1], on the model's device."""
    shape = (model.world_count + 1,)
    fits = isinstance(world_mask, wp.array) and world_mask.dtype == wp.bool and world_mask.shape == shape
    if not fits or world_mask.device != model.device:
        raise InputError(
            f"world_mask is {shown(world_mask)}; it must be bool [{shape[0]}], a Warp array on {model.device}"
        )
    return world_mask


def _named(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
