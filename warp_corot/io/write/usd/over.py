"""The motion of a scene as a layer over its input stage, which keeps its looks and everything else."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdShade, Vt

from warp_corot.errors import InputError
from warp_corot.io.files.usd import preview_material, reason, usd_name
from warp_corot.io.files.whole import written_whole
from warp_corot.io.pictures.colors import VertexAverage, color_index
from warp_corot.io.read.usd.scene import Scene, TetPrim
from warp_corot.mesh.topology import boundary_faces

from .pieces import ColoredStage, Samples
from .prims import ROUGHNESS, declare_colors, declare_tet_stress, extent

# --- the moving prims ------------------------------------------------------------------------------------------------

_GROUND, _LOOK = "/simulated_ground", "/simulated_look"


class PointsOver:
    """A prim whose points are given by frames; in world coordinates if an ancestor moves."""

    def __init__(self, stage: Usd.Stage, scene: Scene, path: str, moving: set[str]):
        self.path, self.prim = path, stage.OverridePrim(path)
        points = UsdGeom.PointBased(self.prim)
        points.CreatePointsAttr()
        points.CreateExtentAttr()
        self._inverse = np.linalg.inv(scene.matrix(path))
        if _is_below(path, moving):
            points.SetXformOpOrder([], resetXformStack=True)
            self._inverse = np.eye(4)

    def samples(self, positions: NDArray[np.float32]) -> Samples:
        x = (positions.astype(np.float64) @ self._inverse[:3, :3] + self._inverse[3, :3]).astype(np.float32)
        return {f"{self.path}.points": Vt.Vec3fArray.FromNumpy(x), f"{self.path}.extent": extent(x)}


class TetsOver(PointsOver):
    """A TetMesh."""

    def __init__(self, stage: Usd.Stage, scene: Scene, prim: TetPrim, moving: set[str], show_stress: bool):
        super().__init__(stage, scene, prim.path, moving)
        mesh = UsdGeom.TetMesh(self.prim)
        mesh.CreateVelocitiesAttr()
        declare_tet_stress(mesh)
        self._colored = show_stress or not scene.has(prim.path, "primvars:displayColor")
        if self._colored:
            declare_colors(mesh, with_stress=True)
        if prim.repaired:
            mesh.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(prim.tets))
        if prim.repaired or not scene.has(prim.path, "surfaceFaceVertexIndices"):
            faces = boundary_faces(prim.tets, prim.points)[0][:, :: -1 if prim.left_handed else 1]
            mesh.CreateSurfaceFaceVertexIndicesAttr(Vt.Vec3iArray.FromNumpy(np.ascontiguousarray(faces)))
        self._average = VertexAverage.of(prim)

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

    def __init__(self, stage: Usd.Stage, scene: Scene, path: str, pose: NDArray[np.float64], moving: set[str]):
        prim = UsdGeom.Xformable(stage.OverridePrim(path))
        self._attribute = str(prim.AddTransformOp(opSuffix="simulated").GetAttr().GetPath())
        # The part of the prim's transform besides the body's pose, mostly scale.
        self._own = scene.matrix(path) @ np.linalg.inv(pose)
        self._inverse = np.linalg.inv(scene.matrix(scene.parent(path)))
        if _is_below(scene.parent(path), moving):
            self._inverse = np.eye(4)
            prim.SetResetXformStack(True)

    def samples(self, pose: NDArray[np.float64]) -> Samples:
        return {self._attribute: Gf.Matrix4d(*(self._own @ pose @ self._inverse).ravel().tolist())}


def _is_below(path: str, moving: set[str]) -> bool:
    return any(str(above) in moving for above in Sdf.Path(path).GetPrefixes())


# --- the stage -------------------------------------------------------------------------------------------------------

#: Metadata that the stage on top copies from the stage below.
_OWN = ("subLayers", "subLayerOffsets", "startTimeCode", "endTimeCode", "timeCodesPerSecond", "framesPerSecond")


@dataclass(frozen=True, eq=False)
class FollowingSurface:
    """Points of a Mesh prim that follow a body.

    Attributes:
        path: Path of the prim.
        points: Initial points in the world, float64 [V, 3].
    """

    path: str
    points: NDArray[np.float64]


@dataclass(frozen=True)
class SceneState:
    """The content of a frame, in the stage's units and in the world.

    Attributes:
        positions, velocities: Of the points of each TetMesh, in the given order, float32 [N, 3].
        von_mises: Of the tetrahedra of each TetMesh [Pa], float32 [T].
        bodies: Poses of the rigid bodies, for row vectors, float64 [B, 4, 4].
        surfaces: Points of each surface, float32 [V, 3].
    """

    positions: Sequence[NDArray[np.float32]]
    velocities: Sequence[NDArray[np.float32]]
    von_mises: Sequence[NDArray[np.float32]]
    bodies: NDArray[np.float64]
    surfaces: Sequence[NDArray[np.float32]]


class SceneWriter(ColoredStage):
    """Write frames of a scene to a stage with the scene's own stage as a sublayer; it is valid at any moment.

    Units, axis, materials, cameras and everything else come from the stage below, which must keep its place relative to
    the output, unless ``flatten`` is set. Frame i is time code i. Each TetMesh has ``points``, ``velocities``,
    ``extent`` and the primvar ``vonMises`` (uniform, one a tetrahedron [Pa]). If the stage gives no ``displayColor``,
    or ``show_stress`` is set, that shows nodal averages of the stress in the 256 colours of `colors.stress_colors`;
    custom data of the default prim name the map and its range, which is found as in `UsdWriter`. Rigid bodies have
    ``xformOp:transform:simulated``; surfaces that follow have ``points`` and ``extent``.

    Args:
        path: The output: .usd, .usdc or .usda.
        scene: The stage below.
        tets: Its TetMesh prims that move.
        bodies: Paths of the rigid bodies, with their initial poses, float64 [4, 4] each.
        surfaces: Surfaces that follow.
        fps: Frames per second of simulated time.
        ground: Corners of a plane to draw, [4, 3] in the world; None: no plane.
        show_stress: Whether the stress replaces the prims' own look.
        flatten: Whether to join everything into one file at the end.

    Raises:
        InputError: A path that cannot be written to, or a file that is part of the scene.
    """

    def __init__(
        self,
        path: str | Path,
        scene: Scene,
        tets: Sequence[TetPrim],
        bodies: Mapping[str, NDArray[np.float64]],
        surfaces: Sequence[FollowingSurface] = (),
        *,
        fps: float,
        ground: NDArray[np.float64] | None = None,
        show_stress: bool = False,
        flatten: bool = False,
    ):
        super().__init__(path)
        below = scene.path.resolve()
        try:  # relative to this layer's folder, so that both can be moved together
            relative = Path(os.path.relpath(below, self.path.parent.resolve())).as_posix()
            self._below = relative if relative.startswith("../") else f"./{relative}"
        except ValueError:  # another drive
            self._below = usd_name(below)
        if self.path.exists() and self.path.samefile(scene.path):
            raise InputError(f"{self.path}: is the input; it must be another file")
        if scene.uses(self.path):
            raise InputError(f"{self.path}: is part of the input {scene.path}; it must be another file")
        self._scene, self._flatten = scene, flatten
        self._layer = layer = Sdf.Layer.CreateAnonymous(".usdc")
        source = scene.stage.GetRootLayer()
        for key in source.pseudoRoot.ListInfoKeys():
            if key not in _OWN:
                layer.pseudoRoot.SetInfo(key, source.pseudoRoot.GetInfo(key))
        layer.timeCodesPerSecond = layer.framesPerSecond = fps
        first = scene.stage.GetDefaultPrim() or scene.stage.GetPrimAtPath(scene.tets[0].path)
        layer.defaultPrim = first.GetPath().GetPrefixes()[0].name
        Sdf.CreatePrimInLayer(layer, f"/{layer.defaultPrim}")
        for name in scene.uninstanced:
            Sdf.CreatePrimInLayer(layer, name).SetInfo("instanceable", False)
        stage, moving = Usd.Stage.Open(self._layer), {*bodies, *scene.animated}
        self._soft = [TetsOver(stage, scene, prim, moving, show_stress) for prim in tets]
        self._bodies = [BodyOver(stage, scene, name, pose, moving) for name, pose in bodies.items()]
        self._surfaces = [PointsOver(stage, scene, one.path, moving) for one in surfaces]
        for surface in self._surfaces:
            for name in ("normals", "primvars:normals"):  # renderers compute normals from the points
                if scene.has(surface.path, name):
                    surface.prim.CreateAttribute(name, Sdf.ValueTypeNames.Normal3fArray, custom=False).Block()
        if ground is not None:
            plane = UsdGeom.Mesh.Define(stage, _GROUND)
            plane.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(ground.astype(np.float32)))
            plane.CreateFaceVertexCountsAttr([4])
            plane.CreateFaceVertexIndicesAttr([0, 1, 2, 3])
            plane.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
            plane.CreateDoubleSidedAttr(True)
            plane.CreateExtentAttr(extent(ground.astype(np.float32)))
            plane.CreateDisplayColorAttr([(0.3, 0.3, 0.3)])
        if show_stress:
            material = preview_material(stage, _LOOK, roughness=ROUGHNESS)
            for soft in self._soft:
                # Not the binding for all purposes, which may define the physics.
                for purpose in (UsdShade.Tokens.full, UsdShade.Tokens.preview):
                    binding = UsdShade.MaterialBindingAPI.Apply(soft.prim)
                    binding.Bind(material, UsdShade.Tokens.strongerThanDescendants, purpose)

    def write(self, state: SceneState) -> None:
        """Add a frame.

        Raises:
            OSError: It could not be written, for example because the disk is full; former frames stay and play.
        """
        self._check_open()
        samples: Samples = {}
        for index, soft in enumerate(self._soft):
            samples |= soft.samples(state.positions[index], state.velocities[index], state.von_mises[index])
        for body, pose in zip(self._bodies, state.bodies, strict=True):
            samples |= body.samples(pose)
        for surface, points in zip(self._surfaces, state.surfaces, strict=True):
            samples |= surface.samples(points)
        self._add(self._layer, samples, np.concatenate(state.von_mises))

    def close(self) -> None:
        """Join all frames into one file; further calls do nothing.

        Raises:
            OSError: It could not be written; former frames stay and play.
        """
        was_open = not self._closed
        if self._static is not None:
            self._static.subLayerPaths = [self._below]
        super().close()
        if was_open and self._flatten and self.frames:
            try:
                with written_whole(self.path) as part:
                    Usd.Stage.Open(usd_name(self.path)).Flatten().Export(usd_name(part))
            except Tf.ErrorException as error:
                raise OSError(f"{self.path}: cannot be flattened: {reason(error)}") from None

    def _root_layer(self, pieces: list[tuple[float, float]]) -> Sdf.Layer:
        root = super()._root_layer(pieces)
        root.subLayerPaths.append(self._below)
        return root

    def _colors(self, samples: Samples) -> Samples:
        colors: Samples = {}
        for soft in self._soft:
            colors |= soft.colors(samples, self.stress_range[1])
        return colors
