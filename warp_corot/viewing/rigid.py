"""Rigid obstacles as triangles, for the page."""

from __future__ import annotations

from typing import Any

import numpy as np

from warp_corot.contact.shapes import Ground, Shape
from warp_corot.io.write.solids import solid_of


def mesh_of(shape: Shape, extent: float) -> Any:
    """A shape in its own frame as a mesh of trimesh, which viser installs; None for a shape that cannot be drawn.

    Args:
        shape: A listed shape.
        extent: Half of the edge of a drawn half-space [m].
    """
    from trimesh import Trimesh, creation

    if isinstance(shape, Ground):
        thickness = 0.01 * extent
        below = np.eye(4)
        below[2, 3] = -0.5 * thickness
        return creation.box(extents=(2.0 * extent, 2.0 * extent, thickness), transform=below)
    solid = solid_of(shape)
    return None if solid is None else Trimesh(solid.points, solid.triangles, process=False)
