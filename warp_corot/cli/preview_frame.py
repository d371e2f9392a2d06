"""A frame of all bodies for pictures, and its form on the disk."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING

import numpy as np

from warp_corot.contact.shapes import Ground

if TYPE_CHECKING:
    from warp_corot.discretization.elements import Mesh
    from warp_corot.io.write.skins import Skin
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

    def write(self, file: IO[bytes]) -> None:
        arrays = (self.positions, self.triangles, self.values, self.rest, self.held, self.ground)
        for array in (*arrays, np.float64(self.time)):
            np.save(file, array, allow_pickle=False)

    @classmethod
    def read(cls, file: IO[bytes]) -> PreviewFrame:
        x, faces, values, rest, held, ground, time = (np.load(file, allow_pickle=False) for _ in range(7))
        return cls(x, faces, values, rest, held, ground, float(time))


class DrawnBody:
    """What is drawn of a body: its skins and its stresses, bound again when its mesh has changed."""

    def __init__(self, body: RunBody):
        from warp_corot.io.write.skins import BoundSkins

        self.soft = body.soft
        self._mesh: Mesh | None = None
        subject, mesh = body.subject, body.soft.mesh
        self._skins = BoundSkins([mesh], subject.skin or subject.surface, changing=[mesh is not subject.mesh])

    def skins(self) -> list[Skin]:
        return self._skins.on([self.soft.mesh])

    def stress(self, sim: Simulation) -> np.ndarray:
        """Von Mises stress at the nodes [Pa], [N]."""
        from warp_corot.io.pictures.colors import VertexAverage
        from warp_corot.mesh.surfaces.boundary import signed_volumes

        mesh = self.soft.mesh
        if mesh is not self._mesh:
            volumes = np.abs(signed_volumes(mesh.points, mesh.tets))
            self._mesh, self._average = mesh, VertexAverage(mesh.tets, volumes, len(mesh.points))
        return self._average(sim.von_mises(self.soft))


def preview_frame(bodies: Sequence[DrawnBody], sim: Simulation) -> PreviewFrame:
    """The current state of all bodies for drawing."""
    moved: list[np.ndarray] = []
    rest: list[np.ndarray] = []
    triangles, values, held = [], [], []
    for body in bodies:
        stress = body.stress(sim)
        for skin in body.skins():
            triangles.append(skin.surface.triangles + sum(len(points) for points in rest))
            moved.append(skin.surface.moved(body.soft.displacements.numpy()))
            rest.append(skin.surface.points)
            values.append(skin.values(stress))
            held.append(skin.values(body.soft.constrained.astype(float)) > 0.5)
    ground = _ground(sim, np.concatenate(rest))
    for points, faces in _solids(sim):
        triangles.append(faces + sum(len(points) for points in rest))
        moved.append(points)
        rest.append(points)
        values.append(np.full(len(points), np.nan))
        held.append(np.zeros(len(points), bool))
    arrays = [np.concatenate(each) for each in (moved, triangles, values, rest, held)]
    return PreviewFrame(
        arrays[0].astype(np.float32), arrays[1], arrays[2].astype(np.float32), arrays[3], arrays[4], ground, sim.time
    )


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
