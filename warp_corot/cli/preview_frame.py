"""What pictures show of all bodies and obstacles at one time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.contact.shapes import Ground

if TYPE_CHECKING:
    from warp_corot.io.pictures.colors import VertexAverage
    from warp_corot.simulation.simulation import Simulation

    from .bodies import RunBody


@dataclass
class PreviewFrame:
    """A frame: moved points, triangles, values at the points (NaN on obstacles), rest positions, held nodes, corners of
    the ground [4, 3] or [0, 3], and the time [s]."""

    positions: np.ndarray
    triangles: np.ndarray
    values: np.ndarray
    rest: np.ndarray
    held: np.ndarray
    ground: np.ndarray
    time: float


class DrawnBodies:
    """What is drawn of bodies: their skins and their stresses, bound again when a mesh has changed."""

    def __init__(self, bodies: Sequence[RunBody]):
        from warp_corot.io.write.skins import BoundSkins

        self._soft = [body.soft for body in bodies]
        # All bodies of a simulation can be cut, or none.
        are_cut = all(soft.changing is not None and soft.changing.is_cut for soft in self._soft)
        own = [None if are_cut else body.subject.skin for body in bodies]
        drawn = [skin or body.subject.surface for body, skin in zip(bodies, own, strict=True)]
        changing = [body.soft.mesh is not body.subject.mesh for body in bodies]
        self._skins = BoundSkins([soft.mesh for soft in self._soft], drawn, changing=changing, are_cut=are_cut)
        self._averages: dict[int, tuple[Any, VertexAverage]] = {}

    def frame(self, sim: Simulation) -> PreviewFrame:
        """The current state."""
        u, held = (np.concatenate(each) for each in zip(*map(_state_of, self._soft), strict=True))
        stress = np.concatenate([self._stress(k, sim) for k in range(len(self._soft))])
        parts: list[tuple[np.ndarray, ...]] = [
            (skin.surface.moved(u), skin.surface.triangles, skin.values(stress), skin.surface.points, skin.values(held))
            for skin in self._skins.on([soft.mesh for soft in self._soft])
        ]
        ground = _ground(sim, np.concatenate([part[3] for part in parts]))
        for points, faces in _solids(sim):
            parts.append((points, faces, np.full(len(points), np.nan), points, np.zeros(len(points))))
        firsts = np.cumsum([0, *(len(part[0]) for part in parts)])
        moved, faces, values, rest, fixed = zip(*parts, strict=True)
        return PreviewFrame(
            np.concatenate(moved).astype(np.float32),
            np.concatenate([triangles + first for triangles, first in zip(faces, firsts, strict=False)]),
            np.concatenate(values).astype(np.float32),
            np.concatenate(rest),
            np.concatenate(fixed) > 0.5,
            ground,
            sim.time,
        )

    def _stress(self, k: int, sim: Simulation) -> np.ndarray:
        """Von Mises stress at the nodes of a body [Pa], [N]."""
        from warp_corot.io.pictures.colors import VertexAverage
        from warp_corot.mesh.surfaces.boundary import signed_volumes

        mesh = self._soft[k].mesh
        if k not in self._averages or self._averages[k][0] is not mesh:
            volumes = np.abs(signed_volumes(mesh.points, mesh.tets))
            self._averages[k] = mesh, VertexAverage(mesh.tets, volumes, len(mesh.points))
        return self._averages[k][1](sim.von_mises(self._soft[k]))


def _state_of(soft: Any) -> tuple[np.ndarray, np.ndarray]:
    """Displacements [m], [N, 3], and one where nodes are held, [N]."""
    return soft.displacements.numpy(), soft.constrained.astype(float)


def _solids(sim: Simulation) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Points [m] and triangles of the obstacles where they are."""
    from warp_corot.io.write.solids import poses_of, shape_of, solid_of

    given = () if sim.contact is None else sim.contact.obstacles.given
    for each, pose in zip(given, poses_of(given), strict=True):
        solid = solid_of(shape_of(each))
        if solid is not None:
            yield solid.at(pose), solid.triangles


def _ground(sim: Simulation, points: np.ndarray) -> np.ndarray:
    """Corners of a square of the first ground below the bodies [4, 3]; [0, 3] without."""
    from warp_corot.io.write.solids import ground_corners, shape_of

    given = () if sim.contact is None else sim.contact.obstacles.given
    grounds = [shape for shape in map(shape_of, given) if isinstance(shape, Ground)]
    return ground_corners(grounds[0], points) if grounds else np.zeros((0, 3))
