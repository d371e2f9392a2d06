"""Pictures of a world of an environment."""

from __future__ import annotations

from collections.abc import Iterable
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Shape, Vector
from warp_corot.errors import InputError
from warp_corot.io.pictures.colors import VertexAverage
from warp_corot.io.pictures.drawing import Camera, Window, render
from warp_corot.io.write.skins import solid_of
from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.tetmesh import TetMesh
from warp_corot.simulation.simulation import Simulation

#: Pixels of a picture.
SIZE = np.array([480, 360])
#: Von Mises stress at the end of the colours [Pa].
MOST = 6e3


def draw(
    sim: Simulation,
    mesh: TetMesh | TetForest,
    rigid: Iterable[tuple[Shape, npt.NDArray[np.float64]]],
    window: tuple[Vector, Vector],
    view: tuple[float, float],
    world: int = 0,
) -> npt.NDArray[np.uint8]:
    """Tissue, coloured by its von Mises stress, and rigid shapes, uint8 [height, width, 3]; waits for the device.

    Args:
        sim: The simulation of the tissue.
        mesh: Its mesh.
        rigid: Shapes, and their poses [7].
        window: Lowest and highest corner of what is shown [m].
        view: Azimuth and elevation of the camera [°].
        world: Which world is shown.

    Raises:
        InputError: Pillow is not installed.
    """
    if find_spec("PIL") is None:
        raise InputError('pictures need Pillow: pip install "warp-corot[plot]"')
    body = sim.body
    copy = body.world(world)
    average = VertexAverage(mesh.tets, mesh.volumes, len(mesh.points))
    points, faces = [copy.positions.numpy().astype(np.float64)], [body.surface_triangles]
    values = [average(sim.von_mises()[copy.elements])]
    for shape, pose in rigid:
        if (solid := solid_of(shape)) is not None:
            faces.append(solid.triangles + sum(map(len, points)))
            points.append(solid.at(pose))
            values.append(np.full(len(points[-1]), np.nan))
    low, high = window
    camera = Camera.fit(np.array([low, high]), "Z", *view)
    corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    seen = camera.project(corners)[0]
    middle, half = 0.5 * (seen.min(axis=0) + seen.max(axis=0)), 0.5 * (np.ptp(seen, axis=0) / SIZE).max() * SIZE
    frame = Window(middle - half, middle + half, (SIZE[0], SIZE[1]))
    options: dict[str, Any] = {"value_range": (0.0, MOST), "ground": 0.0, "scalars": np.concatenate(values)}
    return render(frame, camera, np.concatenate(points), np.concatenate(faces), **options)
