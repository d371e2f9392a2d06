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
from .steps import Steps
from .tetrahedra import LAME, Tetrahedra

#: Share of the largest stable step that errors suggest: elements stiffen when strained.
SAFETY = 0.7

#: By what factor a recorded substep may be longer than is safe, less than the smallest margin of what is safe.
EXCESS = 1.1

ROTATIONS = ("byers-xu", "warm")


class SolverCorotated(SolverBase, CouplingInterface):
    """Corotated linear elasticity for the tetrahedra of a Newton model, by symplectic Euler.

    Every tetrahedron has its own rotation (forests added by ``add_forest``: also a shared one); the force is the
    gradient of W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(R^T F) - I, for every F, inverted ones too. Added to it:
    ``k_damp`` as a viscosity that leaves rigid motion alone, ``Control.tet_activations`` as Newton's other solvers
    have them (k_lambda a cof F), soft contacts with regularised Coulomb friction, attachments of particles to bodies,
    external forces, and gravity of each world. Particles without mass are kinematic, those that are not active frozen.

    Rigid bodies, joints and rigid contacts, and springs, triangles and bending edges with stiffness, are stepped along
    by Newton's ``SolverSemiImplicit`` on a view of the model without tetrahedra; reactions of soft contacts and
    attachments act on the bodies in the same step. Contacts come from ``newton.CollisionPipeline``, whose
    ``soft_contact_gap`` should exceed what anything goes between two ``collide``: what is found late is deep by then,
    and throws light bodies out. Particles do not collide with one another unless asked to, soft bodies not with
    themselves.

    Substeps follow the state: every 64 of them, two force evaluations find how stiff the elements are now, and their
    strains and strain rates tell how soon that may change. All worlds share the substep. On the CPU a step takes up
    what it finds at once; on CUDA, where it waits for nothing, a later step does. A recorded step has the substeps that
    it needed when it was recorded, and at least half as many more as at rest; ``check`` warns where that was too few.

    A step is taken for a world or not at all: where something is not finite, or a particle moves farther in a substep
    than the largest body is long, the state stays what it was. On the CPU the step is then tried again, with up to 16
    times the substeps, and ``step`` says so if that does not help. On CUDA, where the world has stood still for a step
    by then, a later ``step`` warns, and has twice the substeps; ``check`` raises an error. With given substeps it is an
    error at once, on CUDA from a later ``step`` or ``check``. There are no gradients.

    Newton's positions are float32, and small motions drown in their rounding. An undamped beam of 19 cm, 5 kPa and
    1000 kg/m^3, set off with v = a (z/L)^2, keeps its energy to 1 % over 20,000 steps down to a = 0.012 m/s; at
    1 mm/s it doubles it. ``Simulation`` holds displacements, and does better.

    Example::

        solver = warp_corot.newton.SolverCorotated(model)
        solver.step(state_in, state_out, control, contacts, dt)

    Args:
        model: A model with tetrahedra.
        lame: What k_mu and k_lambda are: "documented", Lamé's parameters, as Newton's documentation has it; or
            "semi-implicit", what ``SolverSemiImplicit`` makes of them for small strains: mu = 3/4 k_mu,
            lambda = k_lambda - 5/8 k_mu.
        damping: Rate of mass-proportional damping [1/s], besides k_damp.
        substeps: Into how many steps a step is divided; None: as many as the present state takes to be stable, see
            ``safe_dt``.
        rotation: "byers-xu", or "warm": found from the one in the state, ``state.warp_corot.rotation``, so that also
            an inverted element's is continuous in time. It needs ``register_custom_attributes``, and forests then go
            tetrahedron by tetrahedron.
        rotation_level: Of forests: whose rotation is used; see ``Corotated``.
        rigid_solver: What steps rigid bodies: "semi-implicit"; another solver, made for this model, which also gets
            their forces; or None: nothing does, and reactions are added to ``state_in.body_f`` for who does.
        particle_contact: Whether particles collide with one another, as in ``SolverSemiImplicit``. Newton's default
            radius of 0.1 m makes finer meshes fight themselves.
        stable_dt: The largest stable step [s], where it is known; None: it is found from elements and masses.

    Attributes:
        stable_dt: The largest stable step about rest [s], of tetrahedra, springs, triangles (cloth) and bending edges
            with their damping. Joints are left out of it, of ``contact_dt``, and of ``substeps=None``.
        contact_dt: The same with contact or an attachment at every particle [s], as stiff as they can be here, with the
            lightest rigid body at its other end; with ``particle_contact``, among other particles, too.

    Raises:
        InputError: No tetrahedra, a material that is not positive definite, or an option out of its range.
    """

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
        stable_dt: float | None = None,
    ):
        if not isinstance(model, newton.Model) and not isinstance(model, ModelView):
            raise InputError(f"model is {_named(model)}; it must be a newton.Model, as builder.finalize() makes it")
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
        super().__init__(model)
        self._substeps = None if substeps is None else int(substeps)
        self._given_stable_dt = stable_dt
        self.tetrahedra = Tetrahedra(model, lame, rotation == "warm", rotation_level)
        self._contacts = Contacts(model)
        self._others = Others(model, rigid_solver, particle_contact)
        self._steps = Steps(model, self.tetrahedra, self._contacts, self._others, damping)
        self._following = Following(model, self.tetrahedra) if substeps is None else None
        self._all_worlds = wp.ones(max(int(model.world_count), 1) + 1, dtype=wp.bool, device=self.device)
        self._find_stable_steps()

    @property
    def substeps(self) -> int | None:
        """Into how many steps a step is divided; None where that follows the state."""
        return self._substeps

    @property
    def safe_dt(self) -> float:
        """The substep that ``substeps=None`` takes at present [s]; on CUDA as far as is known without waiting.

        At rest 0.9 of ``contact_dt``; shorter where elements are stiffer, or strained so much that they may soon be.
        With given substeps it stays 0.7 of ``contact_dt``.
        """
        return SAFETY * self.contact_dt if self._following is None else self._following.substep

    @property
    def recorded_dt(self) -> float:
        """The longest step that has a single substep when it is recorded now [s]."""
        return self.safe_dt if self._following is None else self._following.recorded_substep

    @property
    def substeps_made(self) -> int:
        """Substeps of the last step that was launched or recorded."""
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

        Forces in ``state_in`` act throughout the step and stay as they are. May be captured; launches only.

        Args:
            state_in, state_out: States of the model.
            control: Activations, and what joints are driven by; None: the model's.
            contacts: What ``newton.CollisionPipeline`` found; None: no contact.
            dt: Time step [s].
            observables: None, or an empty container of this solver's.

        Raises:
            InputError: A time step that is not stable, arrays on another device, or states without what the solver
                needs; then nothing has been launched. On the CPU, unless capturing, also: a state that is not finite,
                more contacts than the buffer holds, contacts of edges and faces; as ``check``.
            UnstableError: On the CPU, unless capturing: the step's result is not finite.
        """
        refuse_tape()
        self.validate_observables(observables, contacts)
        self._check_arguments(state_in, state_out, control, contacts)
        following = self._following
        self._steps.check_earlier(following)
        count = self._count_for(dt)
        if following is not None and self.device.is_cpu and not self.device.is_capturing:
            self._steps.launch_retried(state_in, state_out, control, contacts, dt, following)
        else:
            self._steps.launch(state_in, state_out, control, contacts, dt, count, following)
        if self.device.is_cpu and not self.device.is_capturing:
            self.check()

    def check(self) -> None:
        """Say what has been wrong since somebody last asked, and warn of recorded steps with too few substeps.

        Waits for the device.

        Worlds of which something is said have stayed as they were. Those in which a state was handed in that is not
        finite keep what ``state_out`` held before.

        Raises:
            InputError: States that were handed in, or contacts.
            UnstableError: A step's result was not finite, or beyond reason.
        """
        excess = 0.0 if self._following is None else self._following.take_excess()
        if excess > EXCESS:
            warnings.warn(
                f"a recorded step has fewer substeps than are safe: {excess:.2g} times as many would be; "
                "record it again in the present state, or give SolverCorotated more substeps",
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
        """Put chosen worlds of a state back to the model's initial one, rotations too.

        Args:
            state: The state, changed in place.
            world_mask: bool [world_count + 1], the last one for what is in no world; None: all.
            flags: ``newton.StateFlags`` of what is put back: PARTICLE_Q, PARTICLE_QD, and, if this solver steps the
                bodies, BODY_Q and BODY_QD; None: all.
        """
        mask = self._all_worlds if world_mask is None else self._checked_mask(world_mask)
        self._steps.reset(state, mask, int(newton.StateFlags.ALL if flags is None else flags))
        self._others.reset(state, world_mask, flags)

    def write_attributes(self, state: newton.State) -> None:
        """Write rotations and stresses of a state's positions into it; ``step`` does so for ``state_out`` itself.

        For states that this solver does not hand out, such as those of Newton's coupled solvers.
        """
        self.tetrahedra.write_attributes(state, state)

    def notify_model_changed(self, flags: int) -> None:
        """Take over what has changed in the model; stable steps are found again where they may have changed.

        ``ModelFlags.MODEL_PROPERTIES`` says that materials of elements, or masses, have; ``SHAPE_PROPERTIES`` and
        ``CONSTRAINT_PROPERTIES`` that stiffness of contacts and attachments has. Gravity, activations and forces of
        contact are read from the model in every step. Waits for the device, except in a capture, in which materials
        are left as they were.

        Raises:
            InputError: As on construction.
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
        """True: masses are read from the model in every step."""
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
                raise InputError(f"{name} is {_named(state)}; it must be a newton.State, as model.state() makes it")
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
    """Whether something is a finite number."""
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)


def _named(value: Any) -> str:
    return "None" if value is None else f"a {type(value).__name__}"
