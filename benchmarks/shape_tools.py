"""Building blocks of difficult bodies: simple closed surfaces, joined, moved, bent, extruded."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import trimesh

Surface = tuple[np.ndarray, np.ndarray]

SHAPES: dict[str, Callable[[], Surface]] = {}


def shape(make: Callable[[], Surface]) -> Callable[[], Surface]:
    """Put a shape into the table under its function's name."""
    SHAPES[make.__name__.replace("_", "-")] = make
    return make


def arrays(mesh: trimesh.Trimesh) -> Surface:
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def together(*surfaces: Surface) -> Surface:
    """Several closed surfaces as one, whether they overlap or not."""
    starts = np.cumsum([0, *(len(points) for points, _ in surfaces)])
    triangles = [tri + start for (_, tri), start in zip(surfaces, starts[:-1], strict=True)]
    return np.concatenate([points for points, _ in surfaces]), np.concatenate(triangles)


def moved(surface: Surface, by=(0.0, 0.0, 0.0), axes=None) -> Surface:
    points, triangles = surface
    return (points if axes is None else points @ np.asarray(axes).T) + np.asarray(by), triangles


def inverted(surface: Surface) -> Surface:
    return surface[0], surface[1][:, ::-1]


def box(x: float, y: float, z: float, at=(0.0, 0.0, 0.0)) -> Surface:
    return moved(arrays(trimesh.creation.box((x, y, z))), at)


def ball(radius: float, at=(0.0, 0.0, 0.0), fineness: int = 4) -> Surface:
    return moved(arrays(trimesh.creation.icosphere(fineness, radius)), at)


def capsule(radius: float, start, end) -> Surface:
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length
    rotation = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis)[:3, :3]
    points, triangles = ball(radius, fineness=3)
    points[:, 2] += length * (points[:, 2] > 0.0)
    return moved((points, triangles), start, rotation)


def grid(rows: int, columns: int, *, closed_rows: bool = False, closed_columns: bool = False) -> np.ndarray:
    """Triangles of a sheet of rows × columns points, wound around rows first."""
    r = np.arange(rows if closed_rows else rows - 1)
    c = np.arange(columns if closed_columns else columns - 1)
    i, j = (a.ravel() for a in np.meshgrid(r, c, indexing="ij"))
    k, m = (i + 1) % rows, (j + 1) % columns
    a, b, d, e = (x * columns + y for x, y in ((i, j), (k, j), (k, m), (i, m)))
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, e], 1)])


def tube(line: np.ndarray, radius: float | np.ndarray, *, closed: bool = False, around: int = 24) -> Surface:
    """A tube around a line [n, 3], its ends closed by caps or joined."""
    n = len(line)
    ahead, behind = (np.roll(line, -1, 0), np.roll(line, 1, 0)) if closed else (line[1:], line[:-1])
    along = ahead - behind if closed else np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    sides = np.empty((n, 3))
    for k in range(n):  # transported without twist
        side = side - (side @ along[k]) * along[k]
        side /= np.linalg.norm(side)
        sides[k] = side
    if closed:  # the twist after one turn is distributed
        last = sides[-1] - (sides[-1] @ along[0]) * along[0]
        twist = np.arctan2(last @ np.cross(along[0], sides[0]), last @ sides[0])
        angle = -twist * np.arange(n) / n
        sides = np.cos(angle)[:, None] * sides + np.sin(angle)[:, None] * np.cross(along, sides)
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = (
        np.cos(angle)[None, :, None] * sides[:, None] + np.sin(angle)[None, :, None] * np.cross(along, sides)[:, None]
    )
    points = (line[:, None] + np.broadcast_to(radius, n)[:, None, None] * ring).reshape(-1, 3)
    triangles = grid(n, around, closed_rows=closed, closed_columns=True)[:, ::-1]
    if closed:
        return points, triangles
    first, last = len(points), len(points) + 1
    j = np.arange(around)
    m = (j + 1) % around
    caps = [np.stack([np.full(around, first), m, j], 1)]
    caps += [np.stack([np.full(around, last), (n - 1) * around + j, (n - 1) * around + m], 1)]
    return np.concatenate([points, line[[0, -1]]]), np.concatenate([triangles, *caps])


def prism(outline: np.ndarray, height: float) -> Surface:
    """A star-shaped outline [n, 2] about the origin, counter-clockwise, extruded along z."""
    n = len(outline)
    j = np.arange(n)
    k = (j + 1) % n
    low, high = (np.column_stack([outline, np.full(n, z)]) for z in (0.0, height))
    points = np.concatenate([low, high, [[0, 0, 0], [0, 0, height]]])
    walls = [np.stack([j, k, n + k], 1), np.stack([j, n + k, n + j], 1)]
    caps = [np.stack([k, j, np.full(n, 2 * n)], 1), np.stack([n + j, n + k, np.full(n, 2 * n + 1)], 1)]
    return points, np.concatenate([*walls, *caps])


def bent(surface: Surface, where: Callable[[np.ndarray], np.ndarray]) -> Surface:
    return where(surface[0]), surface[1]


def fine_box(x: float, y: float, z: float, pitch: float) -> Surface:
    """A box with triangles small enough to be bent."""
    mesh = trimesh.creation.box((x, y, z))
    points, triangles = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, pitch, max_iter=12)
    merged = trimesh.Trimesh(points, triangles, process=False)
    merged.merge_vertices()
    return arrays(merged)


def turned(degrees: float = 30.0) -> np.ndarray:
    return trimesh.transformations.rotation_matrix(np.radians(degrees), [1.0, 2.0, 3.0])[:3, :3]


def unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a)
