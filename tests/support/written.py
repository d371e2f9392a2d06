"""A cube whose frames tests write to stages."""

import numpy as np


class Cube:
    """Two of the six path tetrahedra of a cube, one of them mirrored, and an unused node."""

    points = np.array(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [1, 1, 1], [0, 1, 0], [0.5, 0.5, 0.5]], dtype=np.float64
    )  # fmt: skip
    tets = np.array([[0, 1, 2, 3], [0, 4, 2, 3]], dtype=np.int32)
    up_axis = "Z"


def frames_of(mesh, count: int):
    """Positions, velocities and stresses that differ in every frame."""
    for index in range(count):
        noise = np.random.default_rng(index)
        yield (
            (mesh.points + 0.1 * noise.standard_normal(mesh.points.shape)).astype(np.float32),
            noise.standard_normal(mesh.points.shape).astype(np.float32),
            (100.0 * (index + 1) * noise.random(len(mesh.tets))).astype(np.float32),
        )
