"""Points of a body's surface in the elements that it cuts."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing.surface_points import find_surface_points


def surface_points(
    lattice: wp.array, phi: wp.array, tets: np.ndarray, origin: Any, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """A point on the surface, or nearly, in each element that it cuts, and the direction inwards there, float64 [n, 3].

    Args:
        lattice: vec3i, of nodes.
        phi: float32, likewise.
        tets: Elements, int32 [n, 4].
        origin: Where the lattice begins [m].
        spacing: One of its intervals [m].
    """
    device = lattice.device
    points, inward = (wp.empty(len(tets), dtype=wp.vec3d, device=device) for _ in range(2))
    shared = [lattice, phi, wp.vec3d(*origin), wp.float64(spacing)]
    given = wp.array(tets, dtype=wp.vec4i, device=device)
    launch_side_by_side(
        find_surface_points, len(tets), lambda own: ([own(given), *shared], [own(points), own(inward)]), device
    )
    return points.numpy(), inward.numpy()
