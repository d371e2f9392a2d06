"""The command line: what it says, writes and refuses, and that it simulates what the library does."""

import os
import re
import signal
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from pxr import Usd, UsdGeom

import warp_corot as wc
from warp_corot.cli import main
from warp_corot.cli.say import interrupt_status
from warp_corot.cli.signals import signals_waiting, terminable
from warp_corot.elasticity import MODELS

OPTIONS = ["young", "poisson", "density", "model", "rotation-level", "fix", "scale", "gravity", "duration", "fps", "dt"]
OPTIONS += ["damping", "device", "preview", "unit", "tets", "cell-size", "max-level", "surface-error", "labels"]
OPTIONS += ["smoothing", "draw-tets", "draw-labels"]
SHORT = ["--duration", "0.05", "--fps", "40", "--device", "cpu"]


@pytest.fixture(autouse=True)
def nothing_said_of_compiling(monkeypatch):
    """Whether kernels are compiled depends on what ran before, and no test here is about that."""
    monkeypatch.setattr("warp_corot.cli.simulate.compiling_said", lambda device: nullcontext())


@pytest.fixture(autouse=True)
def warp_settings_kept():
    before = wp.config.log_level
    yield
    wp.config.log_level = before


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def simulate(*args: object) -> int:
    return main(["simulate", *map(str, args)])


def opened(path: Path) -> tuple[Usd.Stage, UsdGeom.TetMesh]:
    stage = Usd.Stage.Open(str(path))
    return stage, UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra")


def frames(path: Path) -> list[np.ndarray]:
    stage, tets = opened(path)
    codes = range(int(stage.GetStartTimeCode()), int(stage.GetEndTimeCode()) + 1)
    return [np.array(tets.GetPointsAttr().Get(code)) for code in codes]


def write_vtk(path: Path, points, tets) -> Path:
    import meshio

    meshio.write(path, meshio.Mesh(np.asarray(points, float), [("tetra", np.asarray(tets))]))
    return path


CUBE = wc.TetForest.box((1, 1, 1), 0.1, 3)


# --- what it simulates -----------------------------------------------------------------------------------------------


def test_box_is_what_the_library_simulates(folder, device, capsys):
    assert simulate("box", "-o", "box.usd", "--duration", 0.1, "--fps", 20, "--dt", 3e-4, "--device", device) == 0
    said = capsys.readouterr().out
    for words in ("325 nodes, 1152 tetrahedra", "steps/s", "times real time", "largest", device, "box.usd, 3 frames"):
        assert words in said

    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=6)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.49, 10.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    steps = 167  # 0.05 s in steps of at most 0.3 ms
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=0.05 / steps, damping=15.0), gravity=(0.0, -9.8, 0.0))
    stage, tets = opened(folder / "box.usd")
    assert stage.GetTimeCodesPerSecond() == 20
    recorded = frames(folder / "box.usd")
    assert len(recorded) == 3
    np.testing.assert_array_equal(recorded[0], mesh.points.astype(np.float32))
    for k in (1, 2):
        sim.advance_steps(steps)
        # On a GPU sums come in another order each time.
        np.testing.assert_allclose(recorded[k], body.positions.numpy(), rtol=0, atol=0 if device == "cpu" else 1e-6)
    fixed = np.array(UsdGeom.PrimvarsAPI(tets).GetPrimvar("fixed").Get())
    np.testing.assert_array_equal(fixed == 1, mesh.points[:, 2] < 1e-9)


def test_options_reach_the_simulation(folder, capsys):
    args = ["--young", 700, "--poisson", 0.3, "--density", 20, "--scale", 2, "--fix", "z > zmax - 0.01"]
    assert simulate("box", "-o", "a.usda", *args, "--gravity", 0, 0, "-1e1", "--damping", 1, "--dt", 5e-4, *SHORT) == 0
    stage, tets = opened(folder / "a.usda")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    primvars = UsdGeom.PrimvarsAPI(tets)
    assert [primvars.GetPrimvar(n).Get() for n in ("young", "poisson", "density")] == pytest.approx([700, 0.3, 20])
    first, *_, last = frames(folder / "a.usda")
    assert np.ptp(first, axis=0) == pytest.approx([0.128, 0.128, 0.384])
    fixed = np.array(primvars.GetPrimvar("fixed").Get()) == 1
    np.testing.assert_array_equal(fixed, first[:, 2] > 0.384 - 0.01)
    np.testing.assert_array_equal(last[fixed], first[fixed])
    # Free fall of the far end, before the pull of the held one arrives there; in whole steps it is 1 % more.
    t, c = 0.05, 1.0
    fall = (10.0 / c) * (t - (1.0 - np.exp(-c * t)) / c)
    assert (first - last)[first[:, 2] == 0, 2] == pytest.approx(fall, rel=0.02)
    assert "0 0 -10 m/s^2, damping 1 /s" in capsys.readouterr().out


@pytest.mark.parametrize("model", MODELS)
def test_every_model(folder, model, capsys):
    assert simulate("box", "-o", "a.usd", "--model", model, *SHORT) == 0
    assert re.search(rf"model +{model}\n", capsys.readouterr().out)


def test_rotation_level(folder, capsys):
    assert simulate("box", "-o", "a.usd", "--rotation-level", 2, *SHORT) == 0
    assert "corotated, rotations of level 2" in capsys.readouterr().out


def test_bear(folder, capsys):
    assert simulate("warp:bear", "-o", "bear.usd", *SHORT) == 0
    out, err = capsys.readouterr()
    assert "1986 nodes, 5354 tetrahedra" in out
    assert "note" not in err  # it comes with all it needs
    stage, _ = opened(folder / "bear.usd")
    first, *_, last = frames(folder / "bear.usd")
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert np.ptp(first[:, 1]) == pytest.approx(0.5542, abs=1e-4)
    assert (last - first)[:, 1].mean() < -1e-3
    feet = first[:, 1] < 0.01
    np.testing.assert_array_equal(last[feet], first[feet])


@pytest.mark.parametrize(
    "options",
    [
        # Near critical damping: where it ends, soon.
        ["--damping", 20, "--duration", 1],
        pytest.param([], marks=pytest.mark.slow),
    ],
    ids=["damped", "as it comes"],
)
def test_bear_sags_by_a_tenth_and_comes_to_rest(folder, options):
    assert simulate("warp:bear", "-o", "bear.usd", "--device", "cpu", *options) == 0
    first, *_, last = frames(folder / "bear.usd")
    height = np.ptp(first[:, 1])
    back = first[:, 1] > first[:, 1].max() - 1e-6
    assert 0.05 < (first - last)[back, 1].mean() / height < 0.15
    assert 0.05 < np.linalg.norm(last - first, axis=1).max() / height < 0.15
    stage, tets = opened(folder / "bear.usd")
    speeds = [np.linalg.norm(tets.GetVelocitiesAttr().Get(k), axis=1).max() for k in (6, stage.GetEndTimeCode())]
    assert speeds[1] < 0.02 * speeds[0]


def test_any_mesh_needs_no_options(folder, capsys):
    """A mesh in millimetres, wound wrongly here and there, with a stray node: said, and simulated all the same."""
    tets = CUBE.tets.copy()
    points = np.concatenate([CUBE.points, [[9.0, 9.0, -9.0]]])
    write_vtk(folder / "cube.vtk", 1e3 * points, tets)
    assert simulate("cube.vtk", "-o", "a.usd", *SHORT) == 0
    out, err = capsys.readouterr()
    assert "--scale 0.001" in err
    assert simulate("cube.vtk", "-o", "a.usd", "--scale", 0.001, *SHORT) == 0
    out, err = capsys.readouterr()
    repaired = int((np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0).sum())
    assert repaired > 0
    assert f"{repaired} wound wrongly and repaired, 1 nodes in no tetrahedron" in out
    assert "the lowest 2 % of the height is held" in err
    assert "Young's modulus is" in err
    assert "--scale" not in err
    first, *_, last = frames(folder / "a.usd")
    bottom = np.append(CUBE.points[:, 2] == 0, False)  # meshio's formats name no up axis: Z
    np.testing.assert_array_equal(last[bottom], first[bottom])
    assert (last - first)[:-1][~bottom[:-1], 2].max() < 0
    np.testing.assert_array_equal(last[-1], first[-1])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 50.0])
def test_default_stiffness_suits_every_size(folder, scale, capsys):
    """Bodies of one shape sag by the same share of their height whatever their size."""
    write_vtk(folder / "cube.vtk", CUBE.points, CUBE.tets)
    duration = 0.6 * scale**0.5  # time goes with the root of the size
    args = ["--duration", duration, "--fps", 1 / duration, "--damping", 30 / scale**0.5]
    assert simulate("cube.vtk", "-o", "a.usd", "--scale", scale, "--device", "cpu", *args) == 0
    first, *_, last = frames(folder / "a.usd")
    share = (first - last)[:, 2].max() / np.ptp(first[:, 2])
    # 0.5 rho g H^2 / E is 1/40 of the height for a column free at its sides.
    assert 0.012 < share < 0.035


def test_own_output_is_an_input(folder):
    assert simulate("box", "-o", "a.usd", *SHORT) == 0
    assert simulate("a.usd", "-o", "b.usd", "--young", 500, "--density", 10, "--fix", "z < 0.001", *SHORT) == 0
    rest = frames(folder / "a.usd")[0]
    np.testing.assert_allclose(frames(folder / "b.usd")[0], rest, atol=1e-8)


def test_preview(folder):
    pytest.importorskip("matplotlib")
    assert simulate("box", "-o", "a.usd", "--preview", "a.png", *SHORT) == 0
    assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")


# --- what it refuses -------------------------------------------------------------------------------------------------


def refused_meshes(folder: Path) -> None:
    (folder / "text.usd").write_text("not a stage")
    (folder / "empty.vtk").write_bytes(b"")
    (folder / "words.docx").write_text("words")
    tet = [[0, 1, 2, 3]]
    corner = np.eye(4, 3, k=-1) * 0.1
    write_vtk(folder / "good.vtk", corner, tet)
    write_vtk(folder / "nan.vtk", np.where(np.arange(4)[:, None] == 2, np.nan, corner), tet)
    write_vtk(folder / "inf.vtk", np.where(np.arange(4)[:, None] == 3, np.inf, corner), tet)
    write_vtk(folder / "flat.vtk", corner * [1, 1, 0], tet)
    stage = Usd.Stage.CreateNew(str(folder / "surface.usda"))
    UsdGeom.Cube.Define(stage, "/Cube")
    stage.Save()


REFUSED = [
    (["none.usd"], "none.usd: no such file"),
    (["text.usd"], "text.usd: is not a USD file"),
    (["empty.vtk"], "empty.vtk: is empty"),
    (["words.docx"], "words.docx: unknown format .docx"),
    (["."], "is a folder"),
    (["surface.usda"], "surface.usda: has no tetrahedra"),
    (["nan.vtk"], "nan.vtk: point 2 has coordinates"),
    (["inf.vtk"], "inf.vtk: point 3 has coordinates"),
    (["flat.vtk"], "flat.vtk: tetrahedron 0 with the nodes [0, 1, 2, 3] is degenerate"),
    (["warp:dragon"], "warp:dragon: no such asset"),
    (["box", "--young", "0"], "young is 0 Pa"),
    (["box", "--young", "-3"], "young is -3 Pa"),
    (["box", "--young", "nan"], "young is nan"),
    (["box", "--young", "soft"], "--young"),
    (["box", "--poisson", "0.5"], "poisson is 0.5"),
    (["box", "--poisson", "-1"], "poisson is -1"),
    (["box", "--density", "0"], "density is 0"),
    (["good.vtk", "--density", "-1"], "density is -1"),
    (["box", "--density", "-1e3"], "density is -1000"),
    (["box", "--fix", "z > -1"], "expression 'z > -1': holds all 325 nodes"),
    (["box", "--fix", "all"], "all 325 nodes"),
    (["box", "--fix", "z = 0"], "'z = 0'"),
    (["box", "--fix", ""], "it is empty"),
    (["box", "--fix", "__import__('os').remove('out.usd')"], "not understood"),
    (["box", "--fix", "z / 0 < 1"], "division by zero"),
    (["box", "--device", "cuda:99"], "there is no device 'cuda:99'"),
    (["box", "--device", "toaster"], "there is no device 'toaster'"),
    (["box", "--model", "rigid"], "invalid choice: 'rigid'"),
    (["box", "--model", "linear", "--rotation-level", "2"], "--rotation-level is 2"),
    (["box", "--rotation-level", "-1"], "rotation_level is -1"),
    (["good.vtk", "--rotation-level", "1"], "needs a forest"),
    (["box", "--scale", "0"], "scale is 0"),
    (["good.vtk", "--scale", "nan"], "scale is nan"),
    (["box", "--gravity", "0", "nan", "0"], "gravity is"),
    (["box", "--gravity", "0", "1"], "--gravity: expected 3 arguments"),
    (["box", "--duration", "0"], "duration is 0 s"),
    (["box", "--duration", "0.001"], "at least one frame"),
    (["box", "--duration", "inf"], "duration is inf"),
    (["box", "--fps", "0"], "fps is 0"),
    (["box", "--dt", "0"], "dt is 0"),
    (["box", "--dt", "-1e-3"], "dt is -0.001"),
    (["box", "--dt", "1e-320"], "dt is 1e-320"),
    (["box", "--dt", "1e-16"], "a frame of 0.0417 s would take 4.17e+14 steps"),
    (["box", "--young", "1e30"], "a frame of 0.0417 s would take"),
    (["box", "--young", "1e39"], "the stiffness 2 mu + |lambda| is 1.71e+40 Pa; float32"),
    (["box", "--young", "1e-40"], "the stiffness 2 mu + |lambda| is 1.71e-39 Pa; float32"),
    (["box", "--density", "1e300"], "the mass of a node is"),
    (["box", "--scale", "1e-20"], "the volume of an element is 6.83e-67 m^3; float32"),
    (["box", "-o", "out\udcff.usd"], "its name is not UTF-8"),
    (["box", "--damping", "-1"], "damping is -1"),
    (["box", "--preview", "a.jpg"], "a.jpg: extension .jpg"),
    (["box", "--preview", "nowhere/a.png"], "nowhere/a.png: output folder nowhere is not there"),
    (["box", "--colour"], "unrecognized arguments: --colour"),
    ([], "required: INPUT"),
    (["box", "-o", "nowhere/out.usd"], "output folder nowhere is not there"),
    (["none.usd", "-o", "nowhere/out.usd"], "output folder nowhere is not there"),  # before the mesh is read
    (["box", "-o", "out.txt"], "extension .txt"),
    (["box", "-o", "."], "extension"),
    (["out.usd"], "is the input"),
]


@pytest.mark.parametrize(("args", "said"), REFUSED, ids=[" ".join(args)[:40] for args, _ in REFUSED])
def test_bad_input_is_one_line_and_touches_nothing(folder, args, said, capsys):
    refused_meshes(folder)
    stage = Usd.Stage.CreateNew("out.usd")
    tets = UsdGeom.TetMesh.Define(stage, "/Tets")
    tets.CreatePointsAttr([tuple(p) for p in (np.eye(4, 3, k=-1) * 0.1).tolist()])
    tets.CreateTetVertexIndicesAttr([(0, 1, 2, 3)])
    stage.Save()
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    given = args if "-o" in args else [*args, "-o", "out.usd"]
    try:
        status = simulate(*given)
    except SystemExit as left:  # argparse's way
        status = left.code
    out, err = capsys.readouterr()
    assert status == 2
    assert out == ""
    assert err.startswith("warp-corot: error: ")
    assert err.count("\n") == 1
    assert said in err
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_output_is_required(folder, capsys):
    with pytest.raises(SystemExit) as left:
        simulate("box")
    assert left.value.code == 2
    assert "-o" in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(folder, capsys):
    (folder / "locked").mkdir(mode=0o500)
    assert simulate("box", "-o", "locked/a.usd") == 2
    assert "cannot be written to" in capsys.readouterr().err


def test_preview_without_matplotlib(folder, capsys, monkeypatch):
    monkeypatch.setattr("warp_corot.cli.simulate.find_spec", lambda name: None)
    assert simulate("box", "-o", "a.usd", "--preview", "a.png", *SHORT) == 2
    assert "warp-corot[plot]" in capsys.readouterr().err
    assert list(folder.iterdir()) == []


# --- how it ends -----------------------------------------------------------------------------------------------------


def test_nothing_fixed_falls_freely_with_a_word(folder, capsys):
    assert simulate("box", "-o", "a.usd", "--fix", "none", "--damping", 0, *SHORT) == 0
    assert "note: no node is held ('none'): the body falls freely" in capsys.readouterr().err
    first, *_, last = frames(folder / "a.usd")
    # Symplectic Euler falls by half a step more than t^2/2, here 0.6 %.
    np.testing.assert_allclose(last - first, np.tile([0.0, -0.5 * 9.8 * 0.05**2, 0.0], (325, 1)), rtol=0.01, atol=1e-6)


def test_very_many_steps_are_said_beforehand(folder, capsys, monkeypatch):
    def end(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("warp_corot.io.animate.record", end)
    assert simulate("box", "-o", "a.usd", *SHORT, "--dt", "1e-9") == 130
    assert "warp-corot: note: 2.5e+07 steps of 1e-09 s make a frame" in capsys.readouterr().err


def test_unstable_step_warns_and_keeps_frames(folder, capsys):
    assert simulate("box", "-o", "a.usd", "--dt", 2e-3, "--duration", 2, "--fps", 100, "--device", "cpu") == 3
    out, err = capsys.readouterr()
    assert out == ""
    warning, error = err.splitlines()
    assert re.match(r"warp-corot: warning: the time step 0\.002 s is beyond the largest stable one", warning)
    match = re.match(r"warp-corot: error: the state is not finite since step (\d+) .*; (\d+) frames, .* a\.usd", error)
    assert match
    recorded = frames(folder / "a.usd")
    assert len(recorded) == int(match[2])
    assert len(recorded) == (int(match[1]) - 1) // 5 + 1  # frames of five steps, and the first
    assert all(np.isfinite(x).all() for x in recorded)


def test_failed_write_is_one_line(folder, capsys, monkeypatch):
    def fail(*_, **__):
        raise OSError("a.usd: cannot be written: No space left on device")

    monkeypatch.setattr("warp_corot.io.usd_writer.UsdWriter.write", fail)
    assert simulate("box", "-o", "a.usd", *SHORT) == 1
    assert capsys.readouterr().err == "warp-corot: error: a.usd: cannot be written: No space left on device\n"


@pytest.mark.parametrize("args", [["--help"], ["simulate", "--help"], ["paper", "--help"]])
def test_help(args, capsys):
    with pytest.raises(SystemExit) as left:
        main(args)
    assert left.value.code == 0
    said = capsys.readouterr().out
    assert "usage: warp-corot" in said
    if args[0] == "simulate":
        for name in OPTIONS:
            assert f"--{name} " in said


@pytest.mark.parametrize("stage", ["commands", "_start_warp"])
def test_interrupted_before_anything_runs(stage, capsys, monkeypatch):
    def interrupt():
        raise KeyboardInterrupt

    monkeypatch.setattr(f"warp_corot.cli.{stage}", interrupt)
    assert simulate("box", "-o", "a.usd") == 130
    assert capsys.readouterr() == ("", "warp-corot: interrupted\n")


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_signals_wait_while_modules_are_imported(number, status):
    """An exception in the middle is swallowed by some modules; after them it is not."""
    came_to = []

    def imports():
        with signals_waiting():
            came_to.append("the signal")
            signal.raise_signal(number)
            came_to.append("the end")

    with terminable(), pytest.raises(KeyboardInterrupt) as raised:
        imports()
    assert came_to == ["the signal", "the end"]
    assert interrupt_status(raised.value) == status


def test_no_command_is_an_error(capsys):
    with pytest.raises(SystemExit) as left:
        main([])
    assert left.value.code == 2
    assert capsys.readouterr().err.startswith("warp-corot: error: ")
