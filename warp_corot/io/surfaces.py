"""Triangle surfaces from files: .obj .stl .ply .off .glb through trimesh, Mesh prims of USD stages."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .assets import find_asset
from .formats import USD_SUFFIXES

#: What trimesh reads here, and the up axis by habit where the format names none; glTF's is its standard's.
UP_AXES = {".obj": "Y", ".stl": "Z", ".ply": "Z", ".off": "Z", ".glb": "Y", ".gltf": "Y"}
GLTF = (".glb", ".gltf")


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
    asset = find_asset(path)
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
        from .usd_surfaces import read_usd_surface

        points, triangles, metres, up_axis, notes = read_usd_surface(source)
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
