"""Mesh and TetMesh prims of USD stages: triangles in the world, and tetrahedra."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Usd, UsdGeom

from warp_corot.errors import InputError
from warp_corot.io.files.usd import first_value, in_world, metres_per_unit, open_stage, reads_stage, world_matrix
from warp_corot.io.read.filemesh import Block, FileMesh, joined_triangles, sets_of_numbers

# --- surfaces --------------------------------------------------------------------------------------------------------


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


# --- tetrahedra: `UsdGeom.TetMesh` prims, and Mesh prims that carry ``tetraIndices`` ---------------------------------


@reads_stage
def read_usd_tets(path: Path) -> FileMesh:
    """The tetrahedra of all prims of a stage, joined, in world space; none if no prim has any.

    The rest shape is the primvar ``rest`` if there is one (as in files of `UsdWriter`), else ``points`` at
    the default time, else at the first time sample, also if the mesh changes over time. Inactive and abstract
    prims are left out; instances are read. Node sets come from primvars of whole numbers.

    Args:
        path: A .usd, .usda, .usdc or .usdz file.

    Raises:
        InputError: The file is not a USD stage, or its indices are not a multiple of four or name no points.
    """
    stage = open_stage(path)
    all_points: list[NDArray[np.float64]] = [np.empty((0, 3))]
    blocks: list[Block] = []
    prims: list[tuple[str, int]] = []
    sets: dict[str, list[NDArray[np.int64]]] = {}
    offset = 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        indices = _tet_indices(prim, path)
        if indices is None or len(indices) == 0:
            continue
        points = _rest_points(prim, path)
        if indices.min() < 0 or indices.max() >= len(points):
            bad = indices[(indices < 0) | (indices >= len(points))][0]
            raise InputError(f"{path}: prim {prim.GetPath()} names point {bad} but has points 0 to {len(points) - 1}")
        all_points.append(in_world(prim, points))
        blocks.append(Block("tetra", indices + offset))
        name, taken = prim.GetName(), {known for known, _ in prims}
        prims.append((name if name not in taken else f"{name}_{len(prims) + 1}", len(indices)))
        for known, nodes in _node_sets(prim, len(points)).items():
            sets.setdefault(known, []).append(nodes + offset)
        offset += len(points)
    return FileMesh(
        np.concatenate(all_points),
        blocks,
        node_sets={known: np.concatenate(parts) for known, parts in sets.items()},
        metres=metres_per_unit(stage, path),
        up_axis=str(UsdGeom.GetStageUpAxis(stage)),
        objects=prims if len(prims) > 1 else [],
    )


def _node_sets(prim: Any, count: int) -> dict[str, NDArray[np.int64]]:
    """The node sets that a prim's primvars of whole numbers define."""
    found: dict[str, NDArray[np.int64]] = {}
    for primvar in UsdGeom.PrimvarsAPI(prim).GetPrimvars():
        if primvar.GetInterpolation() != UsdGeom.Tokens.vertex or primvar.IsIndexed():
            continue
        values = np.asarray(first_value(primvar))
        if values.shape == (count,) and values.dtype.kind in "iub":
            found |= sets_of_numbers(primvar.GetPrimvarName().replace(":", "_"), values.astype(np.int64))
    return found


def _tet_indices(prim, path: Path) -> NDArray[np.int64] | None:
    """Tetrahedra [T, 4] of a prim, or None if it has none."""
    if prim.IsA(UsdGeom.TetMesh):
        attribute = UsdGeom.TetMesh(prim).GetTetVertexIndicesAttr()
    elif prim.IsA(UsdGeom.PointBased) and prim.HasAttribute("tetraIndices"):
        attribute = prim.GetAttribute("tetraIndices")
    else:
        return None
    value = first_value(attribute)
    if value is None:
        return None
    flat = np.asarray(value).reshape(-1)
    if flat.dtype.kind not in "iu":
        raise InputError(f"{path}: {attribute.GetPath()} is of type {attribute.GetTypeName()}; it must be integers")
    if len(flat) % 4:
        raise InputError(f"{path}: {attribute.GetPath()} has {len(flat)} indices, not a multiple of four")
    return flat.astype(np.int64).reshape(-1, 4)


def _rest_points(prim, path: Path) -> NDArray[np.float64]:
    """Points [N, 3] of a prim at rest, in its own space."""
    value = first_value(UsdGeom.PointBased(prim).GetPointsAttr())
    if value is None or len(value) == 0:
        raise InputError(f"{path}: prim {prim.GetPath()} has tetrahedra but no points")
    rest = UsdGeom.PrimvarsAPI(prim).GetPrimvar("rest")
    if rest:
        rest_value = rest.ComputeFlattened()
        if rest_value is None:
            rest_value = rest.ComputeFlattened(Usd.TimeCode.EarliestTime())
        if rest_value is not None and len(rest_value) == len(value):
            value = rest_value
    return np.asarray(value, dtype=np.float64).reshape(-1, 3)
