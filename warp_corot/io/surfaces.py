"""Triangle surfaces from files: .obj .stl .ply .off .glb through trimesh, Mesh prims of USD stages."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Tf, Usd, UsdGeom

from ..errors import InputError
from .assets import ASSETS, Asset, find_asset
from .formats import USD_SUFFIXES
from .usd_files import usd_name

#: What trimesh reads here, and the up axis by habit where the format names none; glTF's is its standard's.
UP_AXES = {".obj": "Y", ".stl": "Z", ".ply": "Z", ".off": "Z", ".glb": "Y", ".gltf": "Y"}
GLTF = (".glb", ".gltf")

SURFACE_ASSETS: dict[str, Asset] = {
    "bunny": Asset(
        name="bunny",
        file="examples/assets/bunny.usd",
        scale=0.1,
        young=3.0e4,
        poisson=0.45,
        density=1000.0,
        fix="y < 0.01",
        damping=2.0,
        duration=4.0,
        note="the Stanford bunny, 16 cm long, of silicone gel",
    )
}


@dataclass(frozen=True)
class LoadedSurface:
    """A triangle surface as it came from a file.

    Attributes:
        points: float64 [N, 3] in the file's unit; an asset's scaled to a likely size.
        triangles: int32 [T, 3], wound as in the file.
        metres: Metres in that unit, None if the file does not say.
        up_axis: "X", "Y" or "Z"; None if the file does not say.
        name: Short name, fit for a title.
        source: The file it was read from.
        notes: What the user should know, a line each.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int32]
    metres: float | None
    up_axis: str | None
    name: str
    source: Path
    notes: list[str] = field(default_factory=list)


def load_surface(path: str | PathLike[str]) -> LoadedSurface:
    """Reads all triangles of a file, placed as its scene places them; polygons are cut into fans.

    Args:
        path: A file, or ``warp:NAME`` for one in Warp's wheel.

    Raises:
        InputError: No such file, another format, not readable, or no triangles in it; one line that says which.
    """
    asset = find_surface_asset(path)
    source = asset.path if asset else Path(path)
    if source.is_dir():
        raise InputError(f"{source}: is a folder, should be a surface file")
    if not source.exists():
        raise InputError(f"{source}: no such file")
    if not source.stat().st_size:
        raise InputError(f"{source}: is empty")
    suffix = source.suffix.lower()
    metres: float | None
    up_axis: str | None
    if suffix in USD_SUFFIXES:
        points, triangles, metres, up_axis, notes = _read_usd(source)
    elif suffix in UP_AXES:
        points, triangles, notes = _read_trimesh(source)
        metres = 1.0 if suffix in GLTF else None
        up_axis = UP_AXES[suffix] if suffix in GLTF else None
    else:
        known = ", ".join((*UP_AXES, *USD_SUFFIXES))
        raise InputError(f"{source}: unknown format {suffix or '(no extension)'}, should be {known}")
    if not len(triangles):
        raise InputError(f"{source}: has no triangles")
    if asset:
        points = points * asset.scale
        notes.append(f"scaled by {asset.scale:g}: {asset.note}")
    name = asset.name if asset else os.fsencode(source.stem).decode("utf-8", "replace")
    return LoadedSurface(points, triangles.astype(np.int32), metres, up_axis, name, source, notes)


def find_surface_asset(name: str | PathLike[str]) -> Asset | None:
    """The asset that ``warp:NAME`` names, None for a name without ``warp:``.

    Raises:
        InputError: ``warp:`` and no such asset.
    """
    prefix, colon, rest = str(name).partition(":")
    if prefix == "warp" and colon:
        if rest not in SURFACE_ASSETS and rest not in ASSETS:
            known = ", ".join(f"warp:{known}" for known in (*SURFACE_ASSETS, *ASSETS))
            raise InputError(f"warp:{rest}: no such asset, should be {known}")
        return SURFACE_ASSETS.get(rest) or find_asset(name)
    return None


def _read_trimesh(path: Path) -> tuple[NDArray[np.float64], NDArray[Any], list[str]]:
    try:
        import trimesh
    except ImportError:
        raise InputError(f'{path}: reading {path.suffix} files needs: pip install "warp-corot[surface]"') from None
    try:
        scene = trimesh.load_scene(path, process=False)
        mesh = scene.to_mesh()
        points, triangles = np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces)
    except Exception as error:
        why = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: is not a {path.suffix} file that trimesh can read triangles from ({why})") from None
    return points.reshape(-1, 3), triangles.reshape(-1, 3), []


def _read_usd(path: Path) -> tuple[NDArray[np.float64], NDArray[Any], float, str, list[str]]:
    try:
        stage = Usd.Stage.Open(usd_name(path))
    except Tf.ErrorException:
        raise InputError(f"{path}: is not a USD file that OpenUSD can open") from None
    metres = float(UsdGeom.GetStageMetersPerUnit(stage))
    if not (np.isfinite(metres) and metres > 0.0):
        raise InputError(f"{path}: metersPerUnit is {metres}, should be a positive number")
    time = Usd.TimeCode.EarliestTime()
    cache = UsdGeom.XformCache(time)
    all_points, all_triangles, notes, offset = [np.empty((0, 3))], [np.empty((0, 3), np.int64)], [], 0
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Mesh):
            continue
        mesh = UsdGeom.Mesh(prim)
        if mesh.ComputePurpose() in ("guide", "proxy"):
            continue
        points, triangles = mesh_triangles(mesh, path, time)
        if not len(triangles):
            continue
        world = np.array(cache.GetLocalToWorldTransform(prim), dtype=np.float64)
        mirrored = np.linalg.det(world[:3, :3]) < 0.0
        if mirrored != (mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded):
            triangles = triangles[:, ::-1]
        if mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none:
            notes.append(f"{prim.GetPath()} is a subdivision surface, taken as its control mesh")
        all_points.append(points @ world[:3, :3] + world[3, :3])
        all_triangles.append(triangles + offset)
        offset += len(points)
    return np.concatenate(all_points), np.concatenate(all_triangles), metres, str(UsdGeom.GetStageUpAxis(stage)), notes


def mesh_triangles(mesh: UsdGeom.Mesh, path: Path, time: Usd.TimeCode) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Points and the fans of a mesh's polygons, less its holes."""
    points = np.asarray(_earliest(mesh.GetPointsAttr(), time), dtype=np.float64).reshape(-1, 3)
    counts = np.asarray(_earliest(mesh.GetFaceVertexCountsAttr(), time), dtype=np.int64)
    indices = np.asarray(_earliest(mesh.GetFaceVertexIndicesAttr(), time), dtype=np.int64)
    if (counts < 3).any() or counts.sum() != len(indices):
        raise InputError(f"{mesh.GetPath()} in {path}: its faces name {len(indices)} corners, should be {counts.sum()}")
    bad = indices[(indices < 0) | (indices >= len(points))]
    if len(bad):
        raise InputError(f"{path}: prim {mesh.GetPath()} names point {bad[0]} but has points 0 to {len(points) - 1}")
    holes = np.asarray(_earliest(mesh.GetHoleIndicesAttr(), time), dtype=np.int64)
    kept = np.ones(len(counts), bool)
    kept[holes[holes < len(counts)]] = False
    starts = (np.cumsum(counts) - counts)[kept]
    fans = counts[kept] - 2
    first = np.repeat(starts, fans)
    step = np.arange(fans.sum()) - np.repeat(np.cumsum(fans) - fans, fans)
    return points, np.stack([indices[first], indices[first + step + 1], indices[first + step + 2]], axis=1)


def _earliest(attribute: Usd.Attribute, time: Usd.TimeCode) -> Any:
    """An attribute's value by default, or at the first time there is; empty without one."""
    value = attribute.Get()
    if value is None:
        value = attribute.Get(time)
    return () if value is None else value
