"""The prims of rigid obstacles, which move if they are tools."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from warp_corot.contact.sampled import TriangleMesh
from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.io.files.usd import free_name
from warp_corot.io.pictures.colors import STEEL, srgb_to_linear
from warp_corot.io.write.solids import ground_corners, shape_of

from .pieces import Samples
from .prims import OBSTACLES, Frame, Limits, Statics, declare_triangles, triangle_samples

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
