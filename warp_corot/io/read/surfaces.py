"""Triangle surfaces from files: .obj .stl .ply .off .glb through trimesh, Mesh prims of USD stages, mesh files."""

from __future__ import annotations

from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from warp_corot.errors import InputError
from warp_corot.io.files.quiet import bounded, quietly

from .assets import find_asset
from .filemesh import FileImage, FileMesh, joined_triangles, triangles_of
from .files import checked_mesh, read_mesh_file, suffix_of
from .tetrahedra import USD_SUFFIXES, check_file, check_finite, read_tetrahedra, short_name

#: Formats read with trimesh, and the usual up axis if the format names none; glTF's is in its standard.
UP_AXES = {".obj": "Y", ".stl": "Z", ".ply": "Z", ".off": "Z", ".glb": "Y", ".gltf": "Y"}
GLTF = (".glb", ".gltf")


@dataclass(frozen=True)
class LoadedSurface:
    """A triangle surface from a file.

    Attributes:
        points: float64 [N, 3] in the file's unit; an asset is scaled to a likely size.
        triangles: int32 [T, 3], wound as in the file.
        metres: Metres in that unit, None if the file does not say.
        up_axis: "X", "Y" or "Z"; None if the file does not say.
        name: Short name for a title.
        source: The file.
        notes: Notes for the user, one line each.
        objects: Names of the file's objects and the number of triangles of each, in order.
    """

    points: NDArray[np.float64]
    triangles: NDArray[np.int32]
    metres: float | None
    up_axis: str | None
    name: str
    source: Path
    notes: list[str] = field(default_factory=list)
    objects: list[tuple[str, int]] = field(default_factory=list)


def load_surface(path: str | PathLike[str], *, found: FileMesh | None = None) -> LoadedSurface:
    """Read all triangles of a file, placed by its scene; polygons are cut into fans.

    Args:
        path: A file, or ``warp:NAME`` for one in Warp's wheel.
        found: The result of `read_file`, if the file was read before.

    Raises:
        InputError: The file does not exist, has another format, cannot be read, or has no triangles; one line says
            which.
    """
    asset = find_asset(path)
    source = asset.path if asset else Path(path)
    check_file(source, "surface")
    mesh = read_surface(source) if found is None else found
    if not isinstance(mesh, FileMesh):
        raise InputError(f"{source}: has no triangles (it holds an image)")
    if mesh.solids:
        raise InputError(f"{source}: has cells with volume, which TetMesh.load reads; it must have only triangles")
    check_finite(mesh.points, source)
    blocks = sorted(mesh.faces, key=lambda block: int(block.data.get("block", np.zeros(1))[0]))
    triangles = triangles_of(blocks)
    if not len(triangles):
        raise InputError(f"{source}: has no triangles")
    used, renumbered = np.unique(triangles, return_inverse=True)
    points, notes = mesh.points[used], list(mesh.notes)
    objects: dict[str, int] = {}
    for number, name in mesh.names.get("block", {}).items():
        own = [block for block in blocks if number in block.data.get("block", ())]
        if own:
            objects[name if name not in objects else f"{name} {number}"] = len(triangles_of(own))
    if asset:
        points = points * asset.scale
        notes.append(f"scaled by {asset.scale:g}: {asset.note}")
    return LoadedSurface(
        points,
        renumbered.reshape(-1, 3).astype(np.int32),
        mesh.metres,
        mesh.up_axis,
        asset.name if asset else short_name(source),
        source,
        notes,
        mesh.objects or list(objects.items()),
    )


def read_surface(path: Path) -> FileMesh | FileImage:
    """The triangles of a file: of USD stages those of Mesh prims.

    Raises:
        InputError: Another format, or it cannot be read.
    """
    suffix = path.suffix.lower()
    if suffix in USD_SUFFIXES:
        from warp_corot.io.read.usd.meshes import read_usd_surface

        return checked_mesh(read_usd_surface(path), path)
    if suffix in UP_AXES:
        about = {"metres": 1.0, "up_axis": UP_AXES[suffix]} if suffix in GLTF else {}
        placed = [(node, mesh.copy().apply_transform(matrix)) for mesh, matrix, node, _ in placed_meshes(path)]
        return checked_mesh(joined_triangles(((node, m.vertices, m.faces) for node, m in placed), **about), path)
    if suffix_of(path) is not None:
        return read_mesh_file(path)
    known = ", ".join((*UP_AXES, *USD_SUFFIXES))
    raise InputError(f"{path}: unknown format {suffix or '(no extension)'}; it must be {known}")


def read_file(path: Path) -> FileMesh | FileImage:
    """What a file holds: cells with volume, or else triangles, or the voxels of a VTK file with an image.

    Raises:
        InputError: Another format, or it cannot be read.
    """
    if path.suffix.lower() not in (*USD_SUFFIXES, *UP_AXES):
        return read_tetrahedra(path)
    tets = read_tetrahedra(path) if path.suffix.lower() in USD_SUFFIXES else None
    return tets if isinstance(tets, FileMesh) and tets.solids else read_surface(path)


def placed_meshes(path: Path, **options: Any) -> list[tuple[Any, NDArray[Any], str, str]]:
    """The meshes of a file that trimesh reads, each with its place in the scene [4, 4], the name of its node there, and
    its own; those of its first mesh come first.

    Args:
        path: The file.
        options: More arguments of trimesh's ``load_scene``.

    Raises:
        InputError: trimesh cannot read it.
    """
    import trimesh

    try:
        options |= {"split_objects": True} if path.suffix.lower() == ".obj" else {}
        with quietly(), bounded(path):
            scene = trimesh.load_scene(path, process=False, **options)
        order = list(scene.geometry)
        found = [(*scene.graph.get(node), str(node)) for node in scene.graph.nodes_geometry]
        found.sort(key=lambda each: (order.index(each[1]), each[2]))
        placed = [(scene.geometry[name], np.asarray(matrix), node, name) for matrix, name, node in found]
        return [each for each in placed if isinstance(each[0], trimesh.Trimesh)]
    except Exception as error:
        why = " ".join(str(error).split())[:120]
        raise InputError(f"{path}: is not a {path.suffix} file that trimesh can read triangles from ({why})") from None
