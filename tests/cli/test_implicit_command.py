"""``warp-corot simulate`` with ``--static`` and implicit integrators."""

import re
from dataclasses import dataclass

import numpy as np
import pytest
from command_line import assert_refused, simulate
from pxr import Usd, UsdGeom

import warp_corot as wc
from warp_corot.io.write.animate import shortening, steps_per_frame
from warp_corot.solvers import INTEGRATORS

BOX = ["box", "--device", "cpu"]


def frames_of(path):
    """The points of the tetrahedra in each frame."""
    stage = Usd.Stage.Open(str(path))
    (mesh,) = [UsdGeom.TetMesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.TetMesh)]
    times = mesh.GetPointsAttr().GetTimeSamples()
    return [np.array(mesh.GetPointsAttr().Get(time)) for time in times]


def test_static_writes_the_state_at_rest(tmp_path, capsys):
    """The only frame shows what ``solve_static`` finds; the summary says what it took, and nothing of steps."""
    path = tmp_path / "sag.usd"
    assert simulate(*BOX, "--static", "--density", "5", "--duration", "2", "-o", path) == 0
    out, err = capsys.readouterr()
    assert "  static        at rest after" in out
    assert not re.search(r"step|real time|solves| ms\b", out), out
    assert "one frame shows it, whatever --duration is" in err
    mesh = wc.TetForest.box((1, 1, 3), 0.064, 6)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.49, 5.0), device="cpu")
    body.fix(mesh.points[:, 2] == 0.0)
    assert wc.solve_static(body, gravity=(0, -9.8, 0)).converged
    (frame,) = frames_of(path)
    assert np.abs(frame - body.positions.numpy()).max() < 1e-6


def test_static_follows_a_pull(tmp_path, capsys):
    """Each frame has a state of rest, with the patch where the pull has brought it by then."""
    path, table = tmp_path / "pulled.usd", tmp_path / "pulled.csv"
    pull = ["--pull", "z == zmax", "0", "0", "0.02", "--probe", "z == zmax", "--csv", table]
    assert simulate(*BOX, "--static", *pull, "--duration", "0.2", "--fps", "20", "-o", path) == 0
    out = capsys.readouterr().out
    assert "the first frame is at rest after" in out
    assert "linear ones a frame\n" in out
    frames = frames_of(path)
    assert len(frames) == 5
    ends = [points[:, 2].max() - 0.192 for points in frames]
    assert ends[-1] == pytest.approx(0.02, abs=1e-4)
    assert ends[1] == pytest.approx(0.01, abs=1e-3)


def test_static_stands_on_the_ground(tmp_path, capsys):
    """The ground carries the weight in the table, and so do the nodes in the stage."""
    path, table = tmp_path / "stands.usd", tmp_path / "stands.csv"
    options = ["--young", "5kPa", "--poisson", "0.4", "--self-contact"]
    assert simulate(*BOX, "--static", "--ground", *options, "--csv", table, "-o", path) == 0
    assert "at rest in contact after" in capsys.readouterr().out
    row = np.genfromtxt(table, delimiter=",", skip_header=1)
    weight = 9.8 * 10.0 * 0.064 * 0.064 * 0.192
    np.testing.assert_allclose(row[2], -weight, rtol=1e-4)
    assert len(frames_of(path)) == 1
    stage = Usd.Stage.Open(str(path))
    drawn = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath("/SoftBody/tetrahedra"))
    felt = np.array(drawn.GetPrimvar("contactForce").Get(0), float).sum(axis=0)
    assert felt[1] == pytest.approx(weight, rel=1e-4)


def test_static_follows_a_tool(tmp_path, capsys):
    """A ball sinks 3 mm into the side of a beam; without motion left, forces stay."""
    path, table = tmp_path / "pressed.usd", tmp_path / "pressed.csv"
    (tmp_path / "way.csv").write_text("0,0.032,0.0745,0.096\n0.1,0.032,0.0712,0.096\n")
    tool = ["--tool", "sphere:r=1cm", "--tool-path", tmp_path / "way.csv", "--fix", "bottom", "--poisson", "0.4"]
    options = [*tool, "--young", "5kPa", "--duration", "0.2", "--fps", "20", "--csv", table, "-o", path]
    assert simulate(*BOX, "--static", *options) == 0
    rows = np.genfromtxt(table, delimiter=",", names=True)
    force = rows["tool_1_force_y_N"]
    assert force[0] == 0.0
    assert 0.0 < force[1] < force[2]
    assert force[4] == pytest.approx(force[2], rel=1e-3)
    capsys.readouterr()
    free = [*tool[:4], "--fix", "none", "-o", tmp_path / "free.usd"]
    assert_refused(tmp_path, capsys, "can only follow bodies that are held", *BOX, "--static", "--ground", *free)


def test_an_implicit_run(tmp_path, capsys):
    """Steps of 16 ms are shortened until a whole number of them makes a frame, and a note says so; the run file repeats
    the run."""
    path, run = tmp_path / "swings.usd", tmp_path / "run.toml"
    options = ["--integrator", "backward-euler", "--dt", "16ms", "--duration", "0.1", "--fps", "30"]
    assert simulate(*BOX, *options, "--write-run", run, "-o", path) == 0
    out, err = capsys.readouterr()
    assert "11.11 ms, backward-euler" in out
    assert "note: steps take 11.11 ms, not 16 ms, since a whole number of them makes a frame of 33.33 ms" in err
    assert "linear ones a step" in out
    assert 'integrator = "backward-euler"' in run.read_text()
    first = frames_of(path)
    assert simulate(run, "-o", tmp_path / "again.usd") == 0
    assert np.array_equal(first[-1], frames_of(tmp_path / "again.usd")[-1])


@pytest.mark.parametrize(
    ("dt", "rate"), [(16e-3, "31.25"), (2e-3, "25"), (0.1, "10"), (1 / 70, "35"), (7e-4, None), (0.0123456789, None)]
)
def test_the_frame_rate_in_a_note_keeps_the_step(dt, rate):
    (found,) = re.findall(r"with --fps ([\d.]+) they take that", shortening(dt, 24.0))
    steps = steps_per_frame(float(found), dt)
    assert found == (rate or found)
    assert 1.0 / (float(found) * steps) == pytest.approx(dt, rel=1e-9 if rate else 1e-5)
    assert shortening(dt, float(found)) is None


@pytest.mark.parametrize(("fps", "taken"), [(24.0, "41.67 ms, not 16 s"), (1 / 16, "16 s")])
def test_steps_longer_than_a_second_are_questioned(fps, taken):
    said = shortening(16.0, fps)
    assert said.startswith(f"steps take {taken}")
    assert said.endswith("; did you mean --dt 16ms?")


def test_unfinished_solves_are_named_with_their_cure(tmp_path, capsys, monkeypatch):
    """A linear solve of one iteration does not reach its tolerance."""

    @dataclass(frozen=True)
    class Hasty(wc.BackwardEuler):
        linear_iterations: int = 1

    monkeypatch.setitem(INTEGRATORS, "backward-euler", Hasty)
    options = ["--integrator", "backward-euler", "--dt", "10ms", "--duration", "0.1", "--fps", "20"]
    assert simulate(*BOX, *options, "-o", tmp_path / "swings.usd") == 0
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  solves")]
    assert "; 10 of 10 steps ended before their linear solve converged; shorten the steps (--dt)" in line


def test_a_body_falls_in_implicit_steps(tmp_path, capsys):
    path = tmp_path / "falls.usd"
    options = ["--integrator", "backward-euler", "--fix", "none", "--drop", "1cm", "--duration", "0.1", "--dt", "16ms"]
    assert simulate(*BOX, *options, "-o", path) == 0
    assert "linear ones a step" in capsys.readouterr().out
    lowest = frames_of(path)[-1][:, 1].min()
    assert -0.01 - 1e-5 < lowest < -0.009


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--static", "--dt", "1ms"], "--static has no steps in time; leave out --dt"),
        (["--static", "--integrator", "newmark"], "leave out --integrator"),
        (["--static", "--drop", "1cm"], "--static has no fall; leave out --drop"),
        (["--integrator", "generalized-alpha", "--dt", "-1ms"], "--dt is -0.001"),
        (["--integrator", "euler"], "argument --integrator: invalid choice: 'euler'"),
    ],
)
def test_options_that_exclude_each_other_are_refused(options, said, tmp_path, capsys):
    assert_refused(tmp_path, capsys, said, *BOX, *options, "-o", tmp_path / "out.usd")


def test_a_body_that_nothing_holds_has_no_static_answer(tmp_path, capsys):
    assert simulate(*BOX, "--static", "--fix", "none", "-o", tmp_path / "falls.usd") in (2, 3)
    assert "no node" in capsys.readouterr().err
