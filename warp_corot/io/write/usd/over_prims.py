"""The moving prims of a scene, as specs of a layer over their stage."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, Vt

from warp_corot.io.pictures.colors import VertexAverage, color_index, srgb_to_linear, stress_colors
from warp_corot.io.read.usd.scene import Scene, TetPrim
from warp_corot.mesh.surfaces.boundary import boundary_faces, signed_volumes

from .pieces import Samples
from .prims import drawn_material, extent

_RESET = "!resetXformStack!"
_MOTION = "xformOp:transform:simulated"
_GROUND = "simulated_ground"
_LOOK = "simulated_look"


class PointsOver:
    """A prim whose points are given by frames; in world coordinates if an ancestor moves."""

    def __init__(self, layer: Sdf.Layer, scene: Scene, path: str, moving: set[str]):
        self.path, self._scene = path, scene
        self._prim = Sdf.CreatePrimInLayer(layer, path)
        types = Sdf.ValueTypeNames
        Sdf.AttributeSpec(self._prim, "points", types.Point3fArray)
        Sdf.AttributeSpec(self._prim, "extent", types.Float3Array)
        self._inverse = np.linalg.inv(scene.matrix(path))
        if _is_below(path, moving):
            _order(self._prim, [_RESET])
            self._inverse = np.eye(4)

    def samples(self, positions: NDArray[np.float32]) -> Samples:
        x = (positions.astype(np.float64) @ self._inverse[:3, :3] + self._inverse[3, :3]).astype(np.float32)
        return {f"{self.path}.points": Vt.Vec3fArray.FromNumpy(x), f"{self.path}.extent": extent(x)}

    def refresh_normals(self) -> None:
        """Block the initial normals; renderers compute normals from the points."""
        for name in ("normals", "primvars:normals"):
            if self._scene.has(self.path, name):
                Sdf.AttributeSpec(self._prim, name, Sdf.ValueTypeNames.Normal3fArray).default = Sdf.ValueBlock()


class TetsOver(PointsOver):
    """A TetMesh."""

    def __init__(self, layer: Sdf.Layer, scene: Scene, prim: TetPrim, moving: set[str], show_stress: bool):
        super().__init__(layer, scene, prim.path, moving)
        types, spec = Sdf.ValueTypeNames, self._prim
        Sdf.AttributeSpec(spec, "velocities", types.Vector3fArray)
        stress = Sdf.AttributeSpec(spec, "primvars:vonMises", types.FloatArray)
        stress.SetInfo("interpolation", "uniform")
        stress.documentation = "Von Mises stress of each tetrahedron [Pa]"
        if prim.repaired:
            tets = Vt.Vec4iArray.FromNumpy(prim.tets)
            Sdf.AttributeSpec(spec, "tetVertexIndices", types.Int4Array).default = tets
        if prim.repaired or not scene.has(prim.path, "surfaceFaceVertexIndices"):
            faces = boundary_faces(prim.tets, prim.points)[0][:, :: -1 if prim.left_handed else 1]
            drawn = Vt.Vec3iArray.FromNumpy(np.ascontiguousarray(faces))
            Sdf.AttributeSpec(spec, "surfaceFaceVertexIndices", types.Int3Array).default = drawn
        volumes = np.abs(signed_volumes(prim.points, prim.tets))
        self._average = VertexAverage(prim.tets, volumes, len(prim.points))
        self._colored = show_stress or not scene.has(prim.path, "primvars:displayColor")
        if self._colored:
            color = Sdf.AttributeSpec(spec, "primvars:displayColor", types.Color3fArray)
            color.SetInfo("interpolation", "vertex")
            color.default = Vt.Vec3fArray.FromNumpy(srgb_to_linear(stress_colors()).astype(np.float32))
            Sdf.AttributeSpec(spec, "primvars:displayColor:indices", types.IntArray)

    def samples(  # type: ignore[override]
        self, positions: NDArray[np.float32], velocities: NDArray[np.float32], stress: NDArray[np.float32]
    ) -> Samples:
        v = (velocities.astype(np.float64) @ self._inverse[:3, :3]).astype(np.float32)
        return {
            **super().samples(positions),
            f"{self.path}.velocities": Vt.Vec3fArray.FromNumpy(v),
            f"{self.path}.primvars:vonMises": Vt.FloatArray.FromNumpy(np.ascontiguousarray(stress)),
        }

    def colors(self, samples: Samples, top: float) -> Samples:
        """Colours for the stresses of a frame, for a range from 0 to ``top`` [Pa]."""
        if not self._colored:
            return {}
        nodal = self._average(np.asarray(samples[f"{self.path}.primvars:vonMises"]))
        return {f"{self.path}.primvars:displayColor:indices": Vt.IntArray.FromNumpy(color_index(nodal, 0.0, top))}


class BodyOver:
    """A rigid body's prim, with all its descendants."""

    def __init__(self, layer: Sdf.Layer, scene: Scene, path: str, pose: NDArray[np.float64], moving: set[str]):
        spec = Sdf.CreatePrimInLayer(layer, path)
        Sdf.AttributeSpec(spec, _MOTION, Sdf.ValueTypeNames.Matrix4d)
        self._attribute = f"{path}.{_MOTION}"
        # The part of the prim's transform besides the body's pose, mostly scale.
        self._own = scene.matrix(path) @ np.linalg.inv(pose)
        self._inverse = np.linalg.inv(scene.matrix(scene.parent(path)))
        below = _is_below(scene.parent(path), moving)
        if below:
            self._inverse = np.eye(4)
        _order(spec, [_RESET, _MOTION] if below else [_MOTION])

    def samples(self, pose: NDArray[np.float64]) -> Samples:
        return {self._attribute: Gf.Matrix4d(*(self._own @ pose @ self._inverse).ravel().tolist())}


def _is_below(path: str, moving: set[str]) -> bool:
    return any(str(above) in moving for above in Sdf.Path(path).GetPrefixes())


def _order(spec: Sdf.PrimSpec, names: list[str]) -> None:
    attribute = Sdf.AttributeSpec(spec, "xformOpOrder", Sdf.ValueTypeNames.TokenArray, Sdf.VariabilityUniform)
    attribute.default = Vt.TokenArray(names)


def draw_ground(layer: Sdf.Layer, corners: NDArray[np.float64]) -> None:
    stage = Usd.Stage.Open(layer)
    name = f"/{_GROUND}"
    mesh = UsdGeom.Mesh.Define(stage, name)
    mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    mesh.CreateFaceVertexCountsAttr([4])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateExtentAttr(extent(corners.astype(np.float32)))
    mesh.CreateDisplayColorAttr([(0.3, 0.3, 0.3)])


def bind_look(layer: Sdf.Layer, paths: Sequence[str]) -> None:
    """Let prims be drawn in their ``displayColor``, with any material, by a stronger binding."""
    stage = Usd.Stage.Open(layer)
    material = drawn_material(stage, f"/{_LOOK}")
    for path in paths:
        spec = layer.GetPrimAtPath(path)
        spec.SetInfo("apiSchemas", Sdf.TokenListOp.Create(prependedItems=["MaterialBindingAPI"]))
        # Not the binding for all purposes, which may define the physics.
        for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
            name = f"material:binding:{purpose}"
            relationship = Sdf.RelationshipSpec(spec, name, False)
            relationship.targetPathList.explicitItems = [material.GetPath()]
            relationship.SetInfo("bindMaterialAs", UsdShade.Tokens.strongerThanDescendants)
