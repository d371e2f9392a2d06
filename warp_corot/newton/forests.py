"""The forests of a model: their tetrahedra, and their forces on the fast path."""

from __future__ import annotations

import warnings

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.discretization import FixedMesh
from warp_corot.elasticity import Corotated
from warp_corot.elasticity.dilatation import ELEMENT
from warp_corot.kernels.newton.particles import add_nodes, gather_nodes
from warp_corot.mesh import TetForest

from .library import newton
from .scene import mesh_fill, right_handed
from .state import attribute_of


class ForestGroup:
    """All copies of one forest in a model, as the worlds of one discretization.

    Args:
        forest: The forest.
        particles: First particle of each copy.
        tets: First tetrahedron of each copy.

    Attributes:
        tets: Tetrahedra of all copies, indices into the model's, int [copies * T].
        nodes: Particles of all copies, int [copies * N].
        rest: Rest positions of these [m], float32 [copies * N, 4].
        follow_one_another: Whether the particles are contiguous, so that forces need no arrays of the forest's own.
    """

    def __init__(
        self,
        model: newton.Model,
        forest: TetForest,
        particles: npt.NDArray[np.integer],
        tets: npt.NDArray[np.integer],
        rotation_level: int | None,
    ):
        self.forest, self.copies = forest, len(particles)
        self.device = model.device
        self.rotation_level = rotation_level
        self.tets = (tets[:, None] + np.arange(len(forest.tets))).ravel()
        self.nodes = (particles[:, None] + np.arange(len(forest.points))).ravel()
        self.count = len(self.nodes)
        self.follow_one_another = bool((np.diff(self.nodes) == 1).all())
        # Displacements use the forest's own axes, so only a copy's position is subtracted, and no digits are lost.
        rest = np.tile(forest.points, (self.copies, 1)).reshape(self.copies, -1, 3)
        there = model.particle_q.numpy().astype(np.float64)[self.nodes].reshape(rest.shape)
        rest = rest + (there - rest).mean(axis=1, keepdims=True)
        self.rest = np.zeros((self.count, 4), np.float32)
        self.rest[:, :3] = rest.reshape(-1, 3)
        #: Its nodes in arrays over particles; cached, since these arrays are the same in every step.
        self._parts: dict[int, wp.array] = {}
        if not self.follow_one_another:
            self._particles = wp.array(self.nodes, dtype=wp.int32, device=self.device)
            self._rest = wp.array(self.rest, dtype=wp.vec4, device=self.device)
            self._u, self._f = (wp.zeros(self.count, dtype=wp.vec4, device=self.device) for _ in range(2))

    def set_material(self, mu: npt.NDArray[np.float64], lam: npt.NDArray[np.float64]) -> None:
        """Set Lamé's parameters from those of the model's tetrahedra [Pa], float64 [all T]."""
        share = mesh_fill(self.forest)
        own_mu, own_lam = (_squeezed(a[self.tets].reshape(self.copies, -1) / share) for a in (mu, lam))
        made_of = FixedMesh.of_lame(self.forest, own_mu, own_lam, self.copies, self.device)
        self._field = Corotated(rotation_level=self.rotation_level, dilatation=ELEMENT).bind(made_of)

    def add_forces(self, x: wp.array, u: wp.array, f: wp.array) -> None:
        """Add the elastic forces of particles at x, displaced by u, to f, all vec4 [P].

        It reads only one of x and u: displacements if its particles are contiguous, else positions.
        """
        if self.follow_one_another:
            self._field.add_forces(self._part_of(u), self._part_of(f))
            return
        inputs = [self._particles, x, self._rest]
        wp.launch(gather_nodes, dim=self.count, inputs=inputs, outputs=[self._u], device=self.device)
        self._field.add_forces(self._u, self._f)
        wp.launch(add_nodes, dim=self.count, inputs=[self._particles, self._f], outputs=[f], device=self.device)

    def _part_of(self, nodal: wp.array) -> wp.array:
        if nodal.ptr not in self._parts:
            self._parts[nodal.ptr] = nodal[int(self.nodes[0]) : int(self.nodes[-1]) + 1]
        return self._parts[nodal.ptr]


def forest_groups(model: newton.Model, tets: npt.NDArray[np.integer], rotation_level: int | None) -> list[ForestGroup]:
    """The forests in a model; tetrahedra that were changed after they were added are left to the general path."""
    names = attribute_of(model, "forest") or []
    rows = [attribute_of(model, f"forest_{name}") for name in ("particle", "tet")]
    particles, first = (np.empty(0, int) if row is None else row.numpy() for row in rows)
    forests = [getattr(name, "forest", None) for name in names]
    keys = np.array([id(forest) for forest in forests], dtype=np.int64)
    groups = []
    for key in dict.fromkeys(keys.tolist()):
        chosen = np.flatnonzero(keys == key)
        forest, starts = forests[chosen[0]], (particles[chosen], first[chosen])
        if not isinstance(forest, TetForest) or not _is_there(forest, model, tets, *starts):
            warnings.warn(
                "a forest of this model comes from a file, or was changed after it was added; its tetrahedra are "
                "stepped one by one",
                UserWarning,
                stacklevel=5,
            )
            continue
        groups.append(ForestGroup(model, forest, *starts, rotation_level))
    return groups


def _is_there(
    forest: TetForest,
    model: newton.Model,
    tets: npt.NDArray[np.integer],
    particles: npt.NDArray[np.integer],
    first: npt.NDArray[np.integer],
) -> bool:
    """Whether a model's tetrahedra have the forest's nodes and rest shapes, in any orientation."""
    own = right_handed(forest)
    if not ((particles >= 0).all() and (particles + len(forest.points) <= model.particle_count).all()):
        return False
    corners = forest.points[own]
    shapes = _shapes(np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)))
    size = np.abs(shapes).max(axis=(1, 2), keepdims=True)
    poses = model.tet_poses.numpy().reshape(-1, 3, 3)
    for p, t in zip(particles, first, strict=True):
        if not np.array_equal(tets[t : t + len(own)], own + p):
            return False
        if not (np.abs(_shapes(poses[t : t + len(own)].astype(np.float64)) - shapes) < 1e-4 * size).all():
            return False
    return True


def _shapes(poses: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """The part of inverse rest matrices B that does not depend on rotation, B B^T."""
    return poses @ np.swapaxes(poses, 1, 2)


def _squeezed(values: npt.NDArray[np.float64]) -> npt.NDArray[np.float64] | float:
    """[copies, T], or one number if all are equal to float32 rounding, so that kernels read only one."""
    one = float(values.flat[0])
    return one if np.allclose(values, one, rtol=2e-7, atol=0.0) else values
