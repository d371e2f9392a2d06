"""Mesh and TetMesh prims of USD stages: triangles in the world, tetrahedra, and surfaces with their appearance."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from warp_corot.errors import InputError
from warp_corot.io.files.usd import (
    first_value,
    free_name,
    in_world,
    metres_per_unit,
    open_stage,
    preview_material,
    reads_stage,
    world_matrix,
)
from warp_corot.io.read.filemesh import Block, FileMesh, joined_meshes, mesh_of_triangles, sets_of_numbers
from warp_corot.io.read.meshes import UP_AXES, USD_SUFFIXES, placed_meshes

# --- surfaces --------------------------------------------------------------------------------------------------------


@reads_stage
def read_usd_surface(path: Path) -> FileMesh:
    """All visible Mesh prims of a stage as triangles in the world.

    Raises:
        InputError: The file is not a stage, or a damaged one.
    """
    stage = open_stage(path)
    looks = list(looks_of(stage, path, 1.0))
    return joined_meshes(
        [(look.name, mesh_of_triangles(look.points, look.triangles)) for look in looks],
        notes=[f"{look.path} is a subdivision surface; its control mesh is used" for look in looks if look.smooth],
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
    parts: list[tuple[str, FileMesh]] = []
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        indices = _tet_indices(prim, path)
        if indices is None or len(indices) == 0:
            continue
        points = _rest_points(prim, path)
        if indices.min() < 0 or indices.max() >= len(points):
            bad = indices[(indices < 0) | (indices >= len(points))][0]
            raise InputError(f"{path}: prim {prim.GetPath()} names point {bad} but has points 0 to {len(points) - 1}")
        name, taken = prim.GetName(), {known for known, _ in parts}
        name = name if name not in taken else f"{name}_{len(parts) + 1}"
        sets = _node_sets(prim, len(points))
        parts.append((name, FileMesh(in_world(prim, points), [Block("tetra", indices)], node_sets=sets)))
    about = {"metres": metres_per_unit(stage, path), "up_axis": str(UsdGeom.GetStageUpAxis(stage))}
    return joined_meshes(parts, **about, **({} if len(parts) > 1 else {"objects": []}))


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


# --- Mesh prims with their appearance --------------------------------------------------------------------------------

#: Properties that frames give, or that become invalid when a prim's points are in world coordinates.
STALE = ("points", "extent", "normals", "velocities", "accelerations", "primvars:normals", "tetraIndices")
#: Properties that a simulation wrote: the stress, which the colours show, and contact.
STRESS = "primvars:vonMises"
COLORS = (STRESS, "primvars:displayColor", "primvars:displayColor:indices", "primvars:contactPressure")
#: Bindings are made again; if there are several, the first of these purposes is used.
PURPOSES = (UsdShade.Tokens.allPurpose, UsdShade.Tokens.preview, UsdShade.Tokens.full)


@dataclass(frozen=True, eq=False)
class Look:
    """A Mesh prim of a stage.

    Attributes:
        name: Name of the prim.
        path: Path of the prim.
        source: The file.
        points: Points in the world [m], float64 [V, 3].
        triangles: Fans of its faces, int32 [F, 3], counter-clockwise seen from outside.
        faces: The listed face of each triangle, int64 [F].
        turned: Whether that face is listed clockwise seen from outside, bool [F].
        is_open: Whether it has holes, through which one sees its inside.
        had_normals: Whether the prim gives normals.
        smooth: Whether it is a subdivision surface, which needs no normals.
        is_plain: Whether it has neither a material nor its own colours, so that stress may colour it.
    """

    name: str
    path: str
    source: Path
    points: NDArray[np.float64]
    triangles: NDArray[np.int32]
    faces: NDArray[np.int64]
    turned: NDArray[np.bool_]
    is_open: bool
    had_normals: bool
    smooth: bool
    is_plain: bool
    _stage: Any

    def placed(self, scale: float, offset: NDArray[np.float64]) -> Look:
        """The same look with its points scaled by a factor and then moved."""
        return replace(self, points=scale * self.points + offset)

    def wound(self, turned: NDArray[np.bool_], is_open: bool) -> Look:
        """The same look with some triangles [F] turned round."""
        triangles = np.where(turned[:, None], self.triangles[:, ::-1], self.triangles)
        return replace(self, triangles=triangles, turned=self.turned ^ turned, is_open=is_open)

    def copy_to(self, layer: Sdf.Layer, target: str, materials: str) -> None:
        """Copy the prim, without points, normals and transform, to a path of a layer, and the materials of the prim and
        its subsets to another path.

        Textures get absolute paths, so that they are found from the layer's file.
        """
        flat = self._stage.GetRootLayer()
        Sdf.CreatePrimInLayer(layer, Sdf.Path(target).GetParentPath())
        Sdf.CopySpec(flat, self.path, layer, target)
        spec = layer.GetPrimAtPath(target)
        for child in list(spec.nameChildren):
            if child.typeName != "GeomSubset":
                del spec.nameChildren[child.name]
        _without_stale(spec)
        self._wind(layer, target)
        bound = [(self.path, target)]
        bound += [(f"{self.path}/{child.name}", f"{target}/{child.name}") for child in spec.nameChildren]
        for here, there in bound:
            self._bind_material(layer, here, there, materials)

    def _wind(self, layer: Sdf.Layer, target: str) -> None:
        """List the corners of each face of a copy counter-clockwise seen from outside, with their primvars."""
        stage = Usd.Stage.Open(layer)
        mesh = UsdGeom.Mesh.Get(stage, target)
        mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        if self.is_open:
            mesh.CreateDoubleSidedAttr(True)
        if not self.turned.any():
            return
        counts = np.asarray(mesh.GetFaceVertexCountsAttr().Get())
        face = np.repeat(np.arange(len(counts)), counts)
        first = (np.cumsum(counts) - counts)[face]
        place = np.arange(len(face)) - first
        order = first + np.where(np.isin(face, self.faces[self.turned]), -place % counts[face], place)
        corners = mesh.GetFaceVertexIndicesAttr()
        corners.Set(Vt.IntArray.FromNumpy(np.asarray(corners.Get())[order]))
        for primvar in UsdGeom.PrimvarsAPI(mesh).GetPrimvars():
            if primvar.GetInterpolation() == UsdGeom.Tokens.faceVarying:
                indices = np.asarray(primvar.GetIndices()) if primvar.IsIndexed() else np.arange(len(order))
                primvar.SetIndices(Vt.IntArray.FromNumpy(indices[order].astype(np.int32)))

    def _bind_material(self, layer: Sdf.Layer, here: str, there: str, materials: str) -> None:
        """Bind a prim of the layer to a copy of its original's material."""
        spec = layer.GetPrimAtPath(there)
        for name in [p.name for p in spec.properties if p.name.startswith("material:binding")]:
            spec.RemoveProperty(spec.properties[name])
        binding = UsdShade.MaterialBindingAPI(self._stage.GetPrimAtPath(here))
        found = (binding.ComputeBoundMaterial(purpose)[0] for purpose in PURPOSES)
        material = next((material for material in found if material), None)
        if material is None:
            return
        origin = material.GetPath()
        copied = f"{materials}/{origin.pathString.strip('/').replace('/', '_')}"
        if not layer.GetPrimAtPath(copied):
            Sdf.CreatePrimInLayer(layer, materials).typeName = "Scope"
            layer.GetPrimAtPath(materials).specifier = Sdf.SpecifierDef
            Sdf.CopySpec(self._stage.GetRootLayer(), origin, layer, copied)
        stage = Usd.Stage.Open(layer)
        UsdShade.MaterialBindingAPI.Apply(stage.GetPrimAtPath(there)).Bind(UsdShade.Material.Get(stage, copied))


def has_looks(path: str | PathLike[str]) -> bool:
    """Whether files with this extension describe the appearance of surfaces."""
    return Path(path).suffix.lower() in (*USD_SUFFIXES, *UP_AXES)


def look_of_triangles(path: str | PathLike[str], points: NDArray[Any], triangles: NDArray[Any]) -> Look:
    """The triangles of a file as a prim with the file's name."""
    from trimesh import Trimesh

    source, geometry = Path(path), Trimesh(points, triangles, process=False)
    (look,) = looks_of(_stage_of([(geometry, np.eye(4), source.stem)], source), source, 1.0)
    return look


def read_looks(path: str | PathLike[str]) -> list[Look]:
    """All visible Mesh prims of a stage, at its first time, or the parts of another surface file in the same form.

    Raises:
        InputError: The file does not exist, is not a USD stage or another surface file, is damaged, or has no faces.
    """
    source, metres = Path(path), 1.0
    if not has_looks(source):
        known = ", ".join((*USD_SUFFIXES, *UP_AXES))
        raise InputError(f"{source}: extension {source.suffix or '(none)'}; it must be {known}")
    if not source.is_file():
        raise InputError(f"{source}: no such file")
    if source.suffix.lower() in UP_AXES:
        parts = placed_meshes(source, maintain_order=True)
        stage = _stage_of([(mesh, matrix, name or source.stem) for mesh, matrix, _, name in parts], source)
    else:
        # One layer, without instances.
        stage = open_stage(source)
        stage.SetEditTarget(stage.GetSessionLayer())
        while instances := [prim for prim in stage.Traverse() if prim.IsInstance()]:
            for prim in instances:
                prim.SetInstanceable(False)
        stage = Usd.Stage.Open(stage.Flatten())
        metres = metres_per_unit(stage, source)
    looks = list(looks_of(stage, source, metres))
    if not looks:
        raise InputError(f"{source}: has no Mesh prim with faces")
    return looks


def looks_of(stage: Any, source: Path, metres: float) -> Iterator[Look]:
    """The visible Mesh prims with faces at their first time, instances included; a unit has so many metres.

    Raises:
        InputError: Faces that do not match their points.
    """
    for prim in stage.Traverse(Usd.TraverseInstanceProxies()):
        mesh = UsdGeom.Mesh(prim)
        if not mesh or mesh.ComputePurpose() in ("guide", "proxy"):
            continue
        points, triangles, faces = _triangles(mesh, source)
        if not len(triangles):
            continue
        left_handed = mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
        left_handed ^= bool(np.linalg.det(world_matrix(prim)[:3, :3]) < 0.0)
        with_subsets = [prim, *(child for child in prim.GetChildren() if child.IsA(UsdGeom.Subset))]
        is_bound = any(
            UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial(purpose)[0]
            for part in with_subsets
            for purpose in PURPOSES
        )
        is_colored = mesh.GetDisplayColorAttr().HasAuthoredValue() and not prim.HasAttribute(STRESS)
        normals = mesh.GetNormalsAttr().HasAuthoredValue() or prim.GetAttribute("primvars:normals").HasValue()
        yield Look(
            prim.GetName(),
            str(prim.GetPath()),
            source,
            metres * in_world(prim, points),
            (triangles[:, ::-1] if left_handed else triangles).astype(np.int32),
            faces,
            np.full(len(triangles), left_handed),
            False,
            bool(normals),
            mesh.GetSubdivisionSchemeAttr().Get() != UsdGeom.Tokens.none,
            not is_bound and not is_colored,
            stage,
        )


def _without_stale(spec: Any) -> None:
    """Remove from a Mesh prim what frames will give, what moves, and transforms; keep the first values of the rest."""
    stale = (*STALE, *(COLORS if STRESS in spec.attributes else ()))
    for attribute in list(spec.attributes):
        samples = spec.layer.ListTimeSamplesForPath(attribute.path)
        if samples:
            attribute.default = spec.layer.QueryTimeSample(attribute.path, samples[0])
            for time in samples:
                spec.layer.EraseTimeSample(attribute.path, time)
        moved = attribute.name in stale or attribute.name.startswith("xformOp")
        if moved or not attribute.HasInfo("default"):
            spec.RemoveProperty(attribute)


# --- surface files read by trimesh as stages in memory, a Mesh prim for each part ------------------------------------

#: Path of the prims.
ROOT = "/scene"


def _stage_of(parts: Sequence[tuple[Any, np.ndarray, str]], source: Path) -> Any:
    """A stage, in metres, of parts of a file: meshes of trimesh, their places in the scene [4, 4], and their names.

    Parts keep their names, texture coordinates (``st``) and colours; a part with a colour or with a texture in a
    separate file is bound to a `UsdPreviewSurface`.
    """
    stage, taken = Usd.Stage.CreateInMemory(), set[str]()
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.Scope.Define(stage, ROOT)
    for geometry, matrix, name in parts:
        if len(geometry.faces):
            stem = Path(name).stem if Path(name).suffix.lower() in (".obj", ".stl", ".ply", ".off") else name
            _define(stage, free_name(Tf.MakeValidIdentifier(stem), taken), geometry, matrix, source)
    return stage


def _define(stage: Any, name: str, geometry: Any, matrix: np.ndarray, source: Path) -> None:
    mesh = UsdGeom.Mesh.Define(stage, f"{ROOT}/{name}")
    points = np.asarray(geometry.vertices, np.float64) @ matrix[:3, :3].T + matrix[:3, 3]
    faces = np.asarray(geometry.faces, np.int32)[:, :: -1 if np.linalg.det(matrix[:3, :3]) < 0 else 1]
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32)))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(faces), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces).ravel()))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    normals = np.asarray(geometry.vertex_normals, np.float32) @ np.linalg.inv(matrix[:3, :3]).astype(np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(normals, np.float32)))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    visual, uv = geometry.visual, getattr(geometry.visual, "uv", None)
    if uv is not None and len(uv) == len(points):
        kind = Sdf.ValueTypeNames.TexCoord2fArray
        st = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
        st.Set(Vt.Vec2fArray.FromNumpy(np.asarray(uv, np.float32)))
    if visual.kind in ("vertex", "face"):
        of_points = visual.kind == "vertex"
        given = visual.vertex_colors if of_points else visual.face_colors
        color = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex if of_points else UsdGeom.Tokens.uniform)
        color.Set(Vt.Vec3fArray.FromNumpy(_linear(np.asarray(given[:, :3], np.float32) / 255.0)))
    elif visual.kind == "texture" and visual.defined and visual.material is not None:
        _bind_material(stage, mesh, visual.material, source)


def _bind_material(stage: Any, mesh: Any, material: Any, source: Path) -> None:
    name = Tf.MakeValidIdentifier(getattr(material, "name", None) or f"{mesh.GetPrim().GetName()}_material")
    path = f"{ROOT}/materials/{name}"
    if not stage.GetPrimAtPath(path):
        color = _linear(np.asarray(material.main_color, np.float32)[:3] / 255.0)
        preview_material(stage, path, color, texture=_texture_file(material, source))
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(UsdShade.Material.Get(stage, path))


def _texture_file(material: Any, source: Path) -> Path | None:
    """The picture of a material, if it is a file beside the surface's."""
    named = (getattr(material, "kwargs", None) or {}).get("map_kd")
    image = getattr(material, "image", None)
    for name in (named, getattr(image, "filename", None)):
        if isinstance(name, list):
            name = " ".join(name)
        if name and (source.parent / str(name)).is_file():
            return (source.parent / str(name)).resolve()
    return None


def _linear(srgb: np.ndarray) -> np.ndarray:
    from warp_corot.io.pictures.colors import srgb_to_linear

    return np.asarray(srgb_to_linear(srgb), np.float32)
