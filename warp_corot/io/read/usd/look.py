"""Mesh prims of USD stages with their appearance: faces, texture coordinates, materials."""

from __future__ import annotations

from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom, UsdShade, Vt

from warp_corot.errors import InputError
from warp_corot.io.files.usd import metres_per_unit, open_stage
from warp_corot.io.read.surfaces import UP_AXES
from warp_corot.io.read.tetrahedra import USD_SUFFIXES

from .surfaces import DrawnMesh, drawn_meshes

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
    from .from_surfaces import stage_of_triangles

    source = Path(path)
    stage = stage_of_triangles(source.stem, points, triangles)
    (drawn,) = drawn_meshes(stage, source)
    return _look(drawn, stage, source, 1.0)


def read_looks(path: str | PathLike[str]) -> list[Look]:
    """All visible Mesh prims of a stage, at its first time, or the parts of another surface file in the same form.

    Raises:
        InputError: The file does not exist, is not a USD stage or another surface file, is damaged, or has no faces.
    """
    source = Path(path)
    if source.suffix.lower() not in (*USD_SUFFIXES, *UP_AXES):
        known = ", ".join((*USD_SUFFIXES, *UP_AXES))
        raise InputError(f"{source}: extension {source.suffix or '(none)'}; it must be {known}")
    if not source.is_file():
        raise InputError(f"{source}: no such file")
    if source.suffix.lower() in UP_AXES:
        from .from_surfaces import stage_of_file

        stage, metres = stage_of_file(source), 1.0
    else:
        stage = _flattened(open_stage(source))
        metres = metres_per_unit(stage, source)
    looks = [_look(drawn, stage, source, metres) for drawn in drawn_meshes(stage, source)]
    if not looks:
        raise InputError(f"{source}: has no Mesh prim with faces")
    return looks


def _look(drawn: DrawnMesh, stage: Any, source: Path, metres: float) -> Look:
    prim = drawn.mesh.GetPrim()
    normals = drawn.mesh.GetNormalsAttr().HasAuthoredValue() or prim.GetAttribute("primvars:normals").HasValue()
    return Look(
        prim.GetName(),
        str(prim.GetPath()),
        source,
        metres * drawn.points,
        drawn.triangles.astype(np.int32),
        drawn.faces,
        np.full(len(drawn.triangles), drawn.left_handed),
        False,
        bool(normals),
        drawn.smooth,
        _is_plain(prim),
        stage,
    )


def _is_plain(prim: Any) -> bool:
    parts = [prim, *(child for child in prim.GetChildren() if child.IsA(UsdGeom.Subset))]
    bound = any(
        UsdShade.MaterialBindingAPI(part).ComputeBoundMaterial(purpose)[0] for part in parts for purpose in PURPOSES
    )
    own_colors = UsdGeom.Mesh(prim).GetDisplayColorAttr().HasAuthoredValue() and not prim.HasAttribute(STRESS)
    return not bound and not own_colors


def _flattened(stage: Any) -> Any:
    """The stage as one layer, without instances."""
    stage.SetEditTarget(stage.GetSessionLayer())
    while instances := [prim for prim in stage.Traverse() if prim.IsInstance()]:
        for prim in instances:
            prim.SetInstanceable(False)
    return Usd.Stage.Open(stage.Flatten())


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
