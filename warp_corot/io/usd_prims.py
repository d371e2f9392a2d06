"""The prims of an animated body: its tetrahedra with their boundary, and surfaces bound to it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, UsdGeom, Vt

from ..errors import InputError
from ..mesh.bound import vertex_normals
from ..mesh.surface import boundary_faces
from .colors import TISSUE, VertexAverage, color_index, srgb_to_linear, stress_colors
from .skins import Skin
from .usd_pieces import Samples

if TYPE_CHECKING:
    from .usd_writer import Mesh

ROOT, TETS, SURFACE = "/SoftBody", "/SoftBody/tetrahedra", "/SoftBody/surface"
MATERIALS = "/SoftBody/materials"

Limits = tuple[float, float]


class Frame(NamedTuple):
    """One frame: positions [N, 3], velocities [N, 3] or None, stress [T] or None and its averages at nodes [N]."""

    positions: NDArray[np.float32]
    velocities: NDArray[np.float32] | None
    stress: NDArray[np.float32] | None
    nodal: NDArray[np.float64] | None


@dataclass(frozen=True)
class Statics:
    """What a stage says once: held nodes, the material, and whether frames give velocities and stress."""

    fixed: Any
    material: Any
    velocities: bool
    stress: bool


class TetPrims:
    """The TetMesh prim and, if it is to be drawn, the Mesh of the boundary.

    Args:
        mesh: At rest.
        tets: Its tetrahedra, all right-handed, int32 [T, 4].
        average: From tetrahedra to nodes.
        boundary: Whether the boundary is drawn.
    """

    def __init__(self, mesh: Mesh, tets: NDArray[np.int32], average: VertexAverage, boundary: bool):
        self._rest = np.ascontiguousarray(mesh.points, dtype=np.float32)
        self._tets = tets
        self._average = average
        self._boundary = boundary
        self._faces, _ = boundary_faces(tets)
        self._surface_nodes, compact = np.unique(self._faces, return_inverse=True)
        self._surface_faces = compact.reshape(-1, 3).astype(np.int32)

    def declare(self, stage: Any, statics: Statics) -> None:
        """Everything that does not change, and the attributes that do, without values."""
        tets = UsdGeom.TetMesh.Define(stage, TETS)
        tets.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(self._tets))
        tets.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(self._faces))
        tets.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        # Drawn beside its surface it would show twice, and Hydra takes its uniform primvars for values per face.
        tets.CreatePurposeAttr(UsdGeom.Tokens.guide)
        if statics.velocities:
            tets.CreateVelocitiesAttr()
        self._declare_primvars(UsdGeom.PrimvarsAPI(tets), statics)
        declare_moving(tets, statics.stress)
        if self._boundary:
            surface = UsdGeom.Mesh.Define(stage, SURFACE)
            declare_triangles(surface, self._surface_faces)
            declare_moving(surface, statics.stress)

    def samples(self, frame: Frame) -> Samples:
        """Values of a frame, but for colours."""
        x = frame.positions
        samples: Samples = {f"{TETS}.points": Vt.Vec3fArray.FromNumpy(x), f"{TETS}.extent": extent(x)}
        if self._boundary:
            surface = x[self._surface_nodes]
            samples |= {f"{SURFACE}.points": Vt.Vec3fArray.FromNumpy(surface), f"{SURFACE}.extent": extent(surface)}
        if frame.velocities is not None:
            samples[f"{TETS}.velocities"] = Vt.Vec3fArray.FromNumpy(frame.velocities)
        if frame.stress is not None:
            samples[f"{TETS}.primvars:vonMises"] = Vt.FloatArray.FromNumpy(frame.stress)
        return samples

    def colors(self, samples: Samples, limits: Limits, nodal: NDArray[np.float64] | None = None) -> Samples:
        """Colours of a frame out of its stresses."""
        if nodal is None:
            nodal = self._average(np.asarray(samples[f"{TETS}.primvars:vonMises"]))
        indices = color_index(nodal, *limits)
        colors = {f"{TETS}.primvars:displayColor:indices": Vt.IntArray.FromNumpy(indices)}
        if self._boundary:
            on_surface = Vt.IntArray.FromNumpy(indices[self._surface_nodes])
            colors[f"{SURFACE}.primvars:displayColor:indices"] = on_surface
        return colors

    def _declare_primvars(self, primvars: Any, statics: Statics) -> None:
        rest = Vt.Vec3fArray.FromNumpy(self._rest)
        primvars.CreatePrimvar("rest", Sdf.ValueTypeNames.Point3fArray, UsdGeom.Tokens.vertex).Set(rest)
        if statics.stress:
            stress = primvars.CreatePrimvar("vonMises", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
            stress.GetAttr().SetDocumentation("Von Mises stress of each tetrahedron [Pa]")
        if statics.fixed is not None:
            held = np.zeros(len(self._rest), np.int32)
            held[np.asarray(statics.fixed)] = 1
            fixed = primvars.CreatePrimvar("fixed", Sdf.ValueTypeNames.IntArray, UsdGeom.Tokens.vertex)
            fixed.Set(Vt.IntArray.FromNumpy(held))
            fixed.GetAttr().SetDocumentation("1 where the node is held")
        for name, unit in (("young", " [Pa]"), ("poisson", ""), ("density", " [kg/m³]")):
            value = getattr(statics.material, name, None)
            if value is not None:
                self._declare_property(primvars, name, np.asarray(value, dtype=np.float32), unit)

    def _declare_property(self, primvars: Any, name: str, value: NDArray[np.float32], unit: str) -> None:
        if value.size == 1:
            primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.Float, UsdGeom.Tokens.constant)
            primvar.Set(float(value.reshape(())))
        else:
            values = floats(value, (len(self._tets),), f"material.{name}")
            primvar = primvars.CreatePrimvar(name, Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.uniform)
            primvar.Set(Vt.FloatArray.FromNumpy(values))
        primvar.GetAttr().SetDocumentation(f"Material: {name}{unit}")


class SkinPrim:
    """The Mesh prim of a surface that is bound to the body's nodes."""

    def __init__(self, skin: Skin, path: str, mesh: Mesh):
        self._skin, self._path = skin, path
        self._rest = np.asarray(mesh.points, dtype=np.float64)
        look = skin.look
        self._with_normals = look is None or (look.had_normals and not look.smooth)
        self._with_colors = look is None

    def declare(self, stage: Any, statics: Statics) -> None:
        """As `TetPrims.declare`."""
        look, surface = self._skin.look, self._skin.surface
        if look is not None:
            look.copy_to(stage.GetRootLayer(), self._path, MATERIALS)
            mesh = UsdGeom.Mesh.Get(stage, self._path)
            handed = UsdGeom.Tokens.leftHanded if look.left_handed else UsdGeom.Tokens.rightHanded
            mesh.CreateOrientationAttr(handed)
        else:
            mesh = UsdGeom.Mesh.Define(stage, self._path)
            mesh.GetPrim().SetDisplayName(self._skin.name)
            declare_triangles(mesh, surface.triangles)
        if self._with_normals:
            mesh.CreateNormalsAttr()
            mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
        if statics.stress:
            primvars = UsdGeom.PrimvarsAPI(mesh)
            stress = primvars.CreatePrimvar("vonMises", Sdf.ValueTypeNames.FloatArray, UsdGeom.Tokens.vertex)
            stress.GetAttr().SetDocumentation("Von Mises stress, averaged over the tetrahedra around [Pa]")
        declare_moving(mesh, statics.stress, colored=self._with_colors)

    def samples(self, frame: Frame) -> Samples:
        """As `TetPrims.samples`."""
        surface = self._skin.surface
        x = surface.moved(frame.positions - self._rest).astype(np.float32)
        samples: Samples = {
            f"{self._path}.points": Vt.Vec3fArray.FromNumpy(x),
            f"{self._path}.extent": extent(x),
        }
        if self._with_normals:
            normals = vertex_normals(x.astype(np.float64), surface.triangles).astype(np.float32)
            samples[f"{self._path}.normals"] = Vt.Vec3fArray.FromNumpy(normals)
        if frame.nodal is not None:
            samples[f"{self._path}.primvars:vonMises"] = Vt.FloatArray.FromNumpy(self._skin.values(frame.nodal))
        return samples

    def colors(self, samples: Samples, limits: Limits, _: Any = None) -> Samples:
        """As `TetPrims.colors`."""
        if not self._with_colors:
            return {}
        stress = np.asarray(samples[f"{self._path}.primvars:vonMises"])
        indices = Vt.IntArray.FromNumpy(color_index(stress, *limits))
        return {f"{self._path}.primvars:displayColor:indices": indices}


def skin_paths(skins: Sequence[Skin]) -> list[str]:
    """A path for each, all different, after their names."""
    taken = {TETS, MATERIALS}
    paths = []
    for skin in skins:
        name = path = f"{ROOT}/{Tf.MakeValidIdentifier(skin.name)}"
        count = 1
        while path in taken:
            count += 1
            path = f"{name}_{count}"
        taken.add(path)
        paths.append(path)
    return paths


def declare_triangles(mesh: Any, triangles: NDArray[np.int32]) -> None:
    """Triangles wound counter-clockwise seen from outside."""
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray(len(triangles), 3))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles).reshape(-1)))
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)


def declare_moving(body: Any, with_stress: bool, colored: bool = True) -> None:
    """Points, extent and, if it has any, colours: of stress, or of tissue where none is given."""
    body.CreatePointsAttr()
    body.CreateExtentAttr()
    if colored and with_stress:
        color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
        color.Set(Vt.Vec3fArray.FromNumpy(srgb_to_linear(stress_colors()).astype(np.float32)))
        color.CreateIndicesAttr()
    elif colored:
        color = body.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
        color.Set(Vt.Vec3fArray([Gf.Vec3f(*srgb_to_linear(TISSUE))]))


def floats(values: Any, shape: tuple[int, ...], name: str) -> NDArray[np.float32]:
    """As float32 of a shape.

    Raises:
        InputError: Another shape.
    """
    array = np.ascontiguousarray(values.numpy() if hasattr(values, "numpy") else values, dtype=np.float32)
    if array.shape != shape:
        raise InputError(f"{name} has shape {list(array.shape)}, should be {list(shape)}")
    return array


def extent(points: NDArray[np.float32]) -> Vt.Vec3fArray:
    """Lowest and highest coordinates."""
    return Vt.Vec3fArray.FromNumpy(np.stack([points.min(axis=0), points.max(axis=0)]))
