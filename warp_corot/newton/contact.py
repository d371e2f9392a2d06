"""Soft contacts and attachments: what particles and rigid bodies do to one another."""

from __future__ import annotations

import numpy as np
import warp as wp

from ..errors import InputError
from ..kernels.newton_contacts import (
    ContactLaw,
    count_attachments,
    count_soft_contacts,
    scatter_attachments,
    scatter_soft_contacts,
)
from ..kernels.newton_worlds import check_contact_count
from .library import newton


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
        self._no_numbers = wp.empty(0, dtype=wp.float32, device=self.device)
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
        if model.body_count:
            self.reactions.zero_()
            masses = [model.body_flags, model.body_inv_mass, model.body_inv_inertia, self._places]
            bodies = [of_bodies.body_q, of_bodies.body_qd, model.body_com]
            self._places.zero_()
        else:
            masses = [self._no_flags, self._no_numbers, self._no_inertia, self._places]
            bodies = [self._no_poses, self._no_twists, self._no_points]
        bodies = [int(newton.BodyFlags.KINEMATIC), *masses, *bodies]
        if model.attachment_particle_body_count:
            # Before the contacts: they share the body with these.
            inputs = [model.attachment_particle_body_body, model.attachment_particle_body_enabled]
            self._launch(count_attachments, model.attachment_particle_body_count, inputs, [self._places])
        if contacts is not None and contacts.soft_contact_max and model.shape_count:
            law = ContactLaw()
            law.stiffness, law.damping = model.soft_contact_ke, model.soft_contact_kd
            law.friction_slope, law.friction = model.soft_contact_kf, model.soft_contact_mu
            law.adhesion = model.particle_adhesion
            found = [
                contacts.soft_contact_count,
                contacts.soft_contact_particle,
                contacts.soft_contact_indices,
                contacts.soft_contact_shape,
                contacts.soft_contact_body_pos,
                contacts.soft_contact_body_vel,
                contacts.soft_contact_normal,
            ]
            shapes = [
                model.shape_body,
                self._no_numbers if model.shape_margin is None else model.shape_margin,
                model.shape_material_ke,
                model.shape_material_kd,
                model.shape_material_kf,
                model.shape_material_mu,
            ]
            if model.body_count:
                inputs = [law, found[0], found[1], found[3], found[4], found[6], shapes[0], shapes[1]]
                inputs += [model.particle_flags, model.particle_radius, q, of_bodies.body_q]
                self._launch(count_soft_contacts, contacts.soft_contact_max, inputs, [self._places])
            particles = [model.particle_flags, model.particle_world, model.particle_radius, model.particle_inv_mass]
            inputs = [law, dt, *found, *shapes, *particles, q, qd, *bodies]
            outputs = [f, self.reactions, trouble]
            self._launch(scatter_soft_contacts, contacts.soft_contact_max, inputs, outputs)
        if model.attachment_particle_body_count:
            attached = [
                model.attachment_particle_body_particle,
                model.attachment_particle_body_body,
                model.attachment_particle_body_body_point,
                model.attachment_particle_body_stiffness,
                model.attachment_particle_body_damping,
                model.attachment_particle_body_enabled,
                model.particle_inv_mass,
            ]
            outputs = [f, self.reactions]
            count = model.attachment_particle_body_count
            self._launch(scatter_attachments, count, [dt, *attached, q, qd, *bodies], outputs)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
