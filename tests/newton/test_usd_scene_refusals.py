"""Errors in a stage, an option or an installation are one line, and nothing is written."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, UsdPhysics, Vt
from scene_stages import SIM, StageMaker, crowd, newton, standing

from warp_corot.cli import main


def run(*args) -> int:
    return main(["scene", *map(str, args), "--device", "cpu"])


def spoil(made: StageMaker, how: str) -> None:
    """Introduce an error into a stage of one block."""
    mesh = UsdGeom.TetMesh.Get(made.stage, SIM)
    material = made.stage.GetPrimAtPath("/Materials/Soft")
    if how == "no TetMesh":
        made.stage.RemovePrim("/World/Soft")
    elif how == "no points":
        mesh.GetPointsAttr().Clear()
    elif how == "no tets":
        mesh.GetTetVertexIndicesAttr().Clear()
    elif how == "index":
        tets = np.array(mesh.GetTetVertexIndicesAttr().Get())
        tets[3, 1] = 36
        mesh.GetTetVertexIndicesAttr().Set(Vt.Vec4iArray.FromNumpy(tets))
    elif how == "flat":
        points = np.array(mesh.GetPointsAttr().Get())
        points[:, 2] = 0.0
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points))
    elif how == "nan":
        points = np.array(mesh.GetPointsAttr().Get())
        points[7, 2] = np.nan
        mesh.GetPointsAttr().Set(Vt.Vec3fArray.FromNumpy(points))
    elif how == "no stiffness":
        material.GetAttribute("physics:youngsModulus").Set(0.0)
    elif how == "units":
        UsdGeom.SetStageMetersPerUnit(made.stage, 0.0)
    elif how == "mass units":
        UsdPhysics.SetStageKilogramsPerUnit(made.stage, -1.0)
    elif how == "disabled":
        made.stage.GetPrimAtPath("/World/Soft").CreateAttribute("physics:bodyEnabled", Sdf.ValueTypeNames.Bool).Set(
            False
        )
    elif how == "scale":
        UsdGeom.Xformable(mesh).AddScaleOp().Set(Gf.Vec3f(1.0, 2.0, 0.0))
    elif how == "far":
        UsdGeom.Xformable(mesh).AddTranslateOp(opSuffix="far").Set(Gf.Vec3d(1e8, 0.0, 0.0))
    elif how == "gravity":
        made.stage.GetPrimAtPath("/physicsScene").GetAttribute("physics:gravityMagnitude").Set(np.nan)
    elif how == "direction":
        made.stage.GetPrimAtPath("/physicsScene").GetAttribute("physics:gravityDirection").Set(Gf.Vec3f(0, 0, np.inf))
    elif how == "pattern":
        UsdGeom.PointInstancer.Define(made.stage, "/World")
    elif how == "sublayer":
        made.stage.GetRootLayer().subLayerPaths.append("./nowhere.usda")


@pytest.mark.parametrize(
    ("how", "message"),
    [
        ("no TetMesh", "has no TetMesh prim"),
        ("no points", "/World/Soft/sim: is a TetMesh without points"),
        ("no tets", "/World/Soft/sim: is a TetMesh without tetVertexIndices"),
        ("index", "/World/Soft/sim: names point 36 but has points 0 to 35"),
        ("flat", "/World/Soft/sim: 72 of 72 tetrahedra have no volume, the first is 0"),
        ("nan", "/World/Soft/sim: point 7 is not finite"),
        ("no stiffness", "/World/Soft/sim: its material is not positive definite"),
        ("units", "metersPerUnit is 0.0; it must be a positive number"),
        ("mass units", "kilogramsPerUnit is -1.0; it must be a positive number"),
        ("disabled", "Newton takes none of its TetMesh prims for a soft body"),
        ("scale", "/World/Soft/sim: 72 of 72 tetrahedra have too little volume for float32"),
        ("far", "/World/Soft/sim: 72 of 72 tetrahedra have too little volume for float32"),
        ("gravity", "/physicsScene: gravityMagnitude is nan; it must be finite"),
        ("direction", "/physicsScene: gravityDirection is (0, 0, inf); it must be finite"),
        ("pattern", "its only TetMesh prims are prototypes of a point instancer: /World/Soft/sim"),
        ("sublayer", "does not compose: "),
    ],
)
def test_bad_stages_are_one_line(tmp_path, capsys, how, message):
    standing(tmp_path / "in.usda")
    made = StageMaker.__new__(StageMaker)
    made.stage = Usd.Stage.Open(str(tmp_path / "in.usda"))
    spoil(made, how)
    made.stage.Save()
    assert run(tmp_path / "in.usda", "-o", tmp_path / "out.usda") == 2
    said = capsys.readouterr().err.splitlines()
    assert len([line for line in said if ": error: " in line]) == 1
    assert len(said) == 1 or how == "disabled"
    assert message in said[-1]
    assert not (tmp_path / "out.usda").exists()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--dt", "1"], "dt is 1 s; it must be at most the largest stable step, about"),
        (["--dt", "-1"], "dt is -1 s; it must be a positive number"),
        (["--fps", "0"], "fps is 0; it must be a positive number"),
        (["--duration", "0"], "duration is 0 s; it must be a positive number"),
        (["--young", "0"], "young"),
        (["--poisson", "0.5"], "poisson"),
        (["--density", "0"], "density"),
        (["--gravity", "0", "0", "nan"], "gravity is (0.0, 0.0, nan); it must be three finite numbers"),
        (["--viscosity", "-1"], "viscosity is -1; it must be"),
        (["--damping", "-1"], "damping is -1"),
        (["--ground", "deep"], "--ground 'deep'"),
        (["--ground", "0.1"], "ground is 0.1 m; /World/Soft/sim reaches down to z = 0 m"),
        (["--radius", "-1"], "radius is -1; it must be zero or a positive length"),
        (["--radius", "nan"], "radius is nan"),
        (["--fix", "all"], "all points of soft bodies are held"),
        (["--fix", "w < 0"], "w"),
        (["--device", "abacus"], "abacus"),
    ],
)
def test_bad_options_are_one_line(tmp_path, capsys, options, message):
    source = standing(tmp_path / "in.usda")
    given = options if "--device" in options else [*options, "--device", "cpu"]
    assert main(["scene", str(source), "-o", str(tmp_path / "out.usda"), *given]) == 2
    err = capsys.readouterr().err
    assert len(err.strip().splitlines()) == 1
    assert message in err
    assert not (tmp_path / "out.usda").exists()


def test_files_that_are_no_stages(tmp_path, capsys):
    (tmp_path / "bad.usda").write_text("nonsense")
    for name, message in (
        ("bad.usda", "is not a USD file"),
        ("gone.usda", "no such file"),
        ("a.msh", "extension .msh"),
    ):
        assert run(tmp_path / name, "-o", tmp_path / "out.usda") == 2
        assert message in capsys.readouterr().err
    (tmp_path / "typo.usda").write_text('#usda 1.0\ndef Cube "Box"\n{\n    double size = = 3\n}\n')
    assert run(tmp_path / "typo.usda", "-o", tmp_path / "out.usda") == 2
    err = capsys.readouterr().err
    assert "typo.usda: is not a USD file that OpenUSD can open: line 4: " in err
    assert len(err.splitlines()) == 1
    source = standing(tmp_path / "in.usda")
    assert run(source, "-o", tmp_path / "no" / "out.usda") == 2
    assert "output folder" in capsys.readouterr().err
    assert run(source, "-o", source) == 2
    assert "is the input" in capsys.readouterr().err


def test_joints_that_a_solver_does_not_know(tmp_path, capsys, monkeypatch):
    source = crowd(tmp_path / "in.usda").save()

    def refuses(*_, **__):
        raise ValueError("SolverXPBD does not support JointType.ROD joints.")

    monkeypatch.setattr(newton.solvers, "SolverXPBD", refuses)
    assert run(source, "-o", tmp_path / "out.usda", "--rigid", "xpbd") == 2
    err = capsys.readouterr().err
    assert "does not support JointType.ROD joints; another than xpbd can be chosen (--rigid)" in err


def test_cables_are_refused_with_what_can_be_done(tmp_path, capsys):
    source = Path(newton.__file__).parent / "tests" / "assets" / "deformables_mixed.usda"
    if not source.exists():
        pytest.skip("this Newton comes without its tests' stages")
    assert run(source, "-o", tmp_path / "out.usda") == 2
    err = capsys.readouterr().err
    assert "has cables, for example /World/CableA/sim" in err
    assert "--rigid none leaves cables and rigid bodies in place" in err
    assert run(source, "-o", tmp_path / "out.usda", "--rigid", "none", "--duration", "0.05") == 0
    assert "stay where they are (--rigid none): /World/CableA/sim, /World/CableB/sim" in capsys.readouterr().err


def test_without_newton_one_line_says_what_to_install(tmp_path, monkeypatch, capsys):
    source = standing(tmp_path / "in.usda")
    code = (
        "import sys; sys.modules['newton'] = None\n"
        "from warp_corot.cli import main\n"
        f"sys.exit(main(['scene', {str(source)!r}, '-o', 'out.usda', '--device', 'cpu']))"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path)
    assert ended.returncode == 2
    assert len(ended.stderr.strip().splitlines()) == 1, ended.stderr
    assert 'pip install "warp-corot[newton]"' in ended.stderr

    def unread(*_, **__):
        raise ImportError("Newton USD support requires newton-usd-schemas.")

    monkeypatch.setattr(newton.ModelBuilder, "add_usd", unread)
    assert run(source, "-o", tmp_path / "out.usda") == 2
    assert "pip install newton-usd-schemas" in capsys.readouterr().err
