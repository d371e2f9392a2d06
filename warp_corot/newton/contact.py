"""Contacts of soft bodies with rigid bodies and with one another, and attachments to rigid bodies.

Newton's pipeline finds the contacts: at particles, and on request at points of edges and triangles. Without these, a
body smaller than the particles' spacing sinks in between them. Particles' radii should exceed a body's motion in a
step; the pipeline's ``soft_contact_gap`` should exceed a body's motion between two ``collide``, or
contacts are found late, start with deep penetration, and can launch the body.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton.attachments import scatter_attachments
from warp_corot.kernels.newton.contacts import ContactLaw, scatter_soft_contacts
from warp_corot.kernels.newton.pairs import PairLists
from warp_corot.kernels.newton.worlds import check_contact_count
from warp_corot.kernels.newton.yielding import gather_attachments, gather_soft_contacts, solve_yielding

from .arguments import Step
from .library import newton
from .pairs import SoftPairs
from .touching import CROWD, Loads, MeshRecords, has_surfaces

#: ``newton.BodyFlags.KINEMATIC``, for bodies with prescribed motion.
KINEMATIC = int(newton.BodyFlags.KINEMATIC)

#: Number of iterations that find which contacts still hold after bodies have yielded.
ROUNDS = 4


class Touch(NamedTuple):
    """The input of contact's launches in a substep.

    Attributes:
        state: The state of the particles.
        of_bodies: The state of the bodies.
        contacts: Contacts between particles and shapes; None if there can be none.
        records: Their records; empty without contacts.
        law: The law of contact.
        dt: The length of the substep [s].
    """

    state: newton.State
    of_bodies: newton.State
    contacts: newton.Contacts | None
    records: list[wp.array]
    law: ContactLaw
    dt: float


class Contacts:
    """Forces of contacts and attachments; reactions are wrenches about the bodies' centres of mass.

    Args:
        model: The model.
        margin: Distance at which soft bodies begin to push one another [m]; None: they do not.
    """

    def __init__(self, model: newton.Model, margin: float | None = None):
        self.model = model
        self.device = model.device
        bodies = model.body_count
        self._no_poses = wp.empty(0, dtype=wp.transform, device=self.device)
        self._no_twists = wp.empty(0, dtype=wp.spatial_vector, device=self.device)
        self._no_points = wp.empty(0, dtype=wp.vec3, device=self.device)
        self._no_inertia = wp.empty(0, dtype=wp.mat33, device=self.device)
        self._no_flags = wp.empty(0, dtype=wp.int32, device=self.device)
        self._no_wrenches = wp.empty(0, dtype=wp.spatial_vectorf, device=self.device)
        #: Contacts of soft bodies with one another, if they have any.
        self.pairs = None if margin is None else SoftPairs(model, margin)
        self._loads, self._records = Loads(model), MeshRecords(model)
        #: Number of places at which each body is touched or held, int32 [B].
        self._places = wp.zeros(bodies, dtype=wp.int32, device=self.device)
        #: Forces on particles before contact forces [N], which friction uses.
        self._before = wp.empty(model.particle_count, dtype=wp.vec4, device=self.device)
        self._no_numbers = wp.empty(0, dtype=wp.float32, device=self.device)
        #: Curvature and slope of springs on bodies, and how far these yield to them [m]; and twists, [B].
        self._curvature = wp.zeros(bodies, dtype=wp.spatial_matrixf, device=self.device)
        self._slope = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        self._yielding = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        #: Wrenches of the particles on the bodies in the last substep [N, N m], spatial_vector [B].
        self.reactions = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        #: Whether contacts of edges and triangles have occurred.
        self.crowded = False
        self.refresh()

    def has_surfaces(self, contacts: newton.Contacts) -> bool:
        """Whether contacts may be of edges and triangles while their stiffness is not counted yet."""
        there = contacts.soft_contact_max and self.model.shape_count
        return bool(there) and not self.crowded and has_surfaces(self.model, contacts)

    def refresh(self) -> None:
        """Check that attachments can be stepped, and find the stiffness of attachments and contacts.

        Raises:
            InputError: An attachment is rigid.
        """
        if self.model.attachment_particle_body_count:
            stiffness = self.model.attachment_particle_body_stiffness.numpy()
            bad = np.flatnonzero(~np.isfinite(stiffness))
            if len(bad):
                raise InputError(f"attachment {bad[0]} has stiffness {stiffness[bad[0]]}; it must be finite [N/m]")
        #: Largest possible stiffness of a contact or an attachment [N/m].
        self.stiffest = self._find_stiffest()
        #: Inverse mass of the lightest moving body that particles can touch or are attached to [1/kg]; 0: there is
        #: none.
        self.lightest = self._find_lightest()

    def _find_stiffest(self) -> float:
        found = [0.0]
        if self.model.shape_count:
            one = 0.5 * (self.model.soft_contact_ke + float(self.model.shape_material_ke.numpy().max()))
            found.append(one * (CROWD if self.crowded else 1.0))
        if self.pairs is not None:
            found.append(CROWD * self.model.soft_contact_ke)
        if self.model.attachment_particle_body_count:
            found.append(float(self.model.attachment_particle_body_stiffness.numpy().max()))
        return max(found)

    def _find_lightest(self) -> float:
        model = self.model
        if not model.body_count:
            return 0.0
        touched = np.zeros(model.body_count, bool)
        if model.shape_count:
            collide = (model.shape_flags.numpy() & int(newton.ShapeFlags.COLLIDE_PARTICLES)) != 0
            bodies = model.shape_body.numpy()
            touched[bodies[collide & (bodies >= 0)]] = True
        if model.attachment_particle_body_count:
            touched[model.attachment_particle_body_body.numpy()] = True
        touched &= (model.body_flags.numpy() & int(newton.BodyFlags.KINEMATIC)) == 0
        return float(model.body_inv_mass.numpy()[touched].max(initial=0.0))

    def check_count(self, contacts: newton.Contacts | None, trouble: wp.array) -> None:
        if contacts is not None and contacts.soft_contact_max:
            inputs = [contacts.soft_contact_count, contacts.soft_contact_max]
            wp.launch(check_contact_count, dim=len(trouble), inputs=inputs, outputs=[trouble], device=self.device)

    def add_forces(
        self, substep: Step, of_bodies: newton.State, f: wp.array, trouble: wp.array, share: float = 1.0
    ) -> None:
        """Add forces on particles to f, vec4 [P], and set ``reactions``.

        Args:
            substep: From the particles' state; its ``reported`` gets the wrenches of rigid and then soft contacts,
                spatial_vector [R + S].
            of_bodies: The state of the bodies.
            f: Forces [N], which already hold all others.
            trouble: Failures of worlds.
            share: The substep's share of the step, in the mean of ``reported``.
        """
        state, _, _, contacts, dt, reported = substep
        model = self.model
        touching = self.touching(contacts)
        attached = model.attachment_particle_body_count
        law = self.law()
        pairs = None if self.pairs is None or contacts is None else self.pairs.lists_of(contacts)
        if touching is not None or pairs is not None:
            wp.copy(self._before, f)
        records = self._records_of(touching, state, of_bodies)
        touch = Touch(state, of_bodies, touching, records, law, dt)
        self._count_loads(touch, pairs)
        bodies = self._find_bodies(touch)
        if touching is not None:
            rows = self._no_wrenches if reported is None else reported
            inputs = [law, dt, *self._found(touch), touching.soft_contact_body_vel]
            inputs += [touching.soft_contact_normal, *self.shapes(), model.shape_material_kd]
            inputs += [model.shape_material_kf, model.shape_material_mu, model.particle_flags, model.particle_world]
            inputs += [model.particle_radius, model.particle_inv_mass, state.particle_q, state.particle_qd]
            inputs += [model.gravity, self._before, *bodies, share, touching.rigid_contact_max]
            self._launch(scatter_soft_contacts, touching.soft_contact_max, inputs, [f, self.reactions, rows])
        if pairs is not None and self.pairs is not None:
            self.pairs.add_forces(pairs, state, law, dt, self._loads.array, self._before, f, trouble)
        if attached:
            inputs = [dt, *self.attachments(), model.attachment_particle_body_damping]
            inputs += [model.attachment_particle_body_enabled, model.particle_inv_mass]
            inputs += [state.particle_q, state.particle_qd, *bodies]
            self._launch(scatter_attachments, attached, inputs, [f, self.reactions])

    def touching(self, contacts: newton.Contacts | None) -> newton.Contacts | None:
        """Contacts between particles and shapes, if there can be any."""
        return contacts if contacts is not None and contacts.soft_contact_max and self.model.shape_count else None

    def count_loads(self, step: Step, of_bodies: newton.State) -> tuple[list[wp.array], wp.array]:
        """Records of contacts with shapes, and the loads of particles that share them, float32 [P] or empty."""
        touching = self.touching(step.contacts)
        records = self._records_of(touching, step.state_in, of_bodies)
        self._count_loads(Touch(step.state_in, of_bodies, touching, records, self.law(), step.dt), None)
        return records, self._loads.array

    def _records_of(
        self, touching: newton.Contacts | None, state: newton.State, of_bodies: newton.State
    ) -> list[wp.array]:
        if touching is None:
            return []
        poses = of_bodies.body_q if self.model.body_count else self._no_poses
        return self._records.records_of(touching, state.particle_q, poses)

    def _count_loads(self, touch: Touch, pairs: PairLists | None) -> None:
        """Find how many contacts share each particle, if several may."""
        touching, q = touch.contacts, touch.state.particle_q
        self._loads.begin((touching is not None and self.crowded) or pairs is not None)
        if touching is not None and len(self._loads.array):
            poses = touch.of_bodies.body_q if self.model.body_count else self._no_poses
            shapes = [self.model.shape_body, self._margins(), self.model.particle_adhesion]
            self._loads.count(touching, touch.records, shapes, q, poses)
        if pairs is not None and self.pairs is not None:
            self.pairs.count_loads(pairs, q, self._loads.array)

    def _find_bodies(self, touch: Touch) -> list:
        """The arguments of forces that describe bodies."""
        model, of_bodies = self.model, touch.of_bodies
        if model.body_count:
            self.reactions.zero_()
            if touch.contacts is not None or model.attachment_particle_body_count:
                self._find_yielding(touch)
            masses = [model.body_flags, model.body_inv_mass, model.body_inv_inertia, self._places]
            bodies = [of_bodies.body_q, of_bodies.body_qd, model.body_com, self._yielding]
        else:
            masses = [self._no_flags, self._no_numbers, self._no_inertia, self._places]
            bodies = [self._no_poses, self._no_twists, self._no_points, self._no_twists]
        return [KINEMATIC, *masses, *bodies]

    def _find_yielding(self, touch: Touch) -> None:
        """Find how far bodies yield to springs, and at how many places they are touched."""
        model, touching, of_bodies, q = self.model, touch.contacts, touch.of_bodies, touch.state.particle_q
        self._places.zero_()
        outputs = [self._places, self._curvature, self._slope]
        bodies = [of_bodies.body_q, model.body_com]
        for number in range(ROUNDS if touching is not None else 1):
            if touching is not None:
                inputs = [touch.law, *self._found(touch), touching.soft_contact_normal, *self.shapes()]
                inputs += [model.particle_flags, model.particle_radius, q, KINEMATIC, model.body_flags, *bodies]
                inputs += [self._yielding, number]
                self._launch(gather_soft_contacts, touching.soft_contact_max, inputs, outputs)
            if model.attachment_particle_body_count:
                inputs = [*self.attachments(), model.attachment_particle_body_enabled, q, *bodies, number]
                self._launch(gather_attachments, model.attachment_particle_body_count, inputs, outputs)
            inputs = [touch.dt, KINEMATIC, model.body_flags, model.body_inv_mass, model.body_inv_inertia]
            inputs += [of_bodies.body_q]
            self._launch(solve_yielding, model.body_count, inputs, [self._curvature, self._slope, self._yielding])

    def _found(self, touch: Touch) -> list[wp.array]:
        touching = touch.contacts
        assert touching is not None
        return [*touch.records, self._loads.array, touching.soft_contact_shape, touching.soft_contact_body_pos]

    def shapes(self) -> list[wp.array]:
        return [self.model.shape_body, self._margins(), self.model.shape_material_ke]

    def law(self) -> ContactLaw:
        law, model = ContactLaw(), self.model
        law.stiffness, law.damping = model.soft_contact_ke, model.soft_contact_kd
        law.friction_slope, law.friction = model.soft_contact_kf, model.soft_contact_mu
        law.adhesion, law.crowd = model.particle_adhesion, CROWD
        return law

    def _margins(self) -> wp.array:
        return self._no_numbers if self.model.shape_margin is None else self.model.shape_margin

    def attachments(self) -> list[wp.array]:
        model = self.model
        return [
            model.attachment_particle_body_particle,
            model.attachment_particle_body_body,
            model.attachment_particle_body_body_point,
            model.attachment_particle_body_stiffness,
        ]

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
