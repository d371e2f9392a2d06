"""Simulated frames as a USD stage: the body's prims, or smooth surfaces in place of them, obstacles, and physics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pxr import Gf, Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere, TriangleMesh
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.errors import InputError
from warp_corot.io.files.usd import free_name
from warp_corot.io.pictures.colors import STEEL, VertexAverage, srgb_to_linear
from warp_corot.io.write.animate import KEY
from warp_corot.io.write.skins import Skin, ground_corners, shape_of
from warp_corot.mesh.surfaces.bodies import boundary_surface
from warp_corot.mesh.topology import right_handed, signed_volumes

from .pieces import ColoredStage, Samples
from .prims import (
    OBSTACLES,
    PHYSICS,
    ROOT,
    SURFACE,
    TETS,
    DrawnPrim,
    Frame,
    Present,
    SkinPrim,
    TetPrims,
    Touched,
    declare_triangles,
    floats,
    set_values,
    skin_paths,
    triangle_samples,
)

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
        scene, size = UsdPhysics.Scene.Define(stage, f"{PHYSICS}/scene"), float(np.linalg.norm(gravity))
        scene.CreateGravityMagnitudeAttr(size)
        scene.CreateGravityDirectionAttr(Gf.Vec3f(*(g / size for g in gravity)) if size else Gf.Vec3f(0.0, 0.0, 0.0))
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
    for number, kind in enumerate(kinds.T.tolist()):
        name = f"material{number + 1}"
        material, bound = UsdShade.Material.Define(stage, f"{PHYSICS}/{name}"), tets if with_tets else body
        prim = material.GetPrim()
        UsdPhysics.MaterialAPI.Apply(prim)
        prim.AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
        for attribute, value in zip(_NAMES, kind, strict=True):
            prim.CreateAttribute(f"physics:{attribute}", Sdf.ValueTypeNames.Float, custom=False).Set(value)
        if kinds.shape[1] > 1:
            if changing or not with_tets:
                continue
            own = np.flatnonzero(of_element.ravel() == number).astype(np.int32)
            subset = UsdGeom.Subset.Define(stage, f"{TETS}/{name}")
            subset.CreateElementTypeAttr(UsdGeom.Tokens.tetrahedron)
            subset.CreateFamilyNameAttr("physics")
            subset.CreateIndicesAttr(Vt.IntArray.FromNumpy(own))
            bound = subset.GetPrim()
        UsdShade.MaterialBindingAPI.Apply(bound).Bind(material, materialPurpose="physics")


# --- rigid obstacles, which move if they are tools -------------------------------------------------------------------

FORCE, TORQUE = "contact:force", "contact:torque"


class ObstaclePrim(DrawnPrim):
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

    def define(self, stage: Any, frame: Frame) -> None:
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
        set_values(stage, triangle_samples(path, shape.triangles))
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


# --- the writer ------------------------------------------------------------------------------------------------------

__all__ = ["ROOT", "SURFACE", "TETS", "Mesh", "UsdWriter"]


class Mesh(Protocol):
    """The part of a mesh that the writer needs: ``points`` [N, 3] [m] and ``tets`` [T, 4]."""

    @property
    def points(self) -> NDArray[np.float64]: ...

    @property
    def tets(self) -> NDArray[np.int32]: ...


class UsdWriter(ColoredStage):
    """Write one body's frames to a USD stage that is valid at any moment, even if the run is killed (see `usd.pieces`).

    The stage, in metres, has ``/SoftBody`` (the default prim) with ``tetrahedra``, a `UsdGeom.TetMesh` of purpose
    *guide*, and ``surface``, a `UsdGeom.Mesh` of only the surface nodes, which viewers draw. Frame i is time code i.
    Both have ``points``, ``velocities`` [m/s] and ``extent`` in each frame. The TetMesh has primvars ``rest`` (vertex),
    ``fixed`` (vertex, 1 if held), ``young`` [Pa], ``poisson``, ``density`` [kg/m³] (constant, or uniform: one a
    tetrahedron) and ``vonMises`` [Pa] (uniform, in each frame), the Mesh has averages of that at its nodes. With
    contact, both have ``contactPressure`` [Pa], and the TetMesh ``contactForce`` [N] (vertex, in each frame). The Mesh
    shows its stress as ``displayColor``, by indices into the 256 colours of `colors.stress_colors`; custom data of
    ``/SoftBody`` name the map and its range. ``/SoftBody/physics`` has the physics materials, and with ``gravity`` a
    physics scene, see `declare_physics`.

    Mirrored tetrahedra are written with two indices swapped, so that all are right-handed as the schema requires.

    With ``skins`` these surfaces replace ``surface``, and the TetMesh is only written if ``tets`` is set.
    A single one is the Mesh ``surface``; several are Meshes under their own names. Each has ``points``, ``normals``,
    ``extent`` and the primvar ``vonMises`` (vertex [Pa]) in each frame, coloured in the same way. A skin with a prim's
    look has that prim's faces, primvars, subsets and materials (copied to ``/SoftBody/materials``) and colours instead,
    and vertex normals if the prim had normals.

    For a body whose mesh changes, ``tetVertexIndices`` and all attributes per tetrahedron, node or face are time
    samples too; those that are not given in each frame are given when the mesh changes, and hold until then. OpenUSD
    interpolates neither integers nor arrays of different lengths; if lengths agree by chance, a sample just before the
    frame (by `usd.pieces.JUST_BEFORE`) prevents the interpolation of different nodes. Between frames points move with
    their ``velocities``, as the schema defines it for meshes that change.

    Obstacles are prims below ``/SoftBody/obstacles``: a Sphere, Capsule, Cylinder, Cube or Plane each; a tool has its
    place, its turn and the force and torque on it in each frame (`usd.physics.ObstaclePrim`).

    Args:
        path: The output: .usd or .usdc (binary) or .usda (text). A former file stays until the first frames are
            complete.
        mesh: The body's mesh at rest.
        fps: Frames per second of simulated time.
        fixed: Fixed nodes, mask [N] or indices.
        material: An object with ``young`` [Pa], ``poisson``, ``density`` [kg/m³], each a number or an array [T].
        up_axis: "X", "Y" or "Z"; None: the mesh's own, else "Y".
        flush_seconds: Approximate wall time [s] whose frames a sudden end may lose.
        skins: Surfaces bound to the mesh's nodes.
        tets: Whether to write the TetMesh; None: only without skins.
        changing: Whether the mesh may change between frames (`change_mesh`).
        gravity: Acceleration [m/s^2], for a physics scene.
        obstacles: The obstacles of the simulation.
        world: The world in which tools are drawn.

    Attributes:
        about: Data about the run for the layer's custom data, under "warp_corot"; entries may be added until it is
            closed.

    Raises:
        InputError: A path that cannot be written to (checked before the simulation), or arguments that do not fit.
    """

    def __init__(
        self,
        path: str | Path,
        mesh: Mesh,
        *,
        fps: float,
        fixed: ArrayLike | None = None,
        material: Any = None,
        up_axis: str | None = None,
        flush_seconds: float = 2.0,
        skins: Sequence[Skin] = (),
        tets: bool | None = None,
        changing: bool = False,
        gravity: Sequence[float] | None = None,
        obstacles: Sequence[Obstacle] = (),
        world: int = 0,
    ):
        up_axis = up_axis or getattr(mesh, "up_axis", "Y")
        if up_axis not in ("X", "Y", "Z"):
            raise InputError(f"up_axis is {up_axis!r}; it must be X, Y or Z")
        if not (np.isfinite(fps) and fps > 0.0):
            raise InputError(f"fps is {fps}; it must be a positive number")
        super().__init__(path, flush_seconds=flush_seconds)
        self._fps = float(fps)
        self._up_axis = up_axis
        self._changing = changing
        self._gravity = gravity
        self.about: dict[str, Any] = {}
        self._present = _present(mesh, fixed, material)
        self._tets = TetPrims(self._present, changing=changing) if tets or not skins else None
        skins = skins or [Skin("surface", boundary_surface(self._present), is_boundary=True)]
        named = zip(skins, skin_paths(skins), strict=True)
        self._skins = [SkinPrim(skin, path, mesh.points, changing=changing) for skin, path in named]
        self._prims: list[DrawnPrim] = [*([self._tets] if self._tets else []), *self._skins]
        self._prims += obstacle_prims(obstacles, self._present.points, world)
        self._given: tuple[bool, ...] | None = None

    def change_mesh(
        self, mesh: Mesh, *, fixed: ArrayLike | None = None, material: Any = None, skins: Sequence[Skin] = ()
    ) -> None:
        """Give the body another mesh of the same region, from the next frame on.

        Args:
            mesh: The mesh at rest.
            fixed, material: As in the constructor.
            skins: The same surfaces, bound to the mesh.

        Raises:
            InputError: The writer was made without ``changing``, or the number of skins differs.
        """
        if not self._changing:
            raise InputError(f"{self.path}: the mesh cannot change; the writer must be made with changing=True")
        present = _present(mesh, fixed, material)
        skins = skins or [Skin("surface", boundary_surface(present), is_boundary=True)]
        if len(skins) != len(self._skins):
            raise InputError(f"there are {len(skins)} skins now; there must be {len(self._skins)} as before")
        self._present = present
        if self._tets:
            self._tets.follow(self._present)
        for prim, skin in zip(self._skins, skins, strict=True):
            prim.follow(skin, mesh.points)

    def write(
        self,
        positions: ArrayLike,
        *,
        velocities: ArrayLike | None = None,
        von_mises: ArrayLike | None = None,
        touched: Touched | None = None,
    ) -> None:
        """Add a frame; all frames must have the same optional arguments.

        Args:
            positions: [N, 3] [m], in the mesh's node order.
            velocities: [N, 3] [m/s].
            von_mises: [T] [Pa].
            touched: Contact on the body.

        Raises:
            InputError: A shape that does not fit the mesh, or other optional arguments than in the first frame.
            OSError: It could not be written, for example because the disk is full; former frames stay and play.
        """
        self._check_open()
        x = floats(positions, self._present.points.shape, "positions")
        v = None if velocities is None else floats(velocities, x.shape, "velocities")
        stress = nodal = None
        if von_mises is not None:
            stress = floats(von_mises, (len(self._present.tets),), "von_mises")
            nodal = self._present.average(stress)
        self.layer_data = {KEY: self.about} if self.about else {}
        frame = Frame(x, v, stress, nodal, touched)
        given = tuple(each is not None for each in frame)
        if self._given is None:
            self._given, self._layer = given, self._static_layer(frame)
        elif given != self._given:
            raise InputError("velocities, von_mises and contact must be given either for every frame or for none")
        samples, follows = dict[str, Any](), dict[str, str]()
        for prim in self._prims:
            samples |= prim.samples(frame)
            follows |= prim.follows
        self._add(self._layer, samples, stress, follows=follows if self._changing else {})

    def _colors(self, samples: Samples) -> Samples:
        colors: Samples = {}
        for prim in self._prims:
            colors |= prim.colors(samples, self.stress_range)
        return colors

    def _static_layer(self, frame: Frame) -> Sdf.Layer:
        """The layer with everything that does not change, for frames like this one."""
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        stage = Usd.Stage.Open(layer)
        UsdGeom.SetStageUpAxis(stage, self._up_axis)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetTimeCodesPerSecond(self._fps)
        stage.SetFramesPerSecond(self._fps)
        root = UsdGeom.Xform.Define(stage, ROOT).GetPrim()
        stage.SetDefaultPrim(root)
        Usd.ModelAPI(root).SetKind(Kind.Tokens.component)
        for prim in self._prims:
            prim.define(stage, frame)
        declare_physics(
            stage,
            self._present,
            with_tets=self._tets is not None,
            changing=self._changing,
            gravity=self._gravity,
        )
        return layer


def _present(mesh: Mesh, fixed: ArrayLike | None, material: Any) -> Present:
    points = np.asarray(mesh.points, dtype=np.float64)
    volumes = signed_volumes(points, mesh.tets)
    tets = right_handed(np.asarray(mesh.tets, dtype=np.int32), volumes < 0.0)
    return Present(points, tets, VertexAverage(tets, np.abs(volumes), len(points)), fixed, material)
