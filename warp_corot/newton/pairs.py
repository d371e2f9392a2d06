"""Contact of soft bodies and cloth with one another and themselves; see ``kernels.newton.pairs``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.newton.pairs import PairLists, Surfaces, count_pair_loads, scatter_pairs
from warp_corot.kernels.newton.rows import ContactLaw
from warp_corot.mesh.growing.cut import linked, node_pairs

from .library import newton

#: Sine of an angle below which two edges are parallel, as in Newton's detector.
PARALLEL = 1e-5


class SoftPairs:
    """Forces of pairs of vertices and triangles, and of edges, that ``newton.CollisionPipeline`` has found.

    Args:
        model: A model with triangles.
        margin: Distance at which surfaces begin to push one another [m].
    """

    def __init__(self, model: newton.Model, margin: float):
        if not model.tri_count or not model.edge_count:
            raise InputError(
                "self_contact_margin is given, but the model has no triangles with edges that could touch: give "
                "add_forest and add_mesh surface=True"
            )
        self.model, self.margin, self.device = model, margin, model.device
        triangles = model.tri_indices.numpy().reshape(-1, 3)
        edges = model.edge_indices.numpy().reshape(-1, 4)
        count = model.particle_count
        exposed = np.zeros(count, np.int32)
        exposed[triangles] = 1
        facing = _facing(model, triangles)
        self._surfaces = surfaces = Surfaces()
        surfaces.triangles, surfaces.edges = model.tri_indices, model.edge_indices
        surfaces.facing = self._on_device(facing, wp.float32)
        surfaces.outward = self._on_device(_triangles_of_edges(triangles, edges, facing, count), wp.vec2i)
        surfaces.part = self._on_device(_parts(model, triangles), wp.int32)
        surfaces.exposed = self._on_device(exposed, wp.int32)
        surfaces.rest = wp.clone(model.particle_q)

    def lists_of(self, contacts: newton.Contacts) -> PairLists:
        """Newton's lists of pairs.

        Raises:
            InputError: The contacts have none.
        """
        data = contacts.soft_self_contact_data
        if data is None:
            raise InputError(
                "contacts hold no pairs of soft bodies, which self_contact_margin needs: call "
                "pipeline.init_soft_self_contact(margin=..., gap=...) before pipeline.contacts(), and "
                "pipeline.collide(state, contacts, soft_self_contact=True)"
            )
        lists = PairLists()
        lists.margin, lists.parallel = self.margin, PARALLEL
        lists.triangle_starts = data.vertex_colliding_triangles_offsets
        lists.triangle_counts = data.vertex_colliding_triangles_count
        lists.triangles = data.vertex_colliding_triangles
        lists.edge_starts = data.edge_colliding_edges_offsets
        lists.edge_counts = data.edge_colliding_edges_count
        lists.edges = data.edge_colliding_edges
        return lists

    def count_loads(self, lists: PairLists, law: ContactLaw, q: wp.array, load: wp.array) -> None:
        """Add to the loads of particles, float32 [P]."""
        self._launch(count_pair_loads, [self._surfaces, lists, law, q], [load])

    def add_forces(
        self, lists: PairLists, law: ContactLaw, dt: float, load: wp.array, motion: list, f: wp.array, trouble: wp.array
    ) -> None:
        """Add forces [N] to f, vec4 [P]; ``motion``: particles, positions, velocities, and forces before contacts'."""
        self._launch(scatter_pairs, [self._surfaces, lists, law, dt, load, *motion], [f, trouble])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        dim = max(self.model.particle_count, self.model.edge_count)
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)

    def _on_device(self, values: npt.NDArray[Any], dtype: type) -> wp.array:
        return wp.array(values, dtype=dtype, device=self.device)


def _facing(model: newton.Model, triangles: npt.NDArray[np.int32]) -> npt.NDArray[np.float32]:
    """Whether triangles' normals point out of tetrahedra (1) or into them (-1); 0: the triangle is a face of none, or
    of two.
    """
    tets = model.tet_indices.numpy().reshape(-1, 4)
    faces = np.concatenate([np.delete(tets, k, axis=1) for k in range(4)])
    inner = np.concatenate([tets[:, k] for k in range(4)])
    keys = np.sort(faces, axis=1)
    _, first, times = np.unique(keys, axis=0, return_index=True, return_counts=True)
    both = np.concatenate([keys[first], np.sort(triangles, axis=1)])
    _, group = np.unique(both, axis=0, return_inverse=True)
    group = np.ravel(group)
    of_group = np.full(group.max() + 1, -1)
    outer = times == 1
    of_group[group[: len(first)][outer]] = first[outer]
    face = of_group[group[len(first) :]]
    x = model.particle_q.numpy().astype(np.float64)
    a, b, c = (x[triangles[:, k]] for k in range(3))
    inwards = x[inner[face]] - a
    volume = np.einsum("ij,ij->i", np.cross(b - a, c - a), inwards)
    return np.where(face < 0, 0.0, -np.sign(volume)).astype(np.float32)


def _triangles_of_edges(
    triangles: npt.NDArray[np.int32], edges: npt.NDArray[np.int32], facing: npt.NDArray[np.float32], count: int
) -> npt.NDArray[np.int32]:
    """Two triangles of tetrahedra at each edge, or -1, int32 [E, 2]."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]).astype(np.int64)
    owner = np.tile(np.arange(len(triangles)), 3)
    solid = facing[owner] != 0
    keys, owner = (np.sort(sides, axis=1) @ [count, 1])[solid], owner[solid]
    order = np.argsort(keys, kind="stable")
    keys, owner = keys[order], owner[order]
    wanted = np.sort(edges[:, 2:].astype(np.int64), axis=1) @ [count, 1]
    found = np.full((len(edges), 2), -1, np.int32)
    start, stop = np.searchsorted(keys, wanted, "left"), np.searchsorted(keys, wanted, "right")
    for side in range(2):
        there = start + side < stop
        found[there, side] = owner[start[there] + side]
    return found


def _parts(model: newton.Model, triangles: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Number of the connected body of each particle, int32 [P]."""
    tets = model.tet_indices.numpy().reshape(-1, 4)
    pairs = np.concatenate([node_pairs(tets)] + [triangles[:, [0, k]] for k in (1, 2)])
    return linked(pairs, model.particle_count).astype(np.int32)
