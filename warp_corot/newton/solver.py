"""``SolverCorotated``: corotational tetrahedra in any Newton scene."""

from __future__ import annotations

import math
import warnings
from numbers import Real
from typing import Any

import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import refuse_tape

from .contact import Contacts
from .following import Following
from .library import CouplingInterface, ModelView, SolverBase, newton
from .others import Others
from .stability import stable_step
from .state import STATE, attribute_of, register_custom_attributes
from .steps import Step, Steps
from .tetrahedra import LAME, Tetrahedra

#: Fraction of the largest stable step that errors suggest: elements stiffen when strained.
SAFETY = 0.7

#: Factor by which a recorded substep may exceed the safe one; below the smallest margin of the safe substep.
EXCESS = 1.1

ROTATIONS = ("byers-xu", "warm")


class SolverCorotated(SolverBase, CouplingInterface):
    """Corotated linear elasticity for the tetrahedra of a Newton model, by symplectic Euler.

    Every tetrahedron has its own rotation (forests from ``add_forest`` may share rotations); the force is the
    gradient of W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I, for every F, inverted ones too. The solver
    adds ``k_damp`` as a viscosity that leaves rigid motion alone, ``Control.tet_activations`` as in Newton's other
    solvers (k_lambda a cof F), soft contacts with regularised Coulomb friction, attachments of particles to bodies,
    external forces, and gravity of each world. Particles without mass are kinematic, inactive ones frozen.

    Newton's ``SolverSemiImplicit`` steps rigid bodies, joints, rigid contacts, and springs, triangles and bending edges
    with stiffness, on a view of the model without tetrahedra; reactions of soft contacts and
    attachments act on the bodies in the same step. Contacts come from ``newton.CollisionPipeline``, whose
    ``soft_contact_gap`` should exceed any motion between two ``collide``: contacts found late start with deep
    penetration and can launch light bodies. Soft bodies and cloth collide with one another only on request.

    Substeps follow the state: every 64 substeps, two force evaluations find the current stiffness of the elements, and
    their strains and strain rates tell how soon it may change. All worlds share the substep. On the CPU a step uses
    a measurement at once; on CUDA, where it does not wait, a later step does. A recorded step has the substeps that
    it needed when it was recorded, and at least half as many more as at rest; ``check`` warns if these were too few.

    A world is stepped completely or not at all: if a value is not finite, or a particle moves farther in a substep
    than the largest body is long, the state of the world stays unchanged. On the CPU the step is then repeated with up
    to 16 times the substeps, and ``step`` reports if that does not help. On CUDA, where the world has missed a step by
    then, a later ``step`` warns and uses twice the substeps; ``check`` raises an error. With given substeps it is an
    error at once, on CUDA from a later ``step`` or ``check``. There are no gradients.

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
        substeps: Number of substeps of a step; None: as many as the current state needs to be stable, see
            ``safe_dt``.
        rotation: "byers-xu", or "warm": starting from the rotation in the state, ``state.warp_corot.rotation``, so that
            it is continuous in time for inverted elements, too. This needs ``register_custom_attributes``, and the
            tetrahedra of forests are then computed one by one.
        rotation_level: Level of shared rotations in forests; see ``Corotated``.
        rigid_solver: The solver of rigid bodies: "semi-implicit"; another solver, made for this model, which also gets
            their forces; or None: no solver, and reactions are added to ``state_in.body_f`` for another program.
        particle_contact: Whether particles collide with one another, as in ``SolverSemiImplicit``. Newton's default
                radius of 0.1 m makes the particles of finer meshes repel one another.
        self_contact_margin: Distance [m] at which the surfaces of soft bodies and cloth begin to push one another and
            themselves, like ``margin`` of ``CollisionPipeline.init_soft_self_contact``, which finds the pairs; None:
            they pass through one another.
        stable_dt: The largest stable step [s], if known; None: found from elements and masses.

    Attributes:
        stable_dt: The largest stable step about rest [s], of tetrahedra, springs, triangles (cloth) and bending edges
                with their damping. It excludes joints, and so do ``contact_dt`` and ``substeps=None``.
        contact_dt: The same with a contact or an attachment at every particle [s], with the largest stiffness here and
            the lightest rigid body at its other end; with ``particle_contact``, also contacts with other particles.

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
        substeps: int | None = None,
        rotation: str = "byers-xu",
        rotation_level: int | None = None,
        rigid_solver: SolverBase | str | None = "semi-implicit",
        particle_contact: bool = False,
        self_contact_margin: float | None = None,
        stable_dt: float | None = None,
    ):
        if not isinstance(model, newton.Model) and not isinstance(model, ModelView):
            raise InputError(f"model is {_named(model)}; it must be a newton.Model, the result of builder.finalize()")
        if not isinstance(lame, str) or lame not in LAME:
            raise InputError(f"lame is {lame!r}; it must be one of {', '.join(LAME)}")
        if not isinstance(rotation, str) or rotation not in ROTATIONS:
            raise InputError(f"rotation is {rotation!r}; it must be one of {', '.join(ROTATIONS)}")
        if not (_is_finite(damping) and damping >= 0):
            raise InputError(f"damping is {damping!r}; it must be zero or a positive rate in 1/s")
        if substeps is not None and not (_is_finite(substeps) and substeps == int(substeps) and substeps >= 1):
            raise InputError(f"substeps is {substeps!r}; it must be a positive whole number or None")
        if stable_dt is not None and not (isinstance(stable_dt, Real) and stable_dt > 0):
            raise InputError(f"stable_dt is {stable_dt!r}; it must be a positive number of seconds or None")
        if self_contact_margin is not None and not (_is_finite(self_contact_margin) and self_contact_margin > 0):
            raise InputError(
                f"self_contact_margin is {self_contact_margin!r}; it must be a positive distance in m or None"
            )
        super().__init__(model)
        self._substeps = None if substeps is None else int(substeps)
        self._given_stable_dt = stable_dt
        self.tetrahedra = Tetrahedra(model, lame, rotation == "warm", rotation_level)
        self._contacts = Contacts(model, self_contact_margin)
        self._others = Others(model, rigid_solver, particle_contact)
        self._steps = Steps(model, self.tetrahedra, self._contacts, self._others, damping)
        self._following = Following(model, self.tetrahedra) if substeps is None else None
        self._all_worlds = wp.ones(max(int(model.world_count), 1) + 1, dtype=wp.bool, device=self.device)
        self._find_stable_steps()

    @property
    def substeps(self) -> int | None:
        """Number of substeps of a step; None if it follows the state."""
        return self._substeps

    @property
    def safe_dt(self) -> float:
        """The current substep of ``substeps=None`` [s]; on CUDA the value known without waiting.

        At rest 0.9 of ``contact_dt``; shorter if elements are stiffer, or strained so much that they may soon be.
        With given substeps it stays 0.7 of ``contact_dt``.
        """
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
                finite, or more contacts than the buffer holds; as in ``check``. In a recording: contacts of edges
                and triangles that no step before had.
            UnstableError: On the CPU, except in a capture: the step's result is not finite.
        """
        refuse_tape()
        self.validate_observables(observables, contacts)
        self._check_arguments(state_in, state_out, control, contacts)
        following = self._following
        self._steps.check_earlier(following)
        self._see_surfaces(contacts)
        reported = None if observables is None else observables.contact_f
        step, count = Step(state_in, state_out, control, contacts, dt, reported), self._count_for(dt)
        if following is not None and self.device.is_cpu and not self.device.is_capturing:
            self._steps.launch_retried(step, following)
        else:
            self._steps.launch(step, count, following)
        if self.device.is_cpu and not self.device.is_capturing:
            self.check()

    def check(self) -> None:
        """Report errors since the last call, and warn of recorded steps with too few substeps.

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
        self._steps.check(self.stable_dt, self._following)
        if self._following is not None and self._following.was_recorded:
            self._following.recover()

    def reset(
        self,
        state: newton.State,
        world_mask: wp.array | None = None,
        flags: int | None = None,
    ) -> None:
        """Reset chosen worlds of a state to the model's initial state, rotations included.

        Args:
            state: The state, changed in place.
            world_mask: bool [world_count + 1], the last entry for things in no world; None: all.
            flags: ``newton.StateFlags`` of what is reset: PARTICLE_Q, PARTICLE_QD, and, if this solver steps the
                bodies, BODY_Q and BODY_QD; None: all.
        """
        mask = self._all_worlds if world_mask is None else self._checked_mask(world_mask)
        self._steps.reset(state, mask, int(newton.StateFlags.ALL if flags is None else flags))
        self._others.reset(state, world_mask, flags)

    def write_attributes(self, state: newton.State) -> None:
        """Write rotations and stresses for a state's positions into it; ``step`` does so for ``state_out``.

        Use it for states that this solver does not write, for example those of Newton's coupled solvers.
        """
        self.tetrahedra.write_attributes(state, state)

    def notify_model_changed(self, flags: int) -> None:
        """Read changes of the model; stable steps are found again if they may have changed.

        ``ModelFlags.MODEL_PROPERTIES`` stands for changed materials of elements or masses; ``SHAPE_PROPERTIES`` and
        ``CONSTRAINT_PROPERTIES`` for changed stiffness of contacts and attachments. Every step reads gravity,
        activations and forces of contact from the model. This waits for the device, except in a capture, in which
        materials are not updated.

        Raises:
            InputError: As in the constructor.
        """
        self._others.notify_model_changed(flags)
        if self.device.is_capturing:
            return
        bits = newton.ModelFlags
        elements, before = False, (self._contacts.stiffest, self._contacts.lightest)
        if flags & bits.MODEL_PROPERTIES:
            changed = [self.tetrahedra.refresh(), self._others.refresh()]
            elements = any(changed)
        of_contacts = bits.SHAPE_PROPERTIES | bits.CONSTRAINT_PROPERTIES | bits.MODEL_PROPERTIES
        if flags & (of_contacts | bits.BODY_PROPERTIES | bits.BODY_INERTIAL_PROPERTIES):
            self._contacts.refresh()
        if elements or (self._contacts.stiffest, self._contacts.lightest) != before:
            self._find_stable_steps()

    @classmethod
    def register_custom_attributes(cls, builder: newton.ModelBuilder) -> None:
        """See ``warp_corot.newton.register_custom_attributes``."""
        register_custom_attributes(builder)

    def coupling_supports_inertial_property_refresh(self) -> bool:
        """True: every step reads masses from the model."""
        return True

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _find_stable_steps(self) -> None:
        tets, others, contacts = self.tetrahedra, self._others, self._contacts
        given = self._given_stable_dt
        self.stable_dt = self.contact_dt = stable_step(tets, others) if given is None else float(given)
        stiffness, damping = others.contact
        stiffness += contacts.stiffest
        if given is None and (stiffness > 0 or damping > 0):
            of_bodies = contacts.stiffest * contacts.lightest
            self.contact_dt = min(self.stable_dt, stable_step(tets, others, stiffness, damping, of_bodies))
        if self._following is not None:
            self._following.find_rest(self.contact_dt)

    def _see_surfaces(self, contacts: newton.Contacts | None) -> None:
        """Count the stiffness of contacts of edges and triangles in the stable step from the first time on."""
        if contacts is None or not self._contacts.has_surfaces(contacts):
            return
        if self.device.is_capturing:
            raise InputError(
                "contacts hold contacts of edges and triangles for the first time, and a step that is being recorded "
                "cannot find the substeps for them: make one step with these contacts before the recording"
            )
        self._contacts.crowded = True
        self._contacts.refresh()
        self._find_stable_steps()

    def _count_for(self, dt: float) -> int:
        if not (_is_finite(dt) and dt > 0):
            raise InputError(f"dt is {dt!r}; it must be a positive number of seconds")
        if self._following is not None:
            return self._following.count_for(dt)
        count = self._substeps or 1
        if dt / count > self.stable_dt:
            each = f", {count} substeps of {dt / count:.3g} s" if count > 1 else ""
            needed = math.ceil(dt / (SAFETY * self.contact_dt))
            raise InputError(
                f"dt is {dt:.3g} s{each}; the largest stable step is about {self.stable_dt:.3g} s: "
                f"make shorter steps, or SolverCorotated(..., substeps={needed}), or substeps=None"
            )
        return count

    def _check_arguments(
        self,
        state_in: newton.State,
        state_out: newton.State,
        control: newton.Control | None,
        contacts: newton.Contacts | None,
    ) -> None:
        model = self.model
        for name, state in (("state_in", state_in), ("state_out", state_out)):
            if getattr(state, "particle_q", self) is self:
                raise InputError(f"{name} is {_named(state)}; it must be a newton.State, the result of model.state()")
            if state.particle_q is None or len(state.particle_q) != model.particle_count:
                there = 0 if state.particle_q is None else len(state.particle_q)
                raise InputError(f"{name} has {there} particles; the model has {model.particle_count}")
            if state.particle_q.device != self.device:
                raise InputError(f"{name} is on {state.particle_q.device}; the model is on {self.device}")
            if self.tetrahedra.warm and attribute_of(state, "rotation") is None:
                raise InputError(
                    f"{name} has no rotations, which rotation='warm' needs: call "
                    "SolverCorotated.register_custom_attributes(builder) before finalize"
                )
            for attribute in STATE:
                array = attribute_of(state, attribute)
                if array is not None and len(array) != model.tet_count:
                    raise InputError(f"{name} has {attribute} of {len(array)} tetrahedra; there are {model.tet_count}")
        if control is not None and control.tet_activations is not None:
            if len(control.tet_activations) != model.tet_count:
                raise InputError(
                    f"control has {len(control.tet_activations)} tet_activations; there are {model.tet_count}"
                )
            if control.tet_activations.device != self.device:
                raise InputError(f"control is on {control.tet_activations.device}; the model is on {self.device}")
        if contacts is not None and contacts.soft_contact_max and contacts.soft_contact_count.device != self.device:
            raise InputError(f"contacts are on {contacts.soft_contact_count.device}; the model is on {self.device}")

    def _checked_mask(self, world_mask: wp.array) -> wp.array:
        wanted = f"it must be bool [{self.model.world_count + 1}] on {self.device}"
        if not isinstance(world_mask, wp.array):
            raise InputError(f"world_mask is {world_mask!r}; {wanted}")
        right = world_mask.dtype == wp.bool and world_mask.shape == (self.model.world_count + 1,)
        if not right or world_mask.device != self.device:
            found = f"{world_mask.dtype.__name__} {list(world_mask.shape)} on {world_mask.device}"
            raise InputError(f"world_mask is {found}; {wanted}")
        return world_mask


def _is_finite(value: Any) -> bool:
    """Whether a value is a finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _named(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
