"""Soft contacts and attachments: what particles and rigid bodies do to one another.

Contacts are of particles: a body smaller than their spacing sinks in between them, and one whose edge they pass in a
step is pushed aside. So particles' radii should exceed what a body goes in a step, and half of the spacing where bodies
are as small as that; the pipeline's ``soft_contact_gap`` should exceed what a body goes between two ``collide``, or
contacts are found too late, when they are deep, and throw it out.
"""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton.contacts import ContactLaw, scatter_attachments, scatter_soft_contacts
from warp_corot.kernels.newton.worlds import check_contact_count
from warp_corot.kernels.newton.yielding import gather_attachments, gather_soft_contacts, solve_yielding

from .library import newton

#: ``newton.BodyFlags.KINEMATIC``, of bodies that move as they are told.
KINEMATIC = int(newton.BodyFlags.KINEMATIC)

#: How often it is asked which contacts still hold where bodies have given way.
ROUNDS = 4


class Contacts:
    """Forces between particles and bodies; reactions are wrenches about the bodies' centres of mass."""

    def __init__(self, model: newton.Model):
        self.model = model
        self.device = model.device
        bodies = model.body_count
        self._no_poses = wp.empty(0, dtype=wp.transform, device=self.device)
        self._no_twists = wp.empty(0, dtype=wp.spatial_vector, device=self.device)
        self._no_points = wp.empty(0, dtype=wp.vec3, device=self.device)
        self._no_inertia = wp.empty(0, dtype=wp.mat33, device=self.device)
        self._no_flags = wp.empty(0, dtype=wp.int32, device=self.device)
        #: In how many places bodies are touched or held, int32 [B].
        self._places = wp.zeros(bodies, dtype=wp.int32, device=self.device)
        #: Forces on particles before those of contacts [N], which friction takes account of.
        self._before = wp.empty(model.particle_count, dtype=wp.vec4, device=self.device)
        self._no_numbers = wp.empty(0, dtype=wp.float32, device=self.device)
        #: Curvature and slope of springs on bodies, and how far these give way to them [m]; of twists, [B].
        self._curvature = wp.zeros(bodies, dtype=wp.spatial_matrixf, device=self.device)
        self._slope = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        self._yielding = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        #: Wrenches of the particles on the bodies in the last substep [N, N m], spatial_vector [B].
        self.reactions = wp.zeros(bodies, dtype=wp.spatial_vectorf, device=self.device)
        self.refresh()

    def refresh(self) -> None:
        """See that attachments can be stepped, and how stiff they and contacts are.

        Raises:
            InputError: An attachment is rigid.
        """
        if self.model.attachment_particle_body_count:
            stiffness = self.model.attachment_particle_body_stiffness.numpy()
            bad = np.flatnonzero(~np.isfinite(stiffness))
            if len(bad):
                raise InputError(f"attachment {bad[0]} has stiffness {stiffness[bad[0]]}; it must be finite [N/m]")
        #: The largest stiffness that a contact or an attachment can have [N/m].
        self.stiffest = self._find_stiffest()
        #: Inverse mass of the lightest body that particles can touch or are attached to [1/kg]; 0: none that moves.
        self.lightest = self._find_lightest()

    def _find_stiffest(self) -> float:
        found = [0.0]
        if self.model.shape_count:
            found.append(0.5 * (self.model.soft_contact_ke + float(self.model.shape_material_ke.numpy().max())))
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
        self,
        state: newton.State,
        of_bodies: newton.State,
        contacts: newton.Contacts | None,
        dt: float,
        f: wp.array,
        trouble: wp.array,
    ) -> None:
        """Add forces on a state's particles to f, vec4 [P], and set ``reactions``. Bodies are where ``of_bodies`` has
        them."""
        model = self.model
        q, qd = state.particle_q, state.particle_qd
        touching = contacts if contacts is not None and contacts.soft_contact_max and model.shape_count else None
        attached = model.attachment_particle_body_count
        law = self._law()
        if model.body_count:
            self.reactions.zero_()
            if touching is not None or attached:
                self._find_yielding(state, of_bodies, touching, dt, law)
            masses = [model.body_flags, model.body_inv_mass, model.body_inv_inertia, self._places]
            bodies = [of_bodies.body_q, of_bodies.body_qd, model.body_com, self._yielding]
        else:
            masses = [self._no_flags, self._no_numbers, self._no_inertia, self._places]
            bodies = [self._no_poses, self._no_twists, self._no_points, self._no_twists]
        bodies = [KINEMATIC, *masses, *bodies]
        if touching is not None:
            found = [
                touching.soft_contact_count,
                touching.soft_contact_particle,
                touching.soft_contact_indices,
                touching.soft_contact_shape,
                touching.soft_contact_body_pos,
                touching.soft_contact_body_vel,
                touching.soft_contact_normal,
            ]
            shapes = [model.shape_body, self._margins(), model.shape_material_ke, model.shape_material_kd]
            shapes += [model.shape_material_kf, model.shape_material_mu]
            particles = [model.particle_flags, model.particle_world, model.particle_radius, model.particle_inv_mass]
            wp.copy(self._before, f)
            inputs = [law, dt, *found, *shapes, *particles, q, qd, model.gravity, self._before, *bodies]
            self._launch(scatter_soft_contacts, touching.soft_contact_max, inputs, [f, self.reactions, trouble])
        if attached:
            inputs = [dt, *self._attachments(), model.attachment_particle_body_damping]
            inputs += [model.attachment_particle_body_enabled, model.particle_inv_mass, q, qd, *bodies]
            self._launch(scatter_attachments, attached, inputs, [f, self.reactions])

    def _find_yielding(
        self, state: newton.State, of_bodies: newton.State, touching: newton.Contacts | None, dt: float, law: ContactLaw
    ) -> None:
        """How far bodies give way to springs, and in how many places they are touched."""
        model, q = self.model, state.particle_q
        self._places.zero_()
        outputs = [self._places, self._curvature, self._slope]
        bodies = [of_bodies.body_q, model.body_com]
        for number in range(ROUNDS if touching is not None else 1):
            if touching is not None:
                inputs = [law, touching.soft_contact_count, touching.soft_contact_particle, touching.soft_contact_shape]
                inputs += [touching.soft_contact_body_pos, touching.soft_contact_normal]
                inputs += [model.shape_body, self._margins(), model.shape_material_ke]
                inputs += [model.particle_flags, model.particle_radius, q, KINEMATIC, model.body_flags, *bodies]
                inputs += [self._yielding, number]
                self._launch(gather_soft_contacts, touching.soft_contact_max, inputs, outputs)
            if model.attachment_particle_body_count:
                inputs = [*self._attachments(), model.attachment_particle_body_enabled, q, *bodies, number]
                self._launch(gather_attachments, model.attachment_particle_body_count, inputs, outputs)
            inputs = [dt, KINEMATIC, model.body_flags, model.body_inv_mass, model.body_inv_inertia, of_bodies.body_q]
            self._launch(solve_yielding, model.body_count, inputs, [self._curvature, self._slope, self._yielding])

    def _law(self) -> ContactLaw:
        law, model = ContactLaw(), self.model
        law.stiffness, law.damping = model.soft_contact_ke, model.soft_contact_kd
        law.friction_slope, law.friction = model.soft_contact_kf, model.soft_contact_mu
        law.adhesion = model.particle_adhesion
        return law

    def _margins(self) -> wp.array:
        return self._no_numbers if self.model.shape_margin is None else self.model.shape_margin

    def _attachments(self) -> list[wp.array]:
        model = self.model
        return [
            model.attachment_particle_body_particle,
            model.attachment_particle_body_body,
            model.attachment_particle_body_body_point,
            model.attachment_particle_body_stiffness,
        ]

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
