"""The piece of the bodies that a rank draws: the elements that it counts, and their faces on the bodies' surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.io.write.skins import Skin
from warp_corot.mesh.surfaces.bound import SurfaceMesh

from .divided_mesh import DividedMesh
from .part_sync import PartSync

Ints = npt.NDArray[np.int32]


class Piece:
    """A rank's piece of all bodies in one world, body after body, as one mesh and one material.

    Args:
        syncs: The bodies and this rank's parts of them.
        world: The world.

    Attributes:
        points, tets: The mesh at rest [m], [N, 3], and [T, 4].
        fixed: Whether each node is held, bool [N].
        young, poisson, density: The elements' material [Pa], -, [kg/m^3], a number or [T].
        skin: The faces on the bodies' surface.
    """

    def __init__(self, syncs: Sequence[PartSync], world: int):
        self._syncs, self._world = syncs, world
        self.up_axis = syncs[0].whole.mesh.up_axis
        #: The elements of each body that this rank counts, among those of its part; and the nodes of these.
        self._elements = [np.flatnonzero(each.part.numbers.counted) for each in syncs]
        self._nodes, tets, faces, first = [], [], [], 0
        for each, elements in zip(syncs, self._elements, strict=True):
            own = each.part.mesh.tets[elements]
            nodes = np.unique(own)
            number = np.full(each.part.world_node_count, -1, np.int32)
            number[nodes] = np.arange(first, first + len(nodes), dtype=np.int32)
            tets.append(number[own])
            faces.append(number[_outer_faces(each)])
            self._nodes.append(nodes)
            first += len(nodes)
        self.points = np.concatenate([e.part.mesh.points[n] for e, n in zip(syncs, self._nodes, strict=True)])
        self.tets = np.concatenate(tets).astype(np.int32)
        self.fixed = self._nodal("held") > 0
        self.skin = _skin(self.points, np.concatenate(faces))
        for name in ("young", "poisson", "density"):
            setattr(self, name, self._property(name))

    def state(self, name: str, completed: Callable[[int, str], wp.array]) -> npt.NDArray[np.float32]:
        """A nodal array of the state at the piece's nodes, float32 [N, 3].

        Args:
            name: The name of the array.
            completed: Gives the array of a body's part with the values of other ranks' nodes.
        """
        found = []
        for k, nodes in enumerate(self._nodes):
            first = self._world * self._syncs[k].part.world_node_count
            found.append(completed(k, name).numpy()[first + nodes, :3])
        return np.concatenate(found)

    def of_elements(self, values: Sequence[npt.NDArray[np.float32]]) -> npt.NDArray[np.float32]:
        """Values of the piece's elements, from those of all elements of each part in all worlds."""
        found = []
        for each, elements, given in zip(self._syncs, self._elements, values, strict=True):
            found.append(given.reshape(each.part.worlds, -1)[self._world, elements])
        return np.concatenate(found)

    def _nodal(self, name: str) -> npt.NDArray[np.uint8]:
        """A condition of the nodes, from the bodies that users hold."""
        found = []
        for each, nodes in zip(self._syncs, self._nodes, strict=True):
            first = self._world * each.whole.world_node_count
            values = getattr(each.whole.conditions, name).numpy()
            found.append(values[first + each.part.places[nodes]])
        return np.concatenate(found)

    def _property(self, name: str) -> float | npt.NDArray[np.float64]:
        values = []
        for each, elements in zip(self._syncs, self._elements, strict=True):
            body = each.part
            shape = (body.worlds, body.world_element_count)
            everywhere = np.broadcast_to(getattr(body.material.isotropic, name), shape)
            values.append(everywhere[self._world, elements])
        joined = np.concatenate(values).astype(np.float64)
        # A piece of a mesh that changes may get elements of other materials.
        varies = any(np.ptp(getattr(e.whole.material.isotropic, name)) > 0 for e in self._syncs if _changes(e))
        return float(joined[0]) if (joined == joined[0]).all() and not varies else joined


def _changes(sync: PartSync) -> bool:
    return sync.whole.changing is not None


def _outer_faces(sync: PartSync) -> Ints:
    """The triangles of the whole body's surface that are faces of elements that this rank counts, by the part's
    nodes."""
    whole, numbers = sync.whole, sync.part.numbers
    triangles, parents = whole.surface_faces
    if isinstance(whole.mesh, DividedMesh):
        own = numbers.counted[parents] & whole.mesh.are_outer(triangles)
        return triangles[own]
    is_own = np.zeros(whole.world_element_count, bool)
    is_own[sync.part.element_places[numbers.counted]] = True
    number = np.full(whole.world_node_count, -1, np.int32)
    number[sync.part.places] = np.arange(len(sync.part.places), dtype=np.int32)
    return number[triangles[is_own[parents]]]


def _skin(points: npt.NDArray[np.float64], faces: Ints) -> Skin:
    used, triangles = np.unique(faces, return_inverse=True)
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (len(used), 1))
    nodes = np.repeat(used[:, None], 4, axis=1).astype(np.int32)
    surface = SurfaceMesh(points[used], nodes, weights, triangles.reshape(-1, 3).astype(np.int32))
    return Skin("surface", surface, is_boundary=True)
