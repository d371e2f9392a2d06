"""Small stages for simulation: a soft block, a ground, rigid boxes, in any units and with any axis up."""

from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

newton = pytest.importorskip("newton")
pytest.importorskip("newton_usd_schemas")

import warp_corot as wc  # noqa: E402
from warp_corot.mesh.topology import signed_volumes  # noqa: E402
from warp_corot.newton import StageOptions, StageSimulation  # noqa: E402

YOUNG, DENSITY, CELL = 2e5, 1000.0, 0.1
SIM = "/World/Soft/sim"


class StageMaker:
    """A stage whose world is z-up and in metres for its maker, and in other units and with another axis in the file."""

    def __init__(self, path: Path, metres: float = 1.0, up: str = "Z", kilograms: float = 1.0, scene: bool = True):
        self.path, self.metres, self.up, self.kilograms = path, metres, up, kilograms
        self.stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(self.stage, up)
        UsdGeom.SetStageMetersPerUnit(self.stage, metres)
        if kilograms != 1.0:
            UsdPhysics.SetStageKilogramsPerUnit(self.stage, kilograms)
        self.stage.SetDefaultPrim(UsdGeom.Xform.Define(self.stage, "/World").GetPrim())
        if scene:
            UsdPhysics.Scene.Define(self.stage, "/physicsScene")

    def put(self, points) -> np.ndarray:
        """Points of the maker's world in the stage's."""
        turned = np.asarray(points, float)
        return (turned[..., [1, 2, 0]] if self.up == "Y" else turned) / self.metres

    def block(
        self, body="/World/Soft", cells=(2, 2, 3), at=(0.0, 0.0, 0.0), offset=(0.3, -0.2, 0.5), name="sim", marked=True
    ):
        """A block of cubes of CELL, with its lowest corner at ``at``, under a prim with its own transform."""
        forest = wc.TetForest.box(cells, CELL, 0)
        points = self.put(forest.points + at - np.array(offset))
        tets = forest.tets.copy()
        mirrored = signed_volumes(points, tets) < 0
        tets[mirrored] = tets[mirrored][:, [0, 1, 3, 2]]
        xform = UsdGeom.Xform.Define(self.stage, body)
        xform.AddTranslateOp().Set(Gf.Vec3d(*self.put(offset)))
        tetmesh = UsdGeom.TetMesh.Define(self.stage, f"{body}/{name}")
        tetmesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points.astype(np.float32)))
        tetmesh.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(tets.astype(np.int32)))
        if marked:
            xform.GetPrim().AddAppliedSchema("PhysicsDeformableBodyAPI")
            for schema in ("PhysicsVolumeDeformableSimAPI", "PhysicsCollisionAPI"):
                tetmesh.GetPrim().AddAppliedSchema(schema)
        return tetmesh

    def material(self, prim, young=YOUNG, poisson=0.0, density=DENSITY, path="/Materials/Soft"):
        """A deformable material, in the stage's units, bound for physics."""
        made = UsdShade.Material.Define(self.stage, path)
        made.GetPrim().AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
        pressure = young * self.metres / self.kilograms
        values = {"youngsModulus": pressure, "poissonsRatio": poisson}
        values["density"] = density * self.metres**3 / self.kilograms
        for name, value in values.items():
            made.GetPrim().CreateAttribute(f"physics:{name}", Sdf.ValueTypeNames.Float).Set(value)
        UsdShade.MaterialBindingAPI.Apply(prim.GetPrim()).Bind(made, materialPurpose="physics")

    def ground(self, height=0.0):
        plane = UsdGeom.Plane.Define(self.stage, "/Ground")
        plane.CreateAxisAttr(self.up)
        plane.AddTranslateOp().Set(Gf.Vec3d(*self.put([0.0, 0.0, height])))
        UsdPhysics.CollisionAPI.Apply(plane.GetPrim())

    def box(self, path="/World/Box", at=(0.0, 0.0, 0.0), size=0.2, mass=2.0):
        cube = UsdGeom.Cube.Define(self.stage, path)
        cube.AddTranslateOp().Set(Gf.Vec3d(*self.put(at)))
        cube.AddScaleOp().Set(Gf.Vec3f(0.5 * size / self.metres))
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        UsdPhysics.RigidBodyAPI.Apply(cube.GetPrim())
        UsdPhysics.MassAPI.Apply(cube.GetPrim()).CreateMassAttr(mass / self.kilograms)
        return cube

    def save(self) -> Path:
        self.stage.Save()
        return self.path


def standing(path: Path, height=0.0, **options) -> Path:
    """A block of 2 x 2 x 3 cubes above a ground."""
    made = StageMaker(path, **options)
    made.material(made.block(at=(-0.1, -0.1, height)))
    made.ground()
    return made.save()


def crowd(path, **options) -> StageMaker:
    """A block with a visual material, a box that falls on it, and prims without physics."""
    made = StageMaker(path, **options)
    mesh = made.block(at=(-0.1, -0.1, 0.02))
    made.material(mesh)
    look = UsdShade.Material.Define(made.stage, "/Looks/Skin")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(look)
    made.box(at=(0.02, 0.0, 0.5))
    made.ground()
    UsdGeom.Camera.Define(made.stage, "/Camera")
    return made


def simulated(path: Path, frames: int, device="cpu", **options) -> StageSimulation:
    sim = StageSimulation(path, device=device, **options)
    for _ in range(frames):
        sim.advance()
    return sim


def written(path: Path, out: Path, frames: int, shown=None, **options) -> StageSimulation:
    """The simulation, and its frames in a stage; ``shown`` gets the data of all frames."""
    sim = StageSimulation(path, device="cpu")
    writer = sim.writer(out, **options)
    for frame in range(frames + 1):
        if frame:
            sim.advance()
        state = sim.show()
        writer.write(state)
        if shown is not None:
            shown.append(state)
    writer.close()
    return sim


def world_points(stage: Usd.Stage, path: str, frame: float) -> np.ndarray:
    prim = stage.GetPrimAtPath(path)
    matrix = np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(prim))
    points = np.array(UsdGeom.PointBased(prim).GetPointsAttr().Get(frame), float)
    return points @ matrix[:3, :3] + matrix[3, :3]


__all__ = [
    "CELL",
    "DENSITY",
    "SIM",
    "YOUNG",
    "StageMaker",
    "StageOptions",
    "StageSimulation",
    "crowd",
    "newton",
    "simulated",
    "standing",
    "wc",
    "world_points",
    "written",
]
