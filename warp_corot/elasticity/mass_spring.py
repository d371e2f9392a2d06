"""Mass-spring network on the edges of the mesh: the classic baseline."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels.constitutive import stvk_cauchy
from ..kernels.forces import element_von_mises
from ..kernels.springs import mass_spring_energies, scatter_mass_spring
from .model import ForceField, Model

if TYPE_CHECKING:
    from ..body import SoftBody


@dataclass(frozen=True)
class MassSpring(Model):
    """W = sum over edges of k/2 (l - L)^2, with k = sum of E V / L^2 over the tetrahedra around an edge.

    The stiffness is Van Gelder's (1998) carried to three dimensions: averaged over all directions of edges it gives
    Young's modulus E with Poisson's ratio 1/4. Springs between pairs of points cannot have any other ratio, so the
    material's own is ignored. Von Mises stress is that of Hooke's law with E and 1/4 on the Green strain.
    """

    def bind(self, body: SoftBody) -> ForceField:
        return MassSpringField(body)


class MassSpringField(ForceField):
    def __init__(self, body: SoftBody):
        super().__init__(body)
        points, tets = body.mesh.points, body.mesh.tets
        pairs = np.stack([tets[:, [i, j]] for i, j in itertools.combinations(range(4), 2)], axis=1)
        lengths = np.linalg.norm(points[pairs[..., 1]] - points[pairs[..., 0]], axis=-1)
        young = np.broadcast_to(body.material.young, len(tets))
        shares = (young * body.mesh.volumes)[:, None] / lengths**2
        key = pairs.min(axis=-1).astype(np.int64) * len(points) + pairs.max(axis=-1)
        unique, which = np.unique(key.ravel(), return_inverse=True)
        edges = np.stack([unique // len(points), unique % len(points)], axis=1)
        rest = points[edges[:, 1]] - points[edges[:, 0]]
        self._edges = wp.array(edges, dtype=wp.vec2i, device=self.device)
        self._rest = wp.array(rest, dtype=wp.vec3, device=self.device)
        self._stiffness = wp.array(np.bincount(which.ravel(), shares.ravel()), dtype=wp.float32, device=self.device)
        # Lamé's parameters of E and nu = 1/4 are both 0.4 E.
        lame = np.atleast_1d(0.4 * np.asarray(body.material.young))
        self._lame = wp.array(lame, dtype=wp.float32, device=self.device)
        self._lame_stride = int(len(lame) > 1)
        self._von_mises = element_von_mises(body.element_kind, stvk_cauchy)

    @property
    def energy_count(self) -> int:
        return len(self._edges)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self.launch(scatter_mass_spring, len(self._edges), [self._edges, self._rest, self._stiffness, u], [f])

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        inputs = [self._edges, self._rest, self._stiffness, u]
        self.launch(mass_spring_energies, len(self._edges), inputs, [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        inputs = [self.elements, self._lame, self._lame, self._lame_stride, u]
        self.launch(self._von_mises, self.element_count, inputs, [stress])
