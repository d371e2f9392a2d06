"""The stages that are written over scenes: their content, what they keep, and that they are valid."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdValidation, Vt
from scene_stages import SIM, StageMaker, StageSimulation, crowd, standing, wc, world_points, written

from warp_corot.cli import main
from warp_corot.io.pictures.colors import stress_colors
from warp_corot.newton import StageOptions


def pose(stage, path, frame):
    return np.array(UsdGeom.XformCache(frame).GetLocalToWorldTransform(stage.GetPrimAtPath(path)))


@pytest.mark.parametrize("form", [{}, {"metres": 0.01, "up": "Y"}])
def test_frames_have_the_state_of_the_solver(tmp_path, form):
    shown = []
    sim = written(crowd(tmp_path / "in.usda", **form).save(), tmp_path / "out.usdc", 8, shown)
    stage = Usd.Stage.Open(str(tmp_path / "out.usdc"))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 8, 24)
    mesh = UsdGeom.TetMesh.Get(stage, SIM)
    stress = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("vonMises")
    assert stress.GetInterpolation() == "uniform"
    size = 1.0 / sim.scene.units.metres
    whole = UsdGeom.Boundable.ComputeExtentFromPlugins
    for frame, state in enumerate(shown):
        np.testing.assert_allclose(world_points(stage, SIM, frame), state.positions[0], atol=1e-6 * size)
        np.testing.assert_array_equal(stress.Get(frame), state.von_mises[0])
        np.testing.assert_allclose(mesh.GetVelocitiesAttr().Get(frame), state.velocities[0], atol=1e-6 * size)
        np.testing.assert_allclose(mesh.GetExtentAttr().Get(frame), whole(mesh, frame))
        box = pose(stage, "/World/Box", frame)
        np.testing.assert_allclose(box[3, :3], state.bodies[0, 3, :3], atol=1e-6 * size)
        turned = state.bodies[0, :3, :3] * 0.1 * size
        np.testing.assert_allclose(box[:3, :3], turned, atol=1e-5 * size)
    assert np.ptp([state.bodies[0, 3, :3] for state in shown], axis=0).max() > 0.1 * size
    assert len(stress.Get(8)) == len(mesh.GetTetVertexIndicesAttr().Get()) == 72


def test_colours_show_the_stress_by_default(tmp_path):
    made = StageMaker(tmp_path / "in.usda")
    mesh = made.block()
    made.material(mesh)
    plain = made.block(body="/World/Other", at=(0.5, 0.0, 0.0))
    made.material(plain)
    UsdGeom.PrimvarsAPI(plain).CreatePrimvar("displayColor", Sdf.ValueTypeNames.Color3fArray).Set([(0, 1, 0)])
    made.ground()
    path = made.save()
    shown = []
    written(path, tmp_path / "out.usda", 6, shown)
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    legend = stage.GetDefaultPrim().GetCustomData()["stressColors"]
    color = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(SIM)).GetPrimvar("displayColor")
    assert len(color.Get()) == len(stress_colors())
    assert color.GetInterpolation() == "vertex"
    # A node's colour is a mean over the tetrahedra around it: none exceeds the highest of them.
    tets = np.array(UsdGeom.TetMesh.Get(stage, SIM).GetTetVertexIndicesAttr().Get())
    for frame in (2, 6):
        stress = shown[frame].von_mises[0]
        at_node = np.array(color.GetIndices(frame)) / 255 * legend["highest"]
        for node in range(36):
            around = np.minimum(stress[(tets == node).any(axis=1)], legend["highest"])
            step = legend["highest"] / 255
            assert around.min() - step <= at_node[node] <= around.max() + step
    kept = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/Other/sim")).GetPrimvar("displayColor")
    np.testing.assert_array_equal(kept.Get(), [(0, 1, 0)])
    written(path, tmp_path / "shown.usda", 1, show_stress=True)
    stage = Usd.Stage.Open(str(tmp_path / "shown.usda"))
    kept = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/World/Other/sim")).GetPrimvar("displayColor")
    assert len(kept.Get()) == len(stress_colors())


def bound(stage, purpose=UsdShade.Tokens.allPurpose) -> str:
    material, _ = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath(SIM)).ComputeBoundMaterial(purpose)
    return str(material.GetPath())


def test_the_output_composes_and_keeps_what_it_does_not_move(tmp_path):
    source = crowd(tmp_path / "in.usda", metres=0.01, up="Y").save()
    before = source.read_bytes()
    written(source, tmp_path / "out.usda", 3)
    assert source.read_bytes() == before
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert not stage.GetCompositionErrors()
    assert UsdGeom.GetStageMetersPerUnit(stage) == 0.01
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert str(stage.GetDefaultPrim().GetPath()) == "/World"
    assert stage.GetPrimAtPath("/Camera").IsA(UsdGeom.Camera)
    assert bound(stage) == bound(stage, "full") == "/Looks/Skin"
    assert bound(stage, "physics") == "/Materials/Soft"
    assert not problems(tmp_path / "out.usda") - problems(source)


def problems(path) -> set[str]:
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    return {f"{error.GetName()}: {error.GetMessage()}" for error in context.Validate(Usd.Stage.Open(str(path)))}


def test_both_files_can_be_moved_together_and_a_flat_one_alone(tmp_path):
    (tmp_path / "there").mkdir()
    (tmp_path / "elsewhere").mkdir()
    source = crowd(tmp_path / "in.usda").save()
    written(source, tmp_path / "there" / "out.usda", 2)
    written(source, tmp_path / "flat.usdc", 2, flatten=True)
    ends = [world_points(Usd.Stage.Open(str(tmp_path / "there" / "out.usda")), SIM, 2.0)]
    shutil.move(tmp_path / "there", tmp_path / "elsewhere" / "there")
    shutil.move(source, tmp_path / "elsewhere" / "in.usda")
    for path in (tmp_path / "elsewhere" / "there" / "out.usda", tmp_path / "flat.usdc"):
        stage = Usd.Stage.Open(str(path))
        assert not stage.GetCompositionErrors()
        assert bound(stage) == "/Looks/Skin"
        ends.append(world_points(stage, SIM, 2.0))
    np.testing.assert_array_equal(ends[1:], [ends[0], ends[0]])
    assert sorted(file.name for file in tmp_path.iterdir()) == ["elsewhere", "flat.usdc"]


def test_stress_can_take_the_place_of_materials(tmp_path):
    written(crowd(tmp_path / "in.usda").save(), tmp_path / "out.usda", 1, show_stress=True)
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert bound(stage, "full") == bound(stage, "preview") == "/simulated_look"
    assert bound(stage, "physics") == "/Materials/Soft"
    shader, *_ = UsdShade.Material.Get(stage, "/simulated_look").ComputeSurfaceSource()
    reader = UsdShade.Shader(shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source.GetPrim())
    assert reader.GetInput("varname").Get() == "displayColor"


def test_faces_are_drawn_from_outside(tmp_path):
    """TetMesh prims are drawn by their surface faces, which are added if the stage has none."""
    written(standing(tmp_path / "in.usda"), tmp_path / "out.usda", 1)
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    faces = np.array(UsdGeom.TetMesh.Get(stage, SIM).GetSurfaceFaceVertexIndicesAttr().Get())
    a, b, c = np.moveaxis(world_points(stage, SIM, 0.0)[faces], 1, 0)
    assert np.einsum("fc,fc->", a, np.cross(b, c)) / 6 == pytest.approx(0.2 * 0.2 * 0.3, rel=1e-3)


def test_instances_move_each_by_itself(tmp_path):
    made = StageMaker(tmp_path / "in.usda")
    made.material(made.block(body="/Prototype/Soft", at=(0.0, 0.0, 0.0)))
    made.stage.GetPrimAtPath("/Prototype").SetSpecifier(Sdf.SpecifierClass)
    for name, height in (("A", 0.02), ("B", 1.0)):
        instance = UsdGeom.Xform.Define(made.stage, f"/World/{name}")
        instance.AddTranslateOp().Set(Gf.Vec3d(0.0 if name == "A" else 1.0, 0.0, height))
        instance.GetPrim().GetReferences().AddInternalReference("/Prototype")
        instance.GetPrim().SetInstanceable(True)
    made.ground()
    shown = []
    sim = written(made.save(), tmp_path / "out.usda", 6, shown)
    assert [body.prim.path for body in sim.parts.soft] == ["/World/A/Soft/sim", "/World/B/Soft/sim"]
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    for index, body in enumerate(sim.parts.soft):
        np.testing.assert_allclose(world_points(stage, body.prim.path, 6), shown[6].positions[index], atol=1e-6)
    fallen = [shown[0].positions[i][:, 2].mean() - shown[6].positions[i][:, 2].mean() for i in range(2)]
    assert fallen[0] < 0.05
    assert fallen[1] > 0.25


def test_prims_under_what_is_animated_are_where_the_solver_has_them(tmp_path):
    made = StageMaker(tmp_path / "in.usda")
    carrier = UsdGeom.Xform.Define(made.stage, "/World/Carrier")
    turn = carrier.AddRotateZOp()
    for frame in (0, 10):
        turn.Set(30.0 + 9.0 * frame, frame)
    made.material(made.block(body="/World/Carrier/Soft", at=(0.0, 0.0, 0.02)))
    made.box(path="/World/Carrier/Box", at=(0.8, 0.0, 0.5))
    made.ground()
    shown = []
    written(made.save(), tmp_path / "out.usda", 6, shown)
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    angle = np.radians(30)
    np.testing.assert_allclose(shown[0].bodies[0, 3, :2], [0.8 * np.cos(angle), 0.8 * np.sin(angle)], atol=1e-6)
    for frame in (0, 6):
        points = world_points(stage, "/World/Carrier/Soft/sim", frame)
        np.testing.assert_allclose(points, shown[frame].positions[0], atol=1e-6)
        np.testing.assert_allclose(pose(stage, "/World/Carrier/Box", frame)[3, :3], shown[frame].bodies[0, 3, :3])


def test_graphics_meshes_go_along(tmp_path):
    """A Mesh beside the simulated tetrahedra is bound to them: its points are some of theirs, and one inside."""
    made = StageMaker(tmp_path / "in.usda")
    mesh = made.block(at=(-0.1, -0.1, 0.02))
    made.material(mesh)
    skin = UsdGeom.Mesh.Define(made.stage, "/World/Soft/skin")
    points = np.array(mesh.GetPointsAttr().Get())[[0, 1, 3, 30]]
    points = np.vstack([points, points.mean(axis=0)]).astype(np.float32)
    skin.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(points))
    skin.CreateFaceVertexCountsAttr([3, 3, 3])
    skin.CreateFaceVertexIndicesAttr([0, 1, 4, 1, 2, 4, 2, 3, 4])
    skin.CreateNormalsAttr([(0, 0, 1)] * 5)
    made.box(at=(0.02, 0.0, 0.5))
    made.ground()
    shown = []
    written(made.save(), tmp_path / "out.usda", 6, shown)
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    x = world_points(stage, "/World/Soft/skin", 6)
    np.testing.assert_allclose(x[:4], shown[6].positions[0][[0, 1, 3, 30]], atol=1e-5)
    assert np.abs(x[4] - shown[0].surfaces[0][4]).max() > 0.01
    assert UsdGeom.Mesh.Get(stage, "/World/Soft/skin").GetNormalsAttr().Get() is None


@pytest.mark.filterwarnings("ignore:.*surface thickness")
def test_cloth_goes_along(tmp_path):
    made = StageMaker(tmp_path / "in.usda", metres=0.01)
    made.material(made.block(at=(0.0, 0.0, 0.5)))
    body = UsdGeom.Xform.Define(made.stage, "/World/Cloth")
    body.GetPrim().AddAppliedSchema("PhysicsDeformableBodyAPI")
    body.AddTranslateOp().Set(Gf.Vec3d(*made.put([0.0, 0.0, 0.4])))
    sheet = UsdGeom.Mesh.Define(made.stage, "/World/Cloth/sim")
    corners = made.put([[1.0, 0.0, 0.0], [1.2, 0.0, 0.0], [1.2, 0.2, 0.0], [1.0, 0.2, 0.0]])
    sheet.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(corners.astype(np.float32)))
    sheet.CreateFaceVertexCountsAttr([3, 3])
    sheet.CreateFaceVertexIndicesAttr([0, 1, 2, 0, 2, 3])
    sheet.GetPrim().AddAppliedSchema("PhysicsSurfaceDeformableSimAPI")
    made.ground()
    shown = []
    sim = written(made.save(), tmp_path / "out.usda", 4, shown)
    assert sim.dt < sim.solver.contact_dt
    x = [world_points(Usd.Stage.Open(str(tmp_path / "out.usda")), "/World/Cloth/sim", f) for f in (0, 4)]
    np.testing.assert_allclose(x[0][:, 2], 40.0, atol=1e-4)
    np.testing.assert_allclose(x[1], shown[4].surfaces[0], atol=1e-4)
    assert 40.0 - x[1][:, 2].mean() == pytest.approx(100 * 0.5 * 9.81 * sim.time**2, rel=0.02)


# XPBD's own kernels compile for a quarter of a minute.
@pytest.mark.parametrize("rigid", ["semi-implicit", pytest.param("xpbd", marks=pytest.mark.slow), "none"])
def test_solvers_of_rigid_bodies(tmp_path, rigid):
    made = StageMaker(tmp_path / "in.usda")
    made.material(made.block(at=(0.0, 0.0, 1.0)))
    made.box(at=(1.0, 0.0, 2.0))
    sim = StageSimulation(made.save(), device="cpu", rigid=rigid, options=StageOptions(ground="none"))
    for _ in range(6):
        sim.advance()
    fallen = 2.0 - sim.body_poses()[0, 3, 2]
    assert fallen == pytest.approx(0.0 if rigid == "none" else 0.5 * 9.81 * 0.25**2, rel=0.01)


def run(*args) -> int:
    return main(["scene", *map(str, args), "--device", "cpu"])


def test_one_command(tmp_path, capsys):
    source = crowd(tmp_path / "in.usda").save()
    assert run(source, "-o", tmp_path / "out.usd", "--duration", "0.25", "--fps", "40") == 0
    out, err = capsys.readouterr()
    assert "/World/Soft/sim: 36 points, 72 tetrahedra; E = 200 kPa, nu = 0, rho = 1000 kg/m^3" in out
    assert "rigid bodies  /World/Box" in out
    assert "11 frames, 0.25 s" in out
    assert "error" not in err
    stage = Usd.Stage.Open(str(tmp_path / "out.usd"))
    assert (stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (10, 40)


def test_a_ground_that_was_added_is_drawn(tmp_path, capsys):
    made = StageMaker(tmp_path / "in.usda", up="Y")
    made.block(at=(0.0, 0.0, 0.7), marked=False)
    assert run(made.save(), "-o", tmp_path / "out.usda", "--duration", "0.1", "--ground", "0.5") == 0
    assert "no physics material" in capsys.readouterr().err
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    corners = world_points(stage, "/simulated_ground", 0.0)
    np.testing.assert_allclose(corners[:, 1], 0.5)
    assert (np.ptp(corners, axis=0)[[0, 2]] > 1.0).all()


def test_a_state_that_is_not_finite_leaves_the_frames_before(tmp_path, monkeypatch):
    source = standing(tmp_path / "in.usda")
    sim = StageSimulation(source, device="cpu", options=StageOptions(viscosity=0.0))
    advance, count = StageSimulation.advance, []

    def spoilt(self):
        count.append(1)
        if len(count) == 3:
            self.state.particle_qd.fill_(3e38)
        advance(self)

    monkeypatch.setattr(StageSimulation, "advance", spoilt)
    assert run(source, "-o", tmp_path / "out.usda") == 3
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert stage.GetEndTimeCode() == 2
    assert np.isfinite(world_points(stage, SIM, 2)).all()
    assert sim.parts.model.tet_count == 72


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
@pytest.mark.parametrize(
    ("number", "status"),
    [
        pytest.param(signal.SIGINT, 130, marks=pytest.mark.slow),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow),
        pytest.param(signal.SIGKILL, -9, marks=pytest.mark.slow),
    ],
)
def test_the_stage_opens_however_a_run_ends(tmp_path, number, status):
    """Even after a kill, when the pieces play: with the looks of the stage below, and our motion."""
    crowd(tmp_path / "in.usda").save()
    command = [sys.executable, "-m", "warp_corot", "scene", "in.usda", "-o", "out.usda", "--device", "cpu"]
    process = subprocess.Popen(
        [*command, "--duration", "100000"], cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )  # fmt: skip
    try:
        for _ in range(600):
            if (tmp_path / "out.usda").exists() or process.poll() is not None:
                break
            time.sleep(0.1)
        process.send_signal(number)
        out, err = process.communicate(timeout=60)
    finally:
        process.kill()
    assert process.returncode == status, err
    assert out == ""
    stage = Usd.Stage.Open(str(tmp_path / "out.usda"))
    assert not stage.GetCompositionErrors()
    end = stage.GetEndTimeCode()
    assert end > 1
    if number != signal.SIGKILL:
        match = re.search(r"interrupted; (\d+) frames, .* s, are kept in out\.usda", err)
        assert match, err
        assert int(match[1]) == end + 1
        assert sorted(file.name for file in tmp_path.iterdir()) == ["in.usda", "out.usda"]
    assert bound(stage, "full") == "/Looks/Skin"
    # Both are in free fall: (z0 - g t^2 / 2).
    t = 1 / 24
    fallen = [world_points(stage, SIM, f)[:, 2].min() for f in (0, 1)]
    assert fallen[0] - fallen[1] == pytest.approx(0.5 * 9.81 * t**2, rel=0.1)
    boxes = [pose(stage, "/World/Box", f)[3, 2] for f in (0, 1)]
    assert boxes[0] - boxes[1] == pytest.approx(0.5 * 9.81 * t**2, rel=0.1)
    stress = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(SIM)).GetPrimvar("vonMises").Get(end)
    assert len(stress) == 72


def test_frames_that_are_written_after_the_end(tmp_path):
    sim = StageSimulation(standing(tmp_path / "in.usda"), device="cpu")
    writer = sim.writer(tmp_path / "out.usda")
    writer.write(sim.show())
    writer.close()
    writer.close()
    with pytest.raises(wc.InputError, match="is closed"):
        writer.write(sim.show())
