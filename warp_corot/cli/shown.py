"""A frame of all bodies as pictures show it, and as it waits on the disk."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import IO, TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

    from .bodies import Body


@dataclass
class Shown:
    """A frame: moved points, triangles, values at the points, points at rest, which are held, and the time [s]."""

    positions: np.ndarray
    triangles: np.ndarray
    values: np.ndarray
    rest: np.ndarray
    held: np.ndarray
    time: float

    def write(self, file: IO[bytes]) -> None:
        for array in (self.positions, self.triangles, self.values, self.rest, self.held, np.float64(self.time)):
            np.save(file, array, allow_pickle=False)

    @classmethod
    def read(cls, file: IO[bytes]) -> Shown:
        positions, triangles, values, rest, held, time = (np.load(file, allow_pickle=False) for _ in range(6))
        return cls(positions, triangles, values, rest, held, float(time))


def shown_now(bodies: Sequence[Body], sim: Simulation) -> Shown:
    """The present state of all bodies as it is drawn."""
    from warp_corot.io.pictures.colors import VertexAverage
    from warp_corot.io.write.skins import BoundSkins
    from warp_corot.mesh.surfaces.boundary import signed_volumes

    moved: list[np.ndarray] = []
    rest: list[np.ndarray] = []
    triangles, values, held = [], [], []
    for body in bodies:
        subject, mesh = body.subject, body.soft.mesh
        drawn = subject.skin or subject.surface
        average = VertexAverage(mesh.tets, np.abs(signed_volumes(mesh.points, mesh.tets)), len(mesh.points))
        stress = average(sim.von_mises(body.soft))
        for skin in BoundSkins([mesh], drawn, changing=[mesh is not subject.mesh]).on([mesh]):
            triangles.append(skin.surface.triangles + sum(len(points) for points in rest))
            moved.append(skin.surface.moved(body.soft.displacements.numpy()))
            rest.append(skin.surface.points)
            values.append(skin.values(stress))
            held.append(skin.values(body.soft.constrained.astype(float)) > 0.5)
    arrays = [np.concatenate(each) for each in (moved, triangles, values, rest, held)]
    return Shown(
        arrays[0].astype(np.float32), arrays[1], arrays[2].astype(np.float32), arrays[3], arrays[4], time=sim.time
    )
