"""Ground, drops and tools of the command line: forces in the table, prims in the stage, pictures, run files."""

import tomllib
from pathlib import Path

import numpy as np
import pytest
import trimesh
from command_line import SHORT, assert_refused, simulate, table
from input_files import write_vtk
from PIL import Image
from pxr import Usd, UsdGeom, UsdValidation
from stages import drawn

import warp_corot as wc
from warp_corot.cli.contact import read_tool_path
from warp_corot.errors import InputError

BLOCK = wc.TetForest.box((2, 2, 1), 0.02, 3)
SOFT = ["--young", "20kPa", "--poisson", 0.4, "--density", 1000, "--viscosity", "2ms", "--device", "cpu"]
WEIGHT = 9.81 * 1000 * 0.04 * 0.04 * 0.02


@pytest.fixture
def block(folder) -> Path:
    write_vtk(folder / "block.vtk", BLOCK.points, BLOCK.tets)
    return folder / "block.vtk"


def write_path(folder: Path, text: str) -> Path:
    (folder / "path.csv").write_text(text)
    return folder / "path.csv"


def test_the_ground_carries_what_stands_on_it(block, folder):
    """Without --fix nothing is fixed, and the force in the table is the weight."""
    assert simulate("block.vtk", "--ground", "-o", "a.usd", "--csv", "a.csv", "--duration", 0.5, *SOFT) == 0
    of = table("a.csv")
    assert of["ground force z [N]"][-1] == pytest.approx(-WEIGHT, rel=0.01)
    assert abs(of["ground force x [N]"][-1]) < 0.01 * WEIGHT
    stage = Usd.Stage.Open("a.usd")
    tets = UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra")
    assert not np.any(UsdGeom.PrimvarsAPI(tets).GetPrimvar("fixed").Get())


def test_a_dropped_body_falls_by_the_given_height(block, folder):
    args = ["--drop", "2cm", "-o", "a.usd", "--csv", "a.csv", "--probe", "all", "--fps", 100, "--duration", 0.1]
    assert simulate("block.vtk", *args, *SOFT, "--damping", 0) == 0
    of = table("a.csv")
    time, force = of["time [s]"], of["ground force z [N]"]
    landing = np.sqrt(2 * 0.02 / 9.81)
    assert (force[time < landing - 0.005] == 0.0).all()
    assert (force[time > landing + 0.015] < 0.0).any()
    np.testing.assert_allclose(of["all uz [m]"][time < 0.06], -0.5 * 9.81 * time[time < 0.06] ** 2, atol=2e-4)
    stage = Usd.Stage.Open("a.usd")
    plane = UsdGeom.Plane.Get(stage, "/SoftBody/obstacles/ground")
    assert UsdGeom.Xformable(plane).GetLocalTransformation().ExtractTranslation()[2] == pytest.approx(-0.02, abs=1e-6)


def press(folder: Path, *more: object) -> int:
    write_path(folder, "time [ms],x [mm],y,z [mm]\n0,20,0.02,30\n100,20,0.02,28\n200,20,0.02,28\n")
    tool = ["--tool", "sphere:r=1cm", "--tool-path", "path.csv", "--fix", "z == zmin", "--gravity", 0, 0, 0]
    return simulate("block.vtk", *tool, "-o", "a.usd", "--duration", 0.2, "--fps", 20, *SOFT, *more)


def test_a_tool_presses_and_its_force_is_in_table_and_stage(block, folder):
    """The table, the stage and the support name the same force; the tool is where its path says."""
    assert press(folder, "--csv", "a.csv", "--probe", "z == zmin") == 0
    of = table("a.csv")
    force = of["tool 1 force z [N]"]
    assert force[0] == 0.0
    assert force[-1] > 0.01
    assert of["z == zmin reaction z [N]"][-1] == pytest.approx(force[-1], rel=0.02)
    np.testing.assert_allclose(of["tool 1 z [m]"], np.interp(of["time [s]"], [0, 0.1], [0.03, 0.028]), atol=1e-6)
    np.testing.assert_allclose(of["tool 1 x [m]"], 0.02, atol=1e-7)
    stage = Usd.Stage.Open("a.usd")
    prim = UsdGeom.Sphere.Get(stage, "/SoftBody/obstacles/tool_1")
    assert prim.GetRadiusAttr().Get() == pytest.approx(0.01)
    for code, z in enumerate(of["tool 1 z [m]"]):
        place = UsdGeom.Xformable(prim).GetLocalTransformation(code).ExtractTranslation()
        np.testing.assert_allclose(place, (0.02, 0.02, z), atol=1e-6)
    felt = prim.GetPrim().GetAttribute("contact:force")
    assert felt.Get(stage.GetEndTimeCode())[2] == pytest.approx(force[-1], rel=1e-5)
    drawn, skin = (UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(f"/SoftBody/{name}")) for name in ("tetrahedra", "surface"))
    on_nodes, pressure = (
        np.array(drawn.GetPrimvar(f"contact{kind}").Get(stage.GetEndTimeCode())) for kind in ("Force", "Pressure")
    )
    assert len(on_nodes) == len(pressure) == len(UsdGeom.PointBased(drawn.GetPrim()).GetPointsAttr().Get(0))
    np.testing.assert_allclose(on_nodes.astype(float).sum(axis=0)[2], -force[-1], rtol=1e-4)
    assert pressure.max() > force[-1] / 0.04**2  # more than all over the upper face
    assert (pressure[np.linalg.norm(on_nodes, axis=1) > 0.0] > 0.0).all()
    assert not np.array(drawn.GetPrimvar("contactForce").Get(0)).any()
    assert max(skin.GetPrimvar("contactPressure").Get(stage.GetEndTimeCode())) == pressure.max()
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []


def test_a_tool_that_turns_has_its_turn_in_the_stage(block, folder):
    write_path(folder, "0,0.02,0.02,0.2,0,0,0,1\n0.05,0.02,0.02,0.2,1,0,0,1\n")
    args = ["--tool", "capsule:r=4mm,l=100mm", "--tool-path", "path.csv", "--fix", "z == zmin", "-o", "a.usd"]
    assert simulate("block.vtk", *args, *SHORT) == 0
    stage = Usd.Stage.Open("a.usd")
    prim = UsdGeom.Xformable.Get(stage, "/SoftBody/obstacles/tool_1")
    axis = prim.GetLocalTransformation(stage.GetEndTimeCode()).TransformDir((0, 0, 1))
    np.testing.assert_allclose(axis, (0, -1, 0), atol=1e-5)


def test_two_tools_have_their_own_places(block, folder):
    write_path(folder, "0,0.02,0.02,0.029\n")
    (folder / "far.csv").write_text("0,0,0,1\n1,0,0,2\n")
    tools = ["--tool", "sphere:r=1cm,friction=0", "--tool", "box:x=1cm,y=1cm,z=1cm"]
    paths = ["--tool-path", "path.csv", "--tool-path", "far.csv"]
    args = ["--fix", "z == zmin", "-o", "a.usd", "--csv", "a.csv", *SHORT]
    assert simulate("block.vtk", *tools, *paths, *args) == 0
    of = table("a.csv")
    assert of["tool 1 force z [N]"][-1] > 0.0
    np.testing.assert_allclose(of["tool 1 z [m]"], 0.029, atol=1e-7)
    np.testing.assert_allclose(of["tool 2 z [m]"], 1.0 + of["time [s]"], atol=1e-5)
    assert (of["tool 2 force z [N]"] == 0.0).all()


@pytest.mark.parametrize("tool", ["sphere:r=1cm", "capsule:r=0.3mm,l=30mm"])
def test_a_start_inside_is_said(block, folder, capsys, tool):
    """This includes a needle with no node inside it."""
    write_path(folder, "0,0.0137,0.0121,0.012\n")
    args = ["--tool", tool, "--tool-path", "path.csv", "--fix", "z == zmin", "-o", "a.usd", *SHORT]
    assert simulate("block.vtk", *args) == 0
    said = [line for line in capsys.readouterr().err.splitlines() if "begins inside a soft body" in line]
    assert len(said) == 1


def test_a_coarse_ball_lands_on_its_surface(block, folder, capsys):
    """In steps of both kinds: no note says that contact acts on its tetrahedra."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    ball.export("ball.stl")
    coarse, implicit = ["ball.stl", "--unit", "m", "--tets", 200], ["--integrator", "backward-euler"]
    for mesh in ([*coarse, *implicit], coarse, ["block.vtk", *implicit]):
        assert simulate(*mesh, "--drop", "1cm", "-o", "a.usd", *SHORT) == 0
        assert "contact acts on the tetrahedra" not in capsys.readouterr().err


def test_tools_are_drawn(block, folder):
    """Their colour, with more blue than red, does not occur on the body."""
    assert press(folder, "--preview", "a.png", "--preview-frames", "0") == 0
    pixels = np.asarray(Image.open("a.png").convert("RGB")).astype(int)
    steel = (pixels[..., 2] > pixels[..., 0] + 15) & (pixels[..., 2] < 240)
    assert steel.mean() > 0.005
    assert press(folder, "--preview", "b.png", "--preview-frames", "0", "--tool", "box:x=3mm,y=3mm,z=3mm") == 2


def test_a_run_file_holds_ground_and_tools(block, folder):
    assert press(folder, "--ground", "--friction", 0.5, "--csv", "a.csv", "--write-run", "sub.toml") == 0
    data = tomllib.loads((folder / "sub.toml").read_text())
    assert data["ground"] == "auto"
    assert data["tool"] == ["sphere:r=1cm"]
    assert data["tool-path"] == ["path.csv"]
    assert data["friction"] == 0.5
    assert simulate("sub.toml", "-o", "b.usd", "--csv", "b.csv") == 0
    assert (folder / "a.csv").read_text() == (folder / "b.csv").read_text()
    text = (folder / "sub.toml").read_text().replace('ground = "auto"', "ground = true")
    (folder / "true.toml").write_text(text)
    assert simulate("true.toml", "-o", "b.usd", "--csv", "c.csv") == 0
    assert (folder / "a.csv").read_text() == (folder / "c.csv").read_text()


def test_bodies_of_a_run_file_share_what_they_touch(block, folder):
    bodies = '[[body]]\ninput = "block.vtk"\n[[body]]\ninput = "block.vtk"\noffset = [0.1, 0, 0]\n'
    (folder / "two.toml").write_text('ground = 0\noutput = "a.usd"\ncsv = "a.csv"\nduration = 0.5\n' + bodies)
    assert simulate("two.toml", *SOFT) == 0
    assert table("a.csv")["ground force z [N]"][-1] == pytest.approx(-2 * WEIGHT, rel=0.01)


def test_bodies_of_a_run_file_touch_if_asked(block, folder):
    """A body falls onto a fixed one 2 mm below it, which carries its weight, or falls through it."""
    upper = '[[body]]\ninput = "block.vtk"\nfix = "none"\noffset = [0, 0, "22mm"]\n'
    (folder / "two.toml").write_text(f'[[body]]\ninput = "block.vtk"\nfix = "z == zmin"\n{upper}')
    args = ["-o", "a.usd", "--csv", "a.csv", "--duration", 0.4, "--fps", 10]
    held = {}
    for name, touch in (("touching", ["--touch"]), ("apart", [])):
        assert simulate("two.toml", *args, "--probe", "z == zmin", *touch, *SOFT) == 0
        of = table("a.csv")
        held[name] = of["body 1: z == zmin reaction z [N]"][-1]
    assert held["touching"] == pytest.approx(2 * WEIGHT, rel=0.05)
    assert held["apart"] == pytest.approx(WEIGHT, rel=0.05)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0,0,0,0\n0.1,0,nan,0\n", "line 2: y is 'nan'"),
        ("0,0,0,0\n0.1,0,0,x\n", "line 2: z is 'x'"),
        ("1,0,0,0\n0.1,0,0,0\n", "increasing numbers"),
        ("0,0,0,0\n0,0,0,1\n", "increasing numbers"),
        ("0,0,0\n1,0,0\n", "no column 'z'"),
        ("time,x,y\n0,0,0\n", "no column 'z'"),
        ("time,x,y,z,qx\n0,0,0,0,0\n", "no column 'qy'"),
        ("time,x,y,z,u\n0,0,0,0,0\n", "column 'u'"),
        ("time,x [s],y,z\n0,0,0,0\n", "'s'"),
        ("time,x,y,z\n", "no rows"),
        ("", "is empty"),
        ("0,0,0,0\n1,0,0\n", "line 2 has 3 values"),
        ("0,0,0,0,0,0,0,0\n1,0,0,0,0,0,0,1\n", "quaternion"),
    ],
)
def test_invalid_paths_are_refused(block, folder, capsys, text, said):
    write_path(folder, text)
    tool = ["--tool", "sphere:r=1cm", "--tool-path", "path.csv"]
    assert_refused(folder, capsys, said, "block.vtk", *tool, "-o", "a.usd", *SHORT)


@pytest.mark.parametrize(
    ("said", "args"),
    [
        ("each tool must have one path", ["--tool", "sphere:r=1cm"]),
        ("no such file", ["--tool", "sphere:r=1cm", "--tool-path", "none.csv"]),
        ("a sphere has r", ["--tool", "sphere:l=1cm", "--tool-path", "none.csv"]),
        ("radius", ["--tool", "sphere:r=-1cm", "--tool-path", "none.csv"]),
        ("not a shape", ["--tool", "cone:r=1cm", "--tool-path", "none.csv"]),
        ("--friction is for", ["--friction", 0.3]),
        ("--friction is -1", ["--ground", "--friction", -1]),
        ("--touch is for several", ["--touch"]),
        ("--drop is -1", ["--drop", "-1m"]),
        ("--ground must be auto", ["--drop", "1m", "--ground", "0"]),
        ("--fix must be none", ["--drop", "1m", "--fix", "z == zmin"]),
        ("must be a height or auto", ["--ground", "low"]),
        ("--ground is nan", ["--ground", "nan"]),
    ],
)
def test_options_that_do_not_fit_are_refused(block, folder, capsys, said, args):
    assert_refused(folder, capsys, said, "block.vtk", *args, "-o", "a.usd", *SHORT)


def test_columns_with_units_and_without_names_are_the_same(folder):
    named = write_path(folder, "t,z [cm],y [mm],x,qw,qx,qy,qz\n0,1,2,3,1,0,0,0\n1,1,2,3,1,0,0,0\n")
    times, positions, turns = read_tool_path(named)
    np.testing.assert_allclose(times, [0, 1])
    np.testing.assert_allclose(positions, [(3, 0.002, 0.01)] * 2)
    np.testing.assert_allclose(turns, [(0, 0, 0, 1)] * 2)
    with pytest.raises(InputError, match="cannot be read"):
        read_tool_path(folder)


def test_obstacles_of_every_form_are_in_a_stage(folder):
    """In a simulation in Python, every shape is in the stage and turns there as it does in the simulation."""
    box = wc.Box((0.02, 0.02, 0.01), position=(1, 0, 0), quaternion=(0, 0, 1, 1))
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float) * 0.01
    faces = [(0, 2, 1), (0, 1, 3), (0, 3, 2), (1, 2, 3)]
    shapes = [wc.Ground(), box, wc.Sphere(0.01, position=(2, 0, 0)), wc.Cylinder(0.01, 0.02, position=(3, 0, 0))]
    tools = [wc.Tool(wc.TriangleMesh(corners, faces, position=(4, 0, 0))), wc.Tool(wc.Capsule(0.01, 0.02))]
    tools[1].move((5, 0, 0))
    body = wc.SoftBody(BLOCK, wc.Isotropic(2e4, 0.4, 1e3), device="cpu")
    sim = wc.Simulation(body, obstacles=[*shapes, *tools])
    wc.record(sim, "a.usd", duration=0.02, fps=100)
    stage = Usd.Stage.Open("a.usd")
    found = {prim.GetName(): prim for prim in stage.GetPrimAtPath("/SoftBody/obstacles").GetChildren()}
    kinds = {name: str(prim.GetTypeName()) for name, prim in found.items()}
    expected = {"ground": "Plane", "box": "Cube", "sphere": "Sphere", "cylinder": "Cylinder"}
    assert kinds == {**expected, "tool_1": "Mesh", "tool_2": "Capsule"}
    for place, name in enumerate(("box", "sphere", "cylinder", "tool_1", "tool_2"), 1):
        matrix = UsdGeom.Xformable(found[name]).GetLocalTransformation(stage.GetEndTimeCode())
        np.testing.assert_allclose(matrix.ExtractTranslation(), (place, 0, 0), atol=1e-6)
    ends = UsdGeom.Xformable(found["box"]).GetLocalTransformation().Transform((1, 0, 1))
    np.testing.assert_allclose(ends, (1, 0.01, 0.005), atol=1e-6)
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    assert UsdValidation.ValidationContext(validators).Validate(stage) == []


@pytest.mark.parametrize("lift", [0.0, 0.06])
def test_two_pieces_lie_on_a_ground_if_both_reach_it(folder, capsys, lift):
    pieces = [trimesh.creation.icosphere(2, 0.03) for _ in range(2)]
    pieces[1].apply_translation((0.1, 0.0, lift))
    trimesh.util.concatenate(pieces).export(folder / "pair.stl")
    asked = ["--unit", "m", "--tets", 800, "--duration", 0.1, "--fps", 10, "--device", "cpu", "-o", "a.usd"]
    assert simulate("pair.stl", *asked) == 0
    assert ("pair, lying on a ground" in capsys.readouterr().out) == (lift == 0.0)


def test_an_organ_without_flat_feet_lies_on_a_ground(folder, capsys):
    trimesh.creation.capsule(0.08, 0.03).export(folder / "organ.stl")
    trimesh.creation.cylinder(0.04, 0.03).export(folder / "drum.stl")
    asked = ["--unit", "m", "--tets", 400, "--duration", 0.3, "--fps", 10, "--device", "cpu", "-o", "a.usd"]
    assert simulate("organ.stl", *asked, "--csv", "a.csv") == 0
    out, err = capsys.readouterr()
    assert "the body lies on a ground, since it has no flat feet, and nothing is fixed (--no-ground or --fix" in err
    assert "organ, lying on a ground" in out
    assert "touches       ground: at -0.0" in out
    assert "friction 0.3" in out
    assert "one another" not in out  # there is only one body
    points = [np.array(drawn(Usd.Stage.Open("a.usd"), "/SoftBody/surface", k).vertices) for k in (0, 3)]
    assert points[1][:, 2].min() > points[0][:, 2].min() - 1e-3
    assert points[1][:, 2].max() < points[0][:, 2].max() - 1e-3
    held = (["--no-ground"], ["--fix", "bottom"], ["--pull", "top", 0, 0, "1mm"], ["--static"], ["--gravity", 0, 0, 0])
    for option in held:
        assert simulate("organ.stl", *asked, "--duration", 0.1, *option) == 0
        assert "ground" not in "".join(capsys.readouterr()).replace("--no-ground", "")
    assert simulate("drum.stl", *asked, "--duration", 0.1) == 0
    assert "the body stands on its lowest 10 %" in capsys.readouterr().err
    assert_refused(folder, capsys, "--no-ground is given with --ground", "drum.stl", "--no-ground", "--ground", *asked)
