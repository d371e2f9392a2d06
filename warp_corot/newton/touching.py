"""The content of Newton's records of soft contacts, and how many of them share each particle; see
``kernels.newton.touching``."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton.touching import count_loads

from .library import newton

#: The stiffness of all contacts that share a particle is at most this many times the stiffness of one.
CROWD = 4.0


#: Types of shapes with contacts of their vertices and edges. Newton does not tell which of these contacts repeat each
#: other.
MESHES = [int(newton.GeoType.MESH), int(newton.GeoType.CONVEX_MESH)]


def has_surfaces(model: newton.Model, contacts: newton.Contacts) -> bool:
    """Whether records of contacts with shapes may be of edges and triangles.

    Raises:
        InputError: They may be, and particles collide with a triangle mesh.
    """
    # This attribute is private to Newton. Without it, every model with triangles may have such records.
    if not getattr(contacts, "_enable_rigid_soft_full_surface_contact", model.tri_count > 0):
        return False
    if model.device.is_capturing:
        return True
    collide = (model.shape_flags.numpy() & int(newton.ShapeFlags.COLLIDE_PARTICLES)) != 0
    meshes = np.flatnonzero(collide & np.isin(model.shape_type.numpy(), MESHES))
    if len(meshes):
        raise InputError(
            f"shape {model.shape_label[meshes[0]]} is a triangle mesh, which SolverCorotated lets soft bodies touch at "
            "nodes only: make the CollisionPipeline without enable_rigid_soft_full_surface_contact, or the shape of "
            "primitives"
        )
    return True


def records_of(contacts: newton.Contacts) -> list[wp.array]:
    """Number, particles, nodes and weights of contacts with shapes."""
    return [
        contacts.soft_contact_count,
        contacts.soft_contact_particle,
        contacts.soft_contact_indices,
        contacts.soft_contact_barycentric,
    ]


class Loads:
    """Sums of the weights of particles in contacts that touch.

    Attributes:
        array: float32 [P]; empty if every contact has a particle of its own.
    """

    def __init__(self, model: newton.Model):
        self.model = model
        self._none = wp.empty(0, dtype=wp.float32, device=model.device)
        self._room = self._none
        self.array = self._none

    def begin(self, needed: bool) -> None:
        """Reset the sums."""
        if needed and not len(self._room):
            self._room = wp.empty(self.model.particle_count, dtype=wp.float32, device=self.model.device)
        self.array = self._room if needed else self._none
        if needed:
            self.array.zero_()

    def count(
        self, contacts: newton.Contacts, records: list[wp.array], shapes: list, q: wp.array, poses: wp.array
    ) -> None:
        """Add the weights of all contacts with shapes that touch."""
        model = self.model
        inputs = [*records, contacts.soft_contact_shape, contacts.soft_contact_body_pos, contacts.soft_contact_normal]
        inputs += [*shapes, model.particle_radius, q, poses]
        wp.launch(count_loads, dim=contacts.soft_contact_max, inputs=inputs, outputs=[self.array], device=model.device)
