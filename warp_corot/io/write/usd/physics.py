"""The physics of a written body: its materials, gravity, the schemas of a deformable body, and rigid obstacles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere, TriangleMesh
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.io.files.usd import free_name
from warp_corot.io.pictures.colors import STEEL, srgb_to_linear
from warp_corot.io.write.solids import ground_corners, shape_of

from .pieces import Samples
from .prims import OBSTACLES, PHYSICS, ROOT, TETS, Frame, Limits, Present, Statics, declare_triangles, triangle_samples

# --- materials -------------------------------------------------------------------------------------------------------

#: With more distinct materials than this, only primvars describe the elements' materials.
MOST_MATERIALS = 64
#: Attributes of a deformable material, named as in Newton's importer, and their sources here.
_NAMES = {"youngsModulus": "young", "poissonsRatio": "poisson", "density": "density"}


def declare_physics(
    stage: Any, present: Present, *, with_tets: bool, changing: bool, gravity: Sequence[float] | None
) -> None:
    """Declare a body's materials, in SI units.

    Under ``/SoftBody/physics`` there is a `UsdShade.Material` for each material of the elements, with
    ``PhysicsMaterialAPI`` (its density) and ``PhysicsVolumeDeformableMaterialAPI`` (``physics:youngsModulus`` [Pa],
    ``physics:poissonsRatio``), bound for physics to the TetMesh, or to subsets of its tetrahedra if there are several;
    to the body if the TetMesh is not written. The body is a deformable body whose simulation mesh is the
    TetMesh, and whose surface follows. A physics scene has the gravity.

    Args:
        stage: Stage with the body's prims.
        present: The body.
        with_tets: Whether its TetMesh is written.
        changing: Whether the mesh may change, which would invalidate subsets.
        gravity: Acceleration [m/s^2].
    """
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    UsdGeom.Scope.Define(stage, PHYSICS)
    if gravity is not None:
        _declare_scene(stage, gravity)
    body, tets = stage.GetPrimAtPath(ROOT), stage.GetPrimAtPath(TETS)
    if with_tets:
        body.AddAppliedSchema("PhysicsDeformableBodyAPI")
        tets.AddAppliedSchema("PhysicsVolumeDeformableSimAPI")
        UsdPhysics.CollisionAPI.Apply(tets)
    if present.material is None:
        return
    values = [np.ravel(getattr(present.material, name)) for name in _NAMES.values()]
    kinds, of_element = np.unique(np.stack(np.broadcast_arrays(*values)), axis=1, return_inverse=True)
    if kinds.shape[1] > MOST_MATERIALS:
        return
    made = [_material(stage, number, kind) for number, kind in enumerate(kinds.T.tolist(), start=1)]
    bound = tets if with_tets else body
    if len(made) == 1:
        _bind(bound, made[0])
    elif with_tets and not changing:
        for number, material in enumerate(made):
            own = np.flatnonzero(of_element.ravel() == number).astype(np.int32)
            subset = UsdGeom.Subset.Define(stage, f"{TETS}/{material.GetPrim().GetName()}")
            subset.CreateElementTypeAttr(UsdGeom.Tokens.tetrahedron)
            subset.CreateFamilyNameAttr("physics")
            subset.CreateIndicesAttr(Vt.IntArray.FromNumpy(own))
            _bind(subset.GetPrim(), material)


def _declare_scene(stage: Any, gravity: Sequence[float]) -> None:
    scene = UsdPhysics.Scene.Define(stage, f"{PHYSICS}/scene")
    size = float(np.linalg.norm(gravity))
    scene.CreateGravityMagnitudeAttr(size)
    scene.CreateGravityDirectionAttr(Gf.Vec3f(*(g / size for g in gravity)) if size else Gf.Vec3f(0.0, 0.0, 0.0))


def _material(stage: Any, number: int, values: Sequence[float]) -> Any:
    material = UsdShade.Material.Define(stage, f"{PHYSICS}/material{number}")
    prim = material.GetPrim()
    UsdPhysics.MaterialAPI.Apply(prim)
    prim.AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
    for (name, _), value in zip(_NAMES.items(), values, strict=True):
        prim.CreateAttribute(f"physics:{name}", Sdf.ValueTypeNames.Float, custom=False).Set(value)
    return material


def _bind(prim: Any, material: Any) -> None:
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(material, materialPurpose="physics")


# --- rigid obstacles, which move if they are tools -------------------------------------------------------------------

FORCE, TORQUE = "contact:force", "contact:torque"


class ObstaclePrim:
    """The prim of an obstacle: a Sphere, Capsule, Cylinder, Cube or Mesh; for a ground a Plane, as large as the bodies
    on it.

    A tool has its place and turn in each frame, and ``contact:force`` [N] and ``contact:torque`` about its origin
    [N m].

    Args:
        obstacle: The obstacle, of a simulation.
        path: Path of the prim.
        points: The bodies at rest [m], [N, 3].
        world: The world that is drawn.
    """

    def __init__(self, obstacle: Obstacle, path: str, points: NDArray[np.float64], world: int):
        self._obstacle, self._path, self._world = obstacle, path, world
        self._place = shape_of(obstacle).pose
        self._width = 0.0
        shape = shape_of(obstacle)
        if isinstance(shape, Ground):
            corners = ground_corners(shape, points)
            self._place[:3] = corners.mean(axis=0)
            self._width = float(np.linalg.norm(corners[1] - corners[0]))

    @property
    def follows(self) -> dict[str, str]:
        """See `PieceStore.declare`."""
        return {}

    def declare(self, stage: Any, statics: Statics) -> None:
        """As in `TetPrims.declare`."""
        shape = shape_of(self._obstacle)
        prim = _gprim(stage, self._path, shape, self._width)
        moves = isinstance(self._obstacle, Tool)
        place, turn = _place(self._place)
        translate, orient = prim.AddTranslateOp(), prim.AddOrientOp()
        if not moves:
            translate.Set(place)
            orient.Set(turn)
        if isinstance(shape, Box):
            prim.AddScaleOp().Set(Gf.Vec3f(*shape.size))
        color = prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.constant)
        color.Set(Vt.Vec3fArray([Gf.Vec3f(*srgb_to_linear(STEEL))]))
        if moves:
            for name, said in ((FORCE, "Force of contact [N]"), (TORQUE, "Torque of contact about the origin [N m]")):
                attribute = prim.GetPrim().CreateAttribute(name, Sdf.ValueTypeNames.Vector3f, custom=True)
                attribute.SetDocumentation(f"{said}, of the bodies on the tool, in the world's frame")

    def samples(self, frame: Frame) -> Samples:
        """As in `TetPrims.samples`: the tool's place, and the force and torque on it."""
        if not isinstance(self._obstacle, Tool):
            return {}
        place, turn = _place(self._obstacle.present_pose[self._world])
        wrench = [float(value) for value in self._obstacle.wrench.numpy()[self._world]]
        return {
            f"{self._path}.xformOp:translate": place,
            f"{self._path}.xformOp:orient": turn,
            f"{self._path}.{FORCE}": Gf.Vec3f(*wrench[:3]),
            f"{self._path}.{TORQUE}": Gf.Vec3f(*wrench[3:]),
        }

    def colors(self, samples: Samples, limits: Limits, _: Any = None) -> Samples:
        """As in `TetPrims.colors`."""
        return {}


def obstacle_prims(obstacles: Sequence[Obstacle], points: NDArray[np.float64], world: int) -> list[ObstaclePrim]:
    """A prim for each obstacle that OpenUSD can draw; tools are tool_1, tool_2, ..., others are named by their
    shape.
    """
    prims, tools, taken = [], 0, set[str]()
    for each in obstacles:
        shape = shape_of(each)
        if not isinstance(shape, Ground | Sphere | Capsule | Cylinder | Box | TriangleMesh):
            continue
        tools += isinstance(each, Tool)
        base = f"tool_{tools}" if isinstance(each, Tool) else Tf.MakeValidIdentifier(repr(shape))
        name = free_name(base, taken)
        prims.append(ObstaclePrim(each, f"{OBSTACLES}/{name}", points, world))
    return prims


def _gprim(stage: Any, path: str, shape: Shape, width: float) -> Any:
    """The prim of a shape with its size and extent."""
    UsdGeom.Scope.Define(stage, OBSTACLES)
    if isinstance(shape, Ground):
        prim = UsdGeom.Plane.Define(stage, path)
        prim.CreateAxisAttr(UsdGeom.Tokens.z)
        prim.CreateWidthAttr(width)
        prim.CreateLengthAttr(width)
        prim.CreateDoubleSidedAttr(True)
    elif isinstance(shape, Sphere):
        prim = UsdGeom.Sphere.Define(stage, path)
        prim.CreateRadiusAttr(shape.size[0])
    elif isinstance(shape, TriangleMesh):
        prim = UsdGeom.Mesh.Define(stage, path)
        declare_triangles(prim)
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.asarray(shape.points, dtype=np.float32)))
        for name, values in triangle_samples(path, shape.triangles).items():
            stage.GetAttributeAtPath(name).Set(values)
    elif isinstance(shape, Box):
        prim = UsdGeom.Cube.Define(stage, path)
        prim.CreateSizeAttr(2.0)
    else:
        prim = (UsdGeom.Capsule if isinstance(shape, Capsule) else UsdGeom.Cylinder).Define(stage, path)
        prim.CreateAxisAttr(UsdGeom.Tokens.z)
        prim.CreateRadiusAttr(shape.size[0])
        prim.CreateHeightAttr(2.0 * shape.size[1])
    prim.CreateExtentAttr(UsdGeom.Boundable.ComputeExtentFromPlugins(prim, Usd.TimeCode.Default()))
    return prim


def _place(pose: NDArray[np.float64]) -> tuple[Any, Any]:
    """A pose, with the quaternion (x, y, z, w), as values of OpenUSD."""
    x, y, z, w = (float(value) for value in pose[3:])
    return Gf.Vec3d(*map(float, pose[:3])), Gf.Quatf(w, x, y, z)
