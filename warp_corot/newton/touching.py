"""The content of Newton's records of soft contacts, and how many of them share each particle; see
``kernels.newton.touching``."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.newton import meshes as kernels
from warp_corot.kernels.newton.touching import count_loads

from .library import newton

#: The stiffness of all contacts that share a particle is at most this many times the stiffness of one.
CROWD = 4.0


def has_surfaces(model: newton.Model, contacts: newton.Contacts) -> bool:
    """Whether records of contacts with shapes may be of edges and triangles."""
    # This attribute is private to Newton. Without it, every model with triangles may have such records.
    return bool(getattr(contacts, "_enable_rigid_soft_full_surface_contact", model.tri_count > 0))


def records_of(contacts: newton.Contacts) -> list[wp.array]:
    """Number, particles, nodes and weights of contacts with shapes."""
    return [
        contacts.soft_contact_count,
        contacts.soft_contact_particle,
        contacts.soft_contact_indices,
        contacts.soft_contact_barycentric,
    ]


class MeshRecords:
    """The records that count where a model has triangle meshes; see ``kernels.newton.meshes``.

    Args:
        model: The model.
    """

    def __init__(self, model: newton.Model):
        self.model, self.device = model, model.device
        self._shapes = kernels.Shapes()
        if model.shape_count:
            self._shapes.body, self._shapes.pose = model.shape_body, model.shape_transform
            self._shapes.scale, self._shapes.mesh = model.shape_scale, model.shape_source_ptr
        self._copies: list[wp.array] = []
        self._nearest = wp.empty(0, dtype=wp.int64, device=self.device)

    def records_of(self, contacts: newton.Contacts, q: wp.array, poses: wp.array) -> list[wp.array]:
        """Number, particles, nodes and weights of contacts with shapes, for the present positions of particles and
        bodies."""
        found = records_of(contacts)
        # These attributes are private to Newton; without features there are no records of meshes.
        features = getattr(contacts, "_soft_contact_mesh_features", None)
        data = getattr(contacts, "_soft_contact_mesh_data", None)
        if features is None or data is None:
            return found
        count = contacts.soft_contact_max
        if not self._copies or len(self._copies[0]) != count:
            self._copies = [wp.empty(count, dtype=array.dtype, device=self.device) for array in found[1:]]
        vertices = len(data.rigid_features[0])
        rivals = vertices + self.model.edge_count
        if len(self._nearest) != rivals:
            self._nearest = wp.empty(rivals, dtype=wp.int64, device=self.device)
        records = kernels.Records()
        records.count, records.particle, records.nodes, records.weights = found
        records.features, records.shape = features, contacts.soft_contact_shape
        records.place = contacts.soft_contact_body_pos
        inputs = [vertices, records, self._shapes, q, poses, self._nearest]
        wp.launch(kernels.clear_nearest, rivals, [self._nearest], device=self.device)
        wp.launch(kernels.find_nearest, count, inputs, device=self.device)
        wp.launch(kernels.choose_records, count, inputs, self._copies, device=self.device)
        return [found[0], *self._copies]


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
