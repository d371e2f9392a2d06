"""Blades on the command line."""

import pytest
import trimesh
from command_line import assert_refused, simulate
from pxr import Usd, UsdGeom, UsdShade

PATH = """time, x [mm], y [mm], z [mm], qx, qy, qz, qw
0, 32, 80, 101, 0, 1, 0, 1
0.2, 32, -20, 101, 0, 1, 0, 1
"""


def test_a_blade_cuts_what_the_command_makes(folder):
    (folder / "path.csv").write_text(PATH)
    options = ["--level", 5, "--young", "20kPa", "--density", 1000, "--blade", "path.csv", "--toughness", 2]
    assert simulate("box", "-o", "cut.usda", *options, "--duration", 0.25, "--fps", 20, "--device", "cpu") == 0
    stage = Usd.Stage.Open("cut.usda")
    points = UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra").GetPointsAttr()
    first, last = (points.Get(code) for code in (0, stage.GetEndTimeCode()))
    assert len(last) > len(first)


def test_the_surface_of_an_organ_is_cut(folder, capsys):
    """The surface of the mesh is drawn, because that of the file does not come apart."""
    trimesh.creation.icosphere(subdivisions=2, radius=0.04).export("ball.obj")
    (folder / "path.csv").write_text(PATH.replace("32, ", "0, ").replace("101", "0"))
    options = ["--unit", "m", "--tets", 800, "--young", "20kPa", "--density", 1000, "--blade", "path.csv"]
    assert_refused(folder, capsys, "--skin input", "ball.obj", "-o", "cut.usda", *options, "--skin", "input")
    assert simulate("ball.obj", "-o", "cut.usda", *options, "--duration", 0.25, "--fps", 20, "--device", "cpu") == 0
    stage = Usd.Stage.Open("cut.usda")
    (subset,) = UsdShade.MaterialBindingAPI(stage.GetPrimAtPath("/SoftBody/surface")).GetMaterialBindSubsets()
    first, last = (subset.GetIndicesAttr().Get(code) for code in (0, stage.GetEndTimeCode()))
    assert len(first) == 0 < len(last)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--blade-length", "0.1"], "--blade-length is for --blade"),
        (["--blade", "nowhere.csv"], "nowhere.csv"),
        (["--toughness", "-1"], "toughness is -1"),
    ],
)
def test_bad_blades_are_one_line(options, said, folder, capsys):
    assert_refused(folder, capsys, said, "box", "-o", "out.usda", *options)
