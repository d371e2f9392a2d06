"""Stages with tetrahedra as scenes to simulate: opened, checked, and repaired in memory, never in their files."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pxr import Tf, Usd, UsdGeom, UsdPhysics, UsdShade

from warp_corot.errors import InputError
from warp_corot.io.files.quiet import quietly
from warp_corot.io.files.usd import metres_per_unit, open_stage, reads_stage, world_matrix
from warp_corot.io.read.meshes import USD_SUFFIXES
from warp_corot.mesh.topology import signed_volumes

# --- physics that Newton's importer does not report: values that the file gives, and gravity -------------------------

EARTH = 9.81
#: Newton's substitute for a Poisson's ratio of one half.
NEARLY_INCOMPRESSIBLE = 0.499
#: Namespaces of the attributes of deformable bodies that Newton's importer reads.
_NAMESPACES = ("physics", "omniphysics", "physxDeformableBody")
_BODY = "PhysicsDeformableBodyAPI"


def material_said(prim: Any) -> dict[str, float]:
    """The values of "young", "poisson", "density" and "friction" that a stage gives for a TetMesh prim, in its units.

    They are the values that Newton uses, except the dynamic friction, which it ignores. They come from the physics
    material bound to the prim. A density may also come from a mass or a density of the deformable body, or from masses
    of points or elements; it is then reported as infinite. In UsdPhysics, a zero density means none.
    """
    found: dict[str, float] = {}
    with quietly():  # about bindings without their schema, which are valid all the same
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
    if material:
        young, poisson = _number(material, "youngsModulus"), _number(material, "poissonsRatio")
        if young is not None and young >= 0.0:
            found["young"] = young
        if poisson is not None and -1.0 < poisson < 1.0:
            found["poisson"] = poisson if poisson < 0.5 else NEARLY_INCOMPRESSIBLE
        density, friction = _number(material, "density"), _number(material, "dynamicFriction")
        if friction is not None and friction >= 0.0:
            found["friction"] = friction
        if density is not None and density > 0.0:
            found["density"] = density
    body = prim
    while body and not body.IsPseudoRoot():
        listed = body.GetMetadata("apiSchemas")  # includes schemas that OpenUSD does not know
        if _BODY in body.GetAppliedSchemas() or (listed and _BODY in listed.GetAddedOrExplicitItems()):
            break
        body = body.GetParent()
    body = None if not body or body.IsPseudoRoot() else body
    weights = [_number(body, name) for name in ("density", "mass")] if body else []
    if any(value is not None and value > 0.0 for value in weights) or _value(prim, "masses") is not None:
        found["density"] = math.inf
    return found


def settle_gravity(stage: Any, source: Path) -> list[str]:
    """Replace negative gravity in physics scenes, which in UsdPhysics means the Earth's, by its value.

    Newton does so for infinite values only. This changes the edited layer.

    Returns:
        Paths of the physics scenes; the first one is used.

    Raises:
        InputError: Gravity is not a number, or its direction is invalid.
    """
    scenes = [prim for prim in stage.Traverse() if prim.IsA(UsdPhysics.Scene)]
    for prim in scenes:
        scene = UsdPhysics.Scene(prim)
        magnitude, direction = scene.GetGravityMagnitudeAttr().Get(), scene.GetGravityDirectionAttr().Get()
        if magnitude is not None and (math.isnan(magnitude) or magnitude == math.inf):
            raise InputError(f"{source}: {prim.GetPath()}: gravityMagnitude is {magnitude:g}; it must be finite")
        if direction is not None and not all(map(math.isfinite, direction)):
            raise InputError(f"{source}: {prim.GetPath()}: gravityDirection is {direction}; it must be finite")
        if magnitude is not None and magnitude < 0.0:
            scene.GetGravityMagnitudeAttr().Set(EARTH / UsdGeom.GetStageMetersPerUnit(stage))
    return [str(prim.GetPath()) for prim in scenes]


def _value(prim: Any, name: str) -> Any:
    for namespace in _NAMESPACES:
        attribute = prim.GetAttribute(f"{namespace}:{name}")
        if attribute and attribute.HasAuthoredValue():
            return attribute.Get()
    return None


def _number(prim: Any, name: str) -> float | None:
    value = _value(prim, name)
    return float(value) if isinstance(value, int | float) and math.isfinite(value) else None


# --- the scene -------------------------------------------------------------------------------------------------------


class StageUnits(NamedTuple):
    """Units of a stage's numbers: lengths in ``metres``, masses in ``kilograms``, time in seconds.

    All other units follow by the rules of UsdPhysics: density in mass over length cubed, and so on.
    """

    metres: float
    kilograms: float

    @property
    def density(self) -> float:
        """[kg/m^3]."""
        return self.kilograms / self.metres**3

    @property
    def pressure(self) -> float:
        """[Pa]."""
        return self.kilograms / self.metres


class TetPrim(NamedTuple):
    """A TetMesh prim.

    Attributes:
        path: Path of the prim.
        points: Points in its own space, float64 [N, 3].
        tets: Tetrahedra in the prim's orientation, after repair, int32 [T, 4].
        repaired: Number of wrongly wound tetrahedra.
        left_handed: Whether its orientation is left-handed.
    """

    path: str
    points: NDArray[np.float64]
    tets: NDArray[np.int32]
    repaired: int
    left_handed: bool


@dataclass(eq=False)
class Scene:
    """A stage opened for simulation; changes are in its session layer.

    Attributes:
        path: The file.
        stage: ``Usd.Stage``, without instances around what can move, and with animation stopped at its first time.
        units: Units of its numbers.
        up_axis: "X", "Y" or "Z".
        frame_rate: Time codes per second if the file gives them.
        tets: Its TetMesh prims.
        animated: Paths of prims with transforms that change over time in the file.
        uninstanced: Paths of prims that were instances.
        stopped: Paths of prims with animation in the file that physics does not follow.
        skipped: Paths of TetMesh prims that are only prototypes of a point instancer.
        physics_scenes: Paths of the prims with gravity; the first one is used.
    """

    path: Path
    stage: Any
    units: StageUnits
    up_axis: str
    frame_rate: float | None
    tets: list[TetPrim] = field(default_factory=list)
    animated: list[str] = field(default_factory=list)
    uninstanced: list[str] = field(default_factory=list)
    stopped: list[str] = field(default_factory=list)
    skipped: list[str] = field(default_factory=list)
    physics_scenes: list[str] = field(default_factory=list)

    @property
    def says_metres(self) -> bool:
        """Whether the file gives the length of its unit."""
        return bool(UsdGeom.StageHasAuthoredMetersPerUnit(self.stage))

    def says(self, path: str) -> dict[str, float]:
        """The material values that the file gives for a TetMesh prim; see ``material_said``."""
        return material_said(self.stage.GetPrimAtPath(path))

    def uses(self, file: Path) -> bool:
        """Whether a file is one of the stage's layers."""
        used = (layer.realPath for layer in self.stage.GetUsedLayers())
        return any(name and file.exists() and file.samefile(name) for name in used if Path(name).exists())

    def matrix(self, path: str) -> NDArray[np.float64]:
        """From a prim's space to the world, for row vectors, float64 [4, 4]."""
        return world_matrix(self.stage.GetPrimAtPath(path), Usd.TimeCode.Default())

    def world_points(self, path: str) -> NDArray[np.float64]:
        """Points of a prim in the world, float64 [N, 3]."""
        given = UsdGeom.PointBased(self.stage.GetPrimAtPath(path)).GetPointsAttr().Get()
        matrix = self.matrix(path)
        return np.asarray(given, dtype=np.float64).reshape(-1, 3) @ matrix[:3, :3] + matrix[3, :3]

    def bounds(self, path: str) -> NDArray[np.float64] | None:
        """Corners of the world's bounding box of a prim and its descendants, float64 [2, 3]; None: it is empty."""
        tokens = UsdGeom.Tokens
        purposes = [tokens.default_, tokens.render, tokens.proxy, tokens.guide]
        found = UsdGeom.BBoxCache(Usd.TimeCode.Default(), purposes).ComputeWorldBound(self.stage.GetPrimAtPath(path))
        box = found.ComputeAlignedRange()
        return None if box.IsEmpty() else np.array([box.GetMin(), box.GetMax()], dtype=np.float64)

    def lowest(self, paths: Iterable[str]) -> float:
        """The lowest coordinate of prims and their descendants along the up axis, by their bounds; infinite if none."""
        axis = "XYZ".index(self.up_axis)
        found = [self.bounds(path) for path in paths]
        return min((float(box[0, axis]) for box in found if box is not None), default=math.inf)

    def held(self, path: str) -> NDArray[np.intp]:
        """Indices of a TetMesh prim's points that the file marks as fixed, by the primvar ``fixed`` of `UsdWriter`."""
        primvar = UsdGeom.PrimvarsAPI(self.stage.GetPrimAtPath(path)).GetPrimvar("fixed")
        given = primvar.Get(Usd.TimeCode.EarliestTime()) if primvar and primvar.HasAuthoredValue() else None
        return np.flatnonzero(np.asarray(() if given is None else given) == 1)

    def parent(self, path: str) -> str:
        """The path of a prim's parent."""
        return str(self.stage.GetPrimAtPath(path).GetPath().GetParentPath())

    def has(self, path: str, attribute: str) -> bool:
        """Whether the file gives an attribute of a prim a value."""
        found = self.stage.GetPrimAtPath(path).GetAttribute(attribute)
        return bool(found) and found.HasAuthoredValue()


def open_scene(path: str | PathLike[str]) -> Scene:
    """Open a stage with TetMesh prims.

    Wrongly wound tetrahedra are repaired and counted; Newton would leave them out.

    Raises:
        InputError: The file does not exist, is not a stage, has invalid units, no TetMesh prim, or one that cannot be
            simulated.
    """
    source = Path(path)
    if source.suffix.lower() not in USD_SUFFIXES:
        raise InputError(f"{source}: extension {source.suffix or '(none)'}; it must be {', '.join(USD_SUFFIXES)}")
    if not source.is_file():
        raise InputError(f"{source}: no such file")
    return _scene_of(source)


@reads_stage
def _scene_of(source: Path) -> Scene:
    stage = open_stage(source)
    errors = stage.GetCompositionErrors()
    if errors:
        raise InputError(f"{source}: does not compose: {errors[0]}")
    stage.SetEditTarget(stage.GetSessionLayer())
    kilograms = float(UsdPhysics.GetStageKilogramsPerUnit(stage))
    if not (math.isfinite(kilograms) and kilograms > 0.0):
        raise InputError(f"{source}: kilogramsPerUnit is {kilograms}; it must be a positive number")
    given = stage.GetRootLayer().timeCodesPerSecond if stage.HasAuthoredMetadata("timeCodesPerSecond") else None
    units = StageUnits(metres_per_unit(stage, source), kilograms)
    up_axis = str(UsdGeom.GetStageUpAxis(stage))
    if up_axis not in ("X", "Y", "Z"):
        raise InputError(f"{source}: upAxis is {up_axis!r}; it must be 'Y' or 'Z'")
    scene = Scene(source, stage, units, up_axis, given)
    scene.uninstanced = _without_instances(stage)
    scene.animated, scene.stopped = _stop_animation(stage)
    scene.physics_scenes = settle_gravity(stage, source)
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.TetMesh):
            above = [stage.GetPrimAtPath(path) for path in prim.GetPath().GetPrefixes()]
            if any(each.IsA(UsdGeom.PointInstancer) for each in above):
                scene.skipped.append(str(prim.GetPath()))
            else:
                scene.tets.append(_tet_prim(prim, source))
    if not scene.tets and scene.skipped:
        raise InputError(f"{source}: its only TetMesh prims are prototypes of a point instancer: {scene.skipped[0]}")
    if not scene.tets:
        raise InputError(
            f"{source}: has no TetMesh prim; meshes of other kinds go into `warp-corot simulate`, "
            "which writes one of what it makes of them with --draw-tets"
        )
    return scene


def _without_instances(stage: Any) -> list[str]:
    """Break up the instances that contain prims that can move by themselves; an instance can only move as a whole."""
    opened: list[str] = []
    while moving := [
        prim
        for prim in stage.Traverse(Usd.TraverseInstanceProxies())
        if prim.IsInstanceProxy() and (prim.IsA(UsdGeom.TetMesh) or prim.HasAPI(UsdPhysics.RigidBodyAPI))
    ]:
        instance = moving[0]
        while not instance.IsInstance() or instance.IsInstanceProxy():
            instance = instance.GetParent()
        opened.append(str(instance.GetPath()))
        instance.SetInstanceable(False)
    return opened


def _stop_animation(stage: Any) -> tuple[list[str], list[str]]:
    """Keep transforms and points at their values of the first time.

    Returns:
        Paths of prims with animated transforms, and of those whose animation physics would have to follow.
    """
    animated, stopped = [], []
    for prim in stage.Traverse():
        if not prim.IsA(UsdGeom.Xformable):
            continue
        attributes = [op.GetAttr() for op in UsdGeom.Xformable(prim).GetOrderedXformOps()]
        if moves := any(attribute.ValueMightBeTimeVarying() for attribute in attributes):
            animated.append(str(prim.GetPath()))
        if prim.IsA(UsdGeom.TetMesh):
            attributes += [UsdGeom.TetMesh(prim).GetPointsAttr(), UsdGeom.TetMesh(prim).GetTetVertexIndicesAttr()]
            moves = any(attribute.ValueMightBeTimeVarying() for attribute in attributes)
        physical = (UsdPhysics.RigidBodyAPI, UsdPhysics.CollisionAPI)
        below = Usd.PrimRange(prim, Usd.TraverseInstanceProxies()) if moves else ()
        if any(each.IsA(UsdGeom.TetMesh) or any(map(each.HasAPI, physical)) for each in below):
            stopped.append(str(prim.GetPath()))
        if prim.IsA(UsdGeom.Mesh):
            attributes += [prim.GetAttribute(name) for name in ("points", "faceVertexCounts", "faceVertexIndices")]
        for attribute in attributes:
            if attribute.GetNumTimeSamples() and attribute.Get() is None:
                attribute.Set(attribute.Get(Usd.TimeCode.EarliestTime()))
    return animated, stopped


def _tet_prim(prim: Any, source: Path) -> TetPrim:
    mesh, name = UsdGeom.TetMesh(prim), f"{source}: {prim.GetPath()}"
    given, indices = mesh.GetPointsAttr().Get(), mesh.GetTetVertexIndicesAttr().Get()
    if given is None or len(given) == 0 or indices is None or len(indices) == 0:
        missing = "points" if given is None or len(given) == 0 else "tetVertexIndices"
        raise InputError(f"{name}: is a TetMesh without {missing}")
    points = np.asarray(given, dtype=np.float64).reshape(-1, 3)
    tets = np.array(indices, dtype=np.int32).reshape(-1, 4)
    if not np.isfinite(points).all():
        raise InputError(f"{name}: point {int(np.argmin(np.isfinite(points).all(axis=1)))} is not finite")
    if tets.min() < 0 or tets.max() >= len(points):
        bad = tets[(tets < 0) | (tets >= len(points))][0]
        raise InputError(f"{name}: names point {bad} but has points 0 to {len(points) - 1}")
    left_handed = mesh.GetOrientationAttr().Get() == UsdGeom.Tokens.leftHanded
    volumes = signed_volumes(points, tets) * (-1.0 if left_handed else 1.0)
    size = float(np.ptp(points, axis=0).max())
    flat = np.flatnonzero(np.abs(volumes) <= 1e-12 * size**3 / len(tets))
    if len(flat):
        raise InputError(f"{name}: {len(flat)} of {len(tets)} tetrahedra have no volume, the first is {flat[0]}")
    # In world coordinates positions are float32.
    matrix = world_matrix(prim, Usd.TimeCode.Default())
    there = (points @ matrix[:3, :3] + matrix[3, :3]).astype(np.float32).astype(np.float64)
    before, after = signed_volumes(points, tets), signed_volumes(there, tets)
    gone = np.count_nonzero(~(after * np.sign(before * np.linalg.det(matrix[:3, :3])) > 0.0))
    if gone:
        raise InputError(
            f"{name}: {gone} of {len(tets)} tetrahedra have too little volume for float32 where they are in the world: "
            "a scale of zero, or too far from the origin"
        )
    wrong = volumes < 0.0
    if wrong.any():
        tets[wrong] = tets[wrong][:, [0, 1, 3, 2]]
        try:
            mesh.GetTetVertexIndicesAttr().Set(tets.tolist())
        except Tf.ErrorException as error:
            raise InputError(f"{name}: its tetrahedra cannot be turned round: {error}") from None
    return TetPrim(str(prim.GetPath()), points, tets, int(wrong.sum()), left_handed)
