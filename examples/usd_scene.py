"""Jelly falls on a table, and a ball on the jelly: a USD stage made with OpenUSD and stepped in Newton.

The motion and the stress of every tetrahedron are written over the stage, which stays beside the output. The command
`warp-corot scene jelly-stage.usda -o jelly.usd` does the same.
"""

import argparse
from pathlib import Path

from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, UsdShade, Vt

import warp_corot as wc
from warp_corot.newton import StageSimulation

parser = argparse.ArgumentParser(description=__doc__)
parser.add_argument("--device", help="cpu or cuda:0")
parser.add_argument("-o", "--output", default="jelly.usd", type=Path)
parser.add_argument("--duration", type=float, default=2.0, help="seconds simulated")
args = parser.parse_args()
source = args.output.with_name(f"{args.output.stem}-stage.usda")
stage = Usd.Stage.CreateNew(str(source))
UsdGeom.SetStageMetersPerUnit(stage, 1.0)
UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/SoftBody").GetPrim())
UsdPhysics.Scene.Define(stage, "/physicsScene")

forest = wc.TetForest.box(cells=(4, 4, 2), cell_size=0.05, level=1)
mesh = wc.TetMesh(forest.points, forest.tets)  # repairs mirrored tetrahedra
jelly = UsdGeom.TetMesh.Define(stage, "/SoftBody/tetrahedra")
jelly.AddTranslateOp().Set(Gf.Vec3d(-0.1, -0.1, 0.05))
jelly.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(mesh.points.astype("float32")))
jelly.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(mesh.tets))
for schema in ("PhysicsVolumeDeformableSimAPI", "PhysicsCollisionAPI"):
    jelly.GetPrim().AddAppliedSchema(schema)
stage.GetDefaultPrim().AddAppliedSchema("PhysicsDeformableBodyAPI")

material = UsdShade.Material.Define(stage, "/SoftBody/material")
material.GetPrim().AddAppliedSchema("PhysicsVolumeDeformableMaterialAPI")
for name, value in (("youngsModulus", 1e4), ("poissonsRatio", 0.45), ("density", 1000.0)):  # Pa, -, kg/m^3
    material.GetPrim().CreateAttribute(f"physics:{name}", Sdf.ValueTypeNames.Float).Set(value)
UsdShade.MaterialBindingAPI.Apply(jelly.GetPrim()).Bind(material, materialPurpose="physics")

table = UsdGeom.Cube.Define(stage, "/table")
table.AddTranslateOp().Set(Gf.Vec3d(0.0, 0.0, -0.05))
table.AddScaleOp().Set(Gf.Vec3f(0.4, 0.4, 0.05))
ball = UsdGeom.Sphere.Define(stage, "/ball")
ball.CreateRadiusAttr(0.04)
ball.AddTranslateOp().Set(Gf.Vec3d(0.01, 0.0, 0.3))
for prim in (table.GetPrim(), ball.GetPrim()):
    UsdPhysics.CollisionAPI.Apply(prim)
UsdPhysics.RigidBodyAPI.Apply(ball.GetPrim())
UsdPhysics.MassAPI.Apply(ball.GetPrim()).CreateMassAttr(0.3)
stage.Save()
sim = StageSimulation(source, device=args.device)
writer = sim.writer(args.output)
for frame in range(round(args.duration * sim.fps) + 1):
    if frame:
        sim.advance()
    writer.write(sim.show())
writer.close()
print(f"wrote {args.output}, over {source}")
