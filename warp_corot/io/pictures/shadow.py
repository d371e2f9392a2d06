"""Soft shadows on the ground of a picture."""

from typing import TYPE_CHECKING

import numpy as np

from .camera import Array, Camera

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def draw_shadow(ax: "Axes", triangles: Array, camera: Camera, height: float, cells: int = 120) -> Array:
    """Draw a soft shadow on the ground: the body's points projected along the light, counted in cells and blurred.

    Returns the picture coordinates [n, 2] of the cells that are visibly dark.
    """
    from matplotlib.collections import QuadMesh
    from scipy.ndimage import gaussian_filter

    up = camera.world_up
    right = camera.axes[0]
    back = np.cross(up, right)  # with ``right`` it spans the ground
    bary = np.random.default_rng(0).dirichlet((1.0, 1.0, 1.0), size=max(1, 40_000 // len(triangles)))
    points = np.einsum("sb,fbx->fsx", bary, triangles).reshape(-1, 3)
    dropped = dropped_shadow(points, camera, height)
    flat = np.stack([dropped @ right, dropped @ back], axis=1)
    low, high = flat.min(axis=0), flat.max(axis=0)
    margin = 0.22 * float((high - low).max()) + 1e-12
    low, high = low - margin, high + margin
    dark = np.zeros((cells, cells))
    dark[tuple(np.minimum((flat - low) / (high - low) * cells, cells - 1).astype(int).T)] = 1.0
    # Two widths: a tight contact shadow within a wide soft one.
    dark = 0.5 * gaussian_filter(dark, 0.012 * cells) + 0.5 * gaussian_filter(dark, 0.05 * cells)
    middles = low + (np.arange(cells)[:, None] + 0.5) / cells * (high - low)
    u, v = np.meshgrid(*middles.T, indexing="ij")
    ground = u[..., None] * right + v[..., None] * back + height * up
    picture, _ = camera.project(ground)
    # Opaque on white: transparent cells that overlap by part of a pixel would show their seams.
    tint = 1.0 - 0.26 * dark[..., None] * (1.0 - np.array([0.20, 0.20, 0.27]))
    mesh = QuadMesh(picture, facecolor=tint[:-1, :-1].reshape(-1, 3), antialiased=False, zorder=0)
    ax.add_collection(mesh, autolim=False)
    return picture[dark > 0.2]


def dropped_shadow(points: Array, camera: Camera, height: float) -> Array:
    """Projections of points [n, 3] along the light onto the ground [n, 3]."""
    up, right = camera.world_up, camera.axes[0]
    light = -0.30 * right + 1.0 * up - 0.12 * np.cross(up, right)
    lift = np.maximum(points @ up - height, 0.0)
    return points - lift[:, None] / (light @ up) * light
