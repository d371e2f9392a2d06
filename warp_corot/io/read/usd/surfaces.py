"""Mesh prims of USD stages as triangles in the world."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from warp_corot.errors import InputError
from warp_corot.io.files.usd import first_value, in_world, metres_per_unit, open_stage, reads_stage, world_matrix
from warp_corot.io.read.filemesh import FileMesh, joined_triangles


class DrawnMesh(NamedTuple):
    """A visible Mesh prim at its first time.

    Attributes:
        mesh: The prim, a `UsdGeom.Mesh`.
        points: Points in the world, in the stage's unit, float64 [N, 3].
        triangles: Fans of its faces without holes, int64 [T, 3], counter-clockwise seen from outside.
        faces: The face of each triangle, int64 [T].
        left_handed: Whether the listed faces have the other orientation in the world.
        smooth: Whether it is a subdivision surface.
    """

    mesh: Any
    points: NDArray[np.float64]
    triangles: NDArray[np.int64]
    faces: NDArray[np.int64]
    left_handed: bool
    smooth: bool


def drawn_meshes(stage: Any, path: Path) -> Iterator[DrawnMesh]:
    """The visible Mesh prims with faces, instances included.

    Raises:
        InputError: Faces that do not match their points.
    """
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        mesh = UsdGeom.Mesh(prim)
        if not mesh or mesh.ComputePurpose() in ("guide", "proxy"):
            continue
        points, triangles, faces = _triangles(mesh, path)
        if not len(triangles):
            continue
        left_handed = mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        left_handed ^= bool(np.linalg.det(world_matrix(prim)[:3, :3]) < 0.0)
        yield DrawnMesh(
            mesh,
            in_world(prim, points),
            triangles[:, ::-1] if left_handed else triangles,
            faces,
            left_handed,
            mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none,
        )


@reads_stage
def read_usd_surface(path: Path) -> FileMesh:
    """All visible Mesh prims of a stage as triangles in the world.

    Raises:
        InputError: The file is not a stage, or a damaged one.
    """
    stage = open_stage(path)
    drawn = list(drawn_meshes(stage, path))
    smooth = [each.mesh.GetPath() for each in drawn if each.smooth]
    return joined_triangles(
        [(each.mesh.GetPrim().GetName(), each.points, each.triangles) for each in drawn],
        notes=[f"{name} is a subdivision surface; its control mesh is used" for name in smooth],
        metres=metres_per_unit(stage, path),
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
    )


def _triangles(mesh: UsdGeom.Mesh, path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.int64]]:
    """Points, the fans of a mesh's polygons, without holes, and the polygon of each triangle."""
    points = _numbers(mesh.GetPointsAttr(), np.float64).reshape(-1, 3)
    counts, indices = _numbers(mesh.GetFaceVertexCountsAttr()), _numbers(mesh.GetFaceVertexIndicesAttr())
    if (counts < 3).any() or counts.sum() != len(indices):
        raise InputError(f"{path}: {mesh.GetPath()}: faces name {len(indices)} corners; they must name {counts.sum()}")
    bad = indices[(indices < 0) | (indices >= len(points))]
    if len(bad):
        raise InputError(f"{path}: prim {mesh.GetPath()} names point {bad[0]} but has points 0 to {len(points) - 1}")
    holes = _numbers(mesh.GetHoleIndicesAttr())
    kept = np.ones(len(counts), bool)
    kept[holes[(holes >= 0) & (holes < len(counts))]] = False
    starts = (np.cumsum(counts) - counts)[kept]
    fans = counts[kept] - 2
    first = np.repeat(starts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    triangles = np.stack([indices[first], indices[first + step + 1], indices[first + step + 2]], axis=1)
    return points, triangles, np.repeat(np.flatnonzero(kept), fans)


def _numbers(attribute: Usd.Attribute, dtype: Any = np.int64) -> NDArray[Any]:
    """An attribute's first value; empty without one."""
    value = first_value(attribute)
    return np.asarray(() if value is None else value, dtype=dtype)
