"""Loads of the command over time, its measurements, and run files."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_line import SHORT, assert_refused, run, simulate, table
from input_files import write_surface, write_vtk
from pxr import Usd, UsdGeom, UsdPhysics, UsdShade
from stages import TETS, frames, opened

import warp_corot as wc

BAR = wc.TetForest.box((4, 1, 1), 0.05, 3)
LENGTH, EDGE = 0.2, 0.05
STILL = ["--gravity", 0, 0, 0, "--device", "cpu", "--fix", "x == xmin", "--damping", 60]


@pytest.fixture
def bar(folder) -> Path:
    write_vtk(folder / "bar.vtk", BAR.points, BAR.tets)
    return folder / "bar.vtk"


def test_a_pull_meets_the_stiffness_of_the_bar(bar, folder):
    """At a strain of 1 %, the end pulls back with nearly E A times the strain; not quite, because the fixed face cannot
    narrow."""
    args = ["--young", 1e4, "--poisson", 0, "--pull", "x == xmax", 0.002, 0, 0, "--ramp", 0.5, "--duration", 1]
    probes = ["--probe", "x == xmax", "--probe", "0.1 0.025 0.025", "--csv", "a.csv"]
    assert simulate("bar.vtk", "-o", "a.usd", *args, *probes, *STILL, "--fps", 10) == 0
    column = table("a.csv")
    assert next(iter(column)) == "time [s]"
    assert len(column["time [s]"]) == 11
    np.testing.assert_allclose(column["time [s]"], np.arange(11) / 10, atol=1e-9)
    moved = column["x == xmax ux [m]"]
    np.testing.assert_allclose(moved, 0.002 * np.minimum(2 * column["time [s]"], 1.0), atol=1e-7)
    np.testing.assert_allclose(column["x == xmax vx [m/s]"][1:5], 0.004, rtol=1e-4)
    force = 1e4 * EDGE**2 * 0.002 / LENGTH
    assert column["x == xmax reaction x [N]"][-1] == pytest.approx(force, rel=0.02)
    assert column["elastic [J]"][-1] == pytest.approx(0.5 * force * 0.002, rel=0.02)
    assert column["0.1 0.025 0.025 ux [m]"][-1] == pytest.approx(0.001, rel=0.02)
    rest, *_, last = frames(folder / "a.usd")
    np.testing.assert_allclose((last - rest)[BAR.points[:, 0] == LENGTH], [[0.002, 0, 0]] * 9, atol=1e-6)


def test_a_twist_turns_the_patch_as_a_whole(bar, folder):
    args = ["--young", 1e4, "--twist", "x == xmax", 90, "--ramp", 0.2, "--duration", 0.3, "--fps", 10]
    assert simulate("bar.vtk", "-o", "a.usd", *args, *STILL) == 0
    rest, _, _, last = frames(folder / "a.usd")
    end = BAR.points[:, 0] == LENGTH
    centre = np.array([LENGTH, EDGE / 2, EDGE / 2])
    arms = rest[end] - centre
    # Counter-clockwise seen from outside, which is from +x: y goes to z.
    turned = np.stack([arms[:, 0], -arms[:, 2], arms[:, 1]], axis=1) + centre
    np.testing.assert_allclose(last[end], turned, atol=1e-6)


def test_a_pressure_shortens_the_bar(bar):
    args = [
        "--young",
        1e4,
        "--poisson",
        0,
        "--press",
        "x == xmax",
        "0.1kPa",
        "--ramp",
        "300ms",
        "--duration",
        1.2,
        "--fps",
        5,
    ]
    assert simulate("bar.vtk", "-o", "a.usd", *args, *STILL, "--probe", "x == xmax", "--csv", "a.csv") == 0
    assert table("a.csv")["x == xmax ux [m]"][-1] == pytest.approx(-LENGTH * 100 / 1e4, rel=0.03)


def test_patches_by_name_region_and_nearest_point(bar, folder):
    args = [
        "--patch",
        "tip=nearest(0.2, 0, 0, 3)",
        "--fix",
        "tip",
        "--fix",
        "sphere(0, 0, 0, 0.01) or box(0, 0.04, 0, 1, 1, 1)",
    ]
    assert simulate("bar.vtk", "-o", "a.usd", *args, *SHORT) == 0
    _stage, tets = opened(folder / "a.usd")
    held = np.array(UsdGeom.PrimvarsAPI(tets).GetPrimvar("fixed").Get()) == 1
    x = BAR.points
    away = np.linalg.norm(x - [0.2, 0, 0], axis=1)
    expected = (np.linalg.norm(x, axis=1) <= 0.01) | (x[:, 1] >= 0.04)
    expected[np.argsort(away, kind="stable")[:3]] = True
    np.testing.assert_array_equal(held, expected)


def test_regions_have_their_own_material(bar, folder):
    args = ["--young", 1e4, "--region", "x > 0.1", "30kPa:0.3", "--region", "x > 0.15", "50kPa:0.3:1200"]
    assert simulate("bar.vtk", "-o", "a.usd", *args, *SHORT) == 0
    _stage, tets = opened(folder / "a.usd")
    primvars, x = UsdGeom.PrimvarsAPI(tets), BAR.points[BAR.tets].mean(axis=1)[:, 0]
    expected = np.select([x > 0.15, x > 0.1], [5e4, 3e4], 1e4)
    np.testing.assert_allclose(primvars.GetPrimvar("young").Get(), expected)
    np.testing.assert_allclose(primvars.GetPrimvar("density").Get(), np.where(x > 0.15, 1200, 1000))
    # The same materials as subsets, with every tetrahedron in one of them.
    seen = np.zeros(len(x))
    for prim in tets.GetPrim().GetChildren():
        material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial("physics")[0].GetPrim()
        inside = np.array(UsdGeom.Subset(prim).GetIndicesAttr().Get())
        seen[inside] += 1
        np.testing.assert_allclose(expected[inside], material.GetAttribute("physics:youngsModulus").Get())
    np.testing.assert_array_equal(seen, 1)


RUN = """
output = "out/a.usd"
csv = "out/a.csv"
duration = 0.2
fps = 10
device = "cpu"
gravity = [0, 0, 0]
damping = 60

[[body]]
input = "bar.vtk"
young = 1e4
fix = "x == xmin"
pull = [{ patch = "x == xmax", by = [0, 0, 0.01], times = [0, 0.1, 0.2], shares = [0, 1, 0] }]
probe = ["x == xmax"]

[[body]]
input = "organ.glb"
tets = 400
fix = ["bottom", "-x > 0.025"]
press = [["x > 0.02", -50]]
region = [["z > 0", "30kPa"]]
"""


def test_a_run_file_has_several_bodies_and_comes_back(bar, folder):
    write_surface(folder / "organ.glb", False)
    (folder / "out").mkdir()
    (folder / "run.toml").write_text(RUN)
    assert simulate("run.toml", "--write-run", "out/again.toml") == 0
    np.testing.assert_allclose(table("out/a.csv")["body 1: x == xmax uz [m]"], [0, 0.01, 0], atol=1e-6)
    again = tomllib.loads((folder / "out" / "again.toml").read_text(encoding="utf-8"))
    assert again["output"] == "a.usd"
    assert [body["input"] for body in again["body"]] == ["../bar.vtk", "../organ.glb"]
    first = frames_of(folder / "out/a.usd")
    assert simulate("out/again.toml") == 0
    np.testing.assert_array_equal(frames_of(folder / "out/a.usd"), first)
    # Options on the command line are used and written with the rest.
    assert simulate("out/again.toml", "-o", "b.usd", "--fps", 5, "--write-run", "third.toml") == 0
    third = tomllib.loads((folder / "third.toml").read_text(encoding="utf-8"))
    assert (third["fps"], third["output"]) == (5.0, "b.usd")
    assert len(frames_of(folder / "b.usd")) == 2


def frames_of(path) -> np.ndarray:
    stage = Usd.Stage.Open(str(path))
    points = UsdGeom.Mesh.Get(stage, "/SoftBody/surface").GetPointsAttr()
    return np.array([points.Get(k) for k in range(int(stage.GetEndTimeCode()) + 1)])


def test_options_are_written_as_a_run_file(bar, folder):
    args = ["--fix", "x == xmin", "--pull", "x == xmax", 0, 0, -0.01, "--young", 2e4, *SHORT]
    assert simulate("bar.vtk", "-o", "a.usd", *args, "--write-run", "run.toml") == 0
    run = tomllib.loads((folder / "run.toml").read_text(encoding="utf-8"))
    assert run["fix"] == ["x == xmin"]
    assert run["pull"] == [["x == xmax", 0.0, 0.0, -0.01]]
    first = frames(folder / "a.usd")
    assert simulate("run.toml", "-o", "b.usd") == 0
    np.testing.assert_array_equal(frames(folder / "b.usd"), first)


def test_a_stage_names_its_input_and_command(bar, folder):
    assert simulate("bar.vtk", "-o", "a.usd", "--young", 2e4, "--fix", "x == xmin", *SHORT) == 0
    stage, tets = opened(folder / "a.usd")
    said = stage.GetRootLayer().customLayerData["warp_corot"]
    assert said["program"].startswith("warp_corot ")
    assert "simulate bar.vtk -o a.usd" in said["command"]
    assert len(said["body1"]["inputSha256"]) == 64
    assert said["body1"]["held"] == "held where x == xmin"
    assert said["heldNodes"] == 9
    assert said["device"].startswith("cpu")
    assert 0 < said["shortestStep"] <= said["longestStep"]
    assert "Corotated" in said["models"]["body1"]
    material = UsdShade.MaterialBindingAPI(tets.GetPrim()).ComputeBoundMaterial("physics")[0].GetPrim()
    values = [material.GetAttribute(f"physics:{name}").Get() for name in ("youngsModulus", "poissonsRatio", "density")]
    assert values == pytest.approx([2e4, 0.45, 1000.0])
    scene = UsdPhysics.Scene(stage.GetPrimAtPath("/SoftBody/physics/scene"))
    assert scene.GetGravityMagnitudeAttr().Get() == pytest.approx(9.81)
    assert UsdPhysics.GetStageKilogramsPerUnit(stage) == 1.0


def test_surfaces_have_velocities(folder):
    write_surface(folder / "organ.glb", False)
    args = ["--tets", 400, "--skin", "marched", "--fix", "none", *SHORT]
    assert simulate("organ.glb", "-o", "a.usd", *args) == 0
    stage = Usd.Stage.Open(str(folder / "a.usd"))
    assert stage.GetRootLayer().customLayerData["warp_corot"]["body1"]["held"] == "free, nothing is held"
    mesh = UsdGeom.Mesh.Get(stage, "/SoftBody/surface")
    velocities = np.array(mesh.GetVelocitiesAttr().Get(2))
    t, c = 0.05, 2.0  # free fall, damped by 2 /s
    np.testing.assert_allclose(velocities[:, 1], -9.81 / c * (1 - np.exp(-c * t)), rtol=0.01)


@pytest.mark.slow
def test_an_output_goes_into_a_scene(bar, folder):
    pytest.importorskip("newton")
    pytest.importorskip("newton_usd_schemas")
    assert simulate("bar.vtk", "-o", "a.usd", "--young", 2e4, "--fix", "x == xmin", *SHORT) == 0
    assert run("scene", "a.usd", "-o", "b.usd", "--duration", 0.1, "--fps", 20, "--device", "cpu") == 0
    stage = Usd.Stage.Open(str(folder / "b.usd"))
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    first, last = (np.array(tets.GetPointsAttr().Get(k)) for k in (0, 2))
    end = BAR.points[:, 0] == 0.0
    np.testing.assert_array_equal(last[end], first[end])
    assert (last - first)[BAR.points[:, 0] == LENGTH, 2].max() < -0.01


def test_unlikely_options_are_noted(bar, capsys):
    args = ["--fix", "x == xmin", "--pull", "z == zmax", 0, 0, "1mm", "--ramp", 2, "--density", 1.1, *SHORT]
    assert simulate("bar.vtk", "-o", "a.usd", *args) == 0
    said = capsys.readouterr().err
    assert "3 of its nodes are named by --fix, too, and move" in said
    assert "--ramp is 2 s, longer than the run: loads reach 2% of their values" in said
    assert "--density is 1.1 kg/m^3, far less than water; write 1.1g/cm3 for g/cm^3" in said


REFUSED = [
    (["--pull", "x == xmax", "0", "0", "up"], "'up' is not a number"),
    (["--pull", "x > 9", "0", "0", "1"], "--pull 'x > 9': there are no nodes in it"),
    (["--pull", "x > 0.1", "0", "0", "1", "--twist", "top", "9"], "of its nodes are moved by another option"),
    (["--pull", "all", "0", "0", "1"], "all nodes are moved"),
    (["--press", "nearest(0, 0, 0)", "5"], "no part of the surface is in it"),
    (["--ramp", "1"], "--ramp is for --pull"),
    (["--ramp", "0", "--press", "top", "5"], "--ramp is 0 s"),
    (["--patch", "tip"], "it must be NAME=EXPR"),
    (["--patch", "x=all"], "x is already a name"),
    (["--fix", "tip"], "'tip' is not known"),
    (["--fix", "botom"], "'botom' is not known (did you mean bottom?); names are all, bottom, "),
    (["--fix", "x == xmax", "--pull", "x == xmax", "0", "0", "1"], "all of its nodes are held by --fix"),
    (["--yuong", "5kPa"], "there is no option --yuong (did you mean --young?)"),
    (["--young", "5kpa"], "the unit 'kpa' is not known (did you mean kPa?)"),
    (["--model", "corrotated"], "(did you mean corotated?)"),
    (["--skin", "marched"], "--skin is for surfaces"),
    (["--rotation-level", "2"], "--rotation-level is for box, surfaces and scans"),
    (["more"], "'more' is one word too many"),
    (["--fix", "sphere(x, 0, 0, 1)"], "differs from node to node"),
    (["--fix", "nearest(0, 0, 0, 0.5)"], "nearest takes a number of nodes"),
    (["--fix", "box(0, 0, 1)"], "box takes 6 arguments, not 3"),
    (["--region", "x > 0.1", "hard"], "'hard' is not a number"),
    (["--region", "x > 9", "5kPa"], "there is no tetrahedron in it"),
    (["--probe", "top"], "--probe is for --csv"),
    (["--probe", "9 9 9", "--csv", "a.csv"], "m outside the body"),
    (["--csv", "a.txt"], "a.txt: extension .txt"),
    (["--csv", "nowhere/a.csv"], "output folder nowhere does not exist"),
    (["--write-run", "run.txt"], "run.txt: extension .txt"),
]


@pytest.mark.parametrize(("args", "said"), REFUSED, ids=[" ".join(args)[:40] for args, _ in REFUSED])
def test_bad_options_are_one_line(bar, folder, args, said, capsys):
    assert_refused(folder, capsys, said, "bar.vtk", "-o", "a.usd", *args)


BAD_RUNS = [
    ("input = ", "is not TOML"),
    ("duration = 1", "a body has no 'input'"),
    ("input = 'bar.vtk'\ncolour = 'red'", "'colour' is not an option"),
    ("input = 'bar.vtk'\nyuong = '5kPa'", "'yuong' is not an option, 'young' is; see"),
    ("input = 'bar.vtk'\nyoung = []", "young = [] does not fit the option"),
    ("input = 'bar.vtk'\nyoung = 'soft'", "run.toml: argument --young"),
    ("input = 7", "input = 7 must be a name"),
    ("body = 3", "'body' must be tables"),
    ("[[body]]\ninput = 'bar.vtk'\nfps = 3", "'fps' is for the whole run"),
    ("input = 'bar.vtk'\npull = [{ patch = 'top', by = [0, 1] }]", "by must be 3 numbers"),
    ("input = 'bar.vtk'\npull = [{ patch = 'top', by = [0, 0, 1], times = [0, 1] }]", "times with shares"),
    (
        "input = 'bar.vtk'\npress = [{ patch = 'top', pressure = 1, times = [0, 1], shares = [1] }]",
        "one number for each",
    ),
    ("input = 'nothing.vtk'", "nothing.vtk: no such file"),
]


@pytest.mark.parametrize(("text", "said"), BAD_RUNS, ids=[said for _, said in BAD_RUNS])
def test_bad_run_files_are_one_line(bar, folder, text, said, capsys):
    (folder / "run.toml").write_text(text)
    assert_refused(folder, capsys, said, "run.toml", "-o", "a.usd")


def test_a_pull_moves_the_bodies_that_have_the_patch(folder, capsys):
    ball = trimesh.creation.icosphere(2, 0.05)
    scene = trimesh.Scene()
    for name, place in (("left", 0.0), ("right", 0.2)):
        scene.add_geometry(ball, geom_name=name, transform=trimesh.transformations.translation_matrix([place, 0, 0]))
    scene.export(folder / "pair.glb")
    args = ["--tets", 500, "--pull", "x > 0.22", 0, 0, "1cm", "--probe", "0.23 0 0", "--csv", "a.csv", *SHORT]
    assert simulate("pair.glb", "-o", "a.usd", *args) == 0
    assert capsys.readouterr().out.count("--pull") == 1
    name, column = list(table("a.csv").items())[3]
    assert name.endswith(": 0.23 0 0 uz [m]")
    assert column[-1] == pytest.approx(0.01, rel=0.2)
    assert_refused(folder, capsys, "there are no nodes in it", "pair.glb", "-o", "b.usd", "--pull", "x > 1", 0, 0, 1)
