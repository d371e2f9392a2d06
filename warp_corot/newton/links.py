"""Contacts and attachments of implicit steps; see ``kernels.newton.links``."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.newton import links as kernels

from .arguments import Step
from .contact import Contacts
from .library import newton
from .unknowns import Unknowns


class LinkForces:
    """Forces and stiffness of contacts and attachments as functions of the motions in a step.

    Args:
        model: The model.
        contacts: Its contacts.
        unknowns: The entries of vectors.
    """

    def __init__(self, model: newton.Model, contacts: Contacts, unknowns: Unknowns):
        self.model, self.device, self._contacts, self._unknowns = model, model.device, contacts, unknowns
        self._attached = int(model.attachment_particle_body_count)
        self._no_poses = wp.empty(0, dtype=wp.transform, device=self.device)
        self._no_points = wp.empty(0, dtype=wp.vec3, device=self.device)
        self._no_wrenches = wp.empty(0, dtype=wp.spatial_vectorf, device=self.device)
        self._no_shapes = wp.empty(0, dtype=wp.int32, device=self.device)
        self._room, self.count, self._found = -1, 0, 0

    def begin(self, step: Step, of_bodies: newton.State) -> None:
        """Launch the links of a step from its first state."""
        model, contacts = self.model, self._contacts
        touching = contacts.touching(step.contacts)
        self._found = 0 if touching is None else int(touching.soft_contact_max)
        self.count = self._found + self._attached
        self._make_room()
        self._dt, self._adhesion = step.dt, float(model.particle_adhesion)
        poses = of_bodies.body_q if model.body_count else self._no_poses
        bodies = [poses, model.body_com if model.body_count else self._no_points]
        entries = [self._unknowns.particle, self._unknowns.body]
        q = step.state_in.particle_q
        if touching is not None:
            self._touching = touching
            records, load = contacts.count_loads(step, of_bodies)
            inputs = [contacts.law(), *records, load, touching.soft_contact_shape, touching.soft_contact_body_pos]
            inputs += [touching.soft_contact_body_vel, touching.soft_contact_normal, *contacts.shapes()]
            inputs += [model.shape_material_kd, model.shape_material_kf, model.shape_material_mu]
            inputs += [model.particle_flags, model.particle_radius, q, *bodies, *entries]
            self._launch(kernels.begin_contacts, inputs, [self._links], self._found)
        if self._attached:
            inputs = [self._found, *contacts.attachments(), model.attachment_particle_body_damping]
            inputs += [model.attachment_particle_body_enabled, q, *bodies, *entries]
            self._launch(kernels.begin_attachments, inputs, [self._links], self._attached)

    def update(self, d: wp.array) -> None:
        """Launch forces and stiffness at motions d."""
        self._launch(kernels.update_links, [self._dt, self._adhesion, d], [self._links])

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        """Launch the power of links along a change of motions; see ``solvers.implicit.line_search``."""
        inputs = [self._dt, self._adhesion, self._links, self._unknowns.count, d, change, search]
        self._launch(kernels.add_link_slopes, inputs, [slopes])

    def add_forces(self, y: wp.array) -> None:
        self._launch(kernels.add_link_forces, [self._links], [y])

    def add_products(self, x: wp.array, y: wp.array) -> None:
        self._launch(kernels.add_link_products, [self._links, x], [y])

    def add_blocks(self, blocks: wp.array) -> None:
        self._launch(kernels.add_link_blocks, [self._links], [blocks])

    def report(self, reported: wp.array | None, reactions: wp.array, share: float) -> None:
        """Launch the wrenches on bodies [N, N m], and add those of contacts, times ``share``, to ``reported``."""
        reactions.zero_()
        if not self.count:
            return
        rows, first, model = self._no_wrenches if reported is None else reported, 0, self.model
        of_contacts = [self._no_shapes, self._no_points, self._no_shapes]
        if self._found:
            touching = self._touching
            first = int(touching.rigid_contact_max)
            of_contacts = [touching.soft_contact_shape, touching.soft_contact_body_pos, model.shape_body]
        inputs = [self._links, self._found, self._unknowns.owner, *of_contacts, share, first]
        self._launch(kernels.report_links, inputs, [reactions, rows])

    def _make_room(self) -> None:
        if self.count == self._room:
            return
        self._room, self._links = self.count, kernels.Links()
        for name in ("weights", "arm", "normal", "gap", "slide", "force"):
            setattr(self._links, name, wp.zeros(self.count, dtype=wp.vec3, device=self.device))
        self._links.nodes = wp.zeros(self.count, dtype=wp.vec3i, device=self.device)
        self._links.body = wp.zeros(self.count, dtype=wp.int32, device=self.device)
        self._links.law = wp.zeros(self.count, dtype=wp.vec4, device=self.device)
        self._links.most = wp.zeros(self.count, dtype=wp.float32, device=self.device)
        self._links.stiffness = wp.zeros(self.count, dtype=wp.mat33, device=self.device)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list, dim: int | None = None) -> None:
        dim = self.count if dim is None else dim
        if dim:
            wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)
