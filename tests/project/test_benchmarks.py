"""The benchmarks run, check what they time, and report everything. No test checks speed."""

import argparse
import importlib.util
import json
import math
import runpy
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest
import warp as wp
from mpirun import needs_mpi

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
SUPPORT = Path(__file__).parents[1] / "support"

STAGES = {"rotation", "stiffness product", "scatter", "whole force", "integration", "whole step"}


#: Modules of the benchmarks whose names modules of tests have, too.
TWICE = {path.stem for path in BENCHMARKS.glob("*.py")} & {path.stem for path in SUPPORT.glob("*.py")}


@pytest.fixture
def benchmarks(monkeypatch):
    """The folder of the benchmarks comes first, and none of their modules stays in the place of one of the tests'."""
    of_tests = {name: sys.modules.pop(name) for name in TWICE & sys.modules.keys()}
    monkeypatch.syspath_prepend(BENCHMARKS)
    yield
    for name in TWICE & sys.modules.keys():
        del sys.modules[name]
    sys.modules.update(of_tests)


@pytest.fixture
def run(benchmarks, monkeypatch, capsys):
    """Runs a script, small and fast, in this process, which has started Warp and compiled most kernels already."""

    def run(script, *arguments):
        monkeypatch.setattr(sys, "argv", [script, *map(str, arguments)])
        monkeypatch.setattr(wp.config, "log_level", wp.config.log_level)  # which scripts change
        with pytest.raises(SystemExit) as ended:
            runpy.run_path(str(BENCHMARKS / script), run_name="__main__")
        said = capsys.readouterr()
        return SimpleNamespace(returncode=ended.value.code or 0, stdout=said.out, stderr=said.err)

    return run


def report(done, path):
    """The JSON of a successful run, whose table has a line for every row."""
    assert done.returncode == 0, done.stderr
    found = json.loads(path.read_text(encoding="utf-8"))
    for row in found["rows"]:
        named = [line.startswith(row["stage"]) and row["variant"] in line for line in done.stdout.splitlines()]
        assert any(named), row
        assert math.isfinite(row["ns_per_tet"])
        assert row["ns_per_tet"] > 0
        assert row["gtet_per_s"] == pytest.approx(1 / row["ns_per_tet"])
        assert row["spread"] >= 0
    return found


def test_kernels(run, device, tmp_path):
    path = tmp_path / "kernels.json"
    done = run("kernels.py", "--device", device, "--level", 3, "--rounds", 1, "--json", path)
    found = report(done, path)
    assert found["device"] == device
    assert found["tets"] == 48
    assert found["copy_gb_per_s"] > 0
    rows = found["rows"]
    assert {row["stage"] for row in rows} == STAGES
    for name in ("ns/tet", "spread", "Gtet/s", "B/tet", "flop/tet", "of copy", "error"):
        assert name in done.stdout
    for row in rows:
        assert row["error"] <= (1e-2 if "SVD" in row["variant"] else 1e-4), row
        # A repeat moves its minimum traffic at the bandwidth that follows from it.
        if row["bytes_per_tet"] is not None:
            fraction = row["bytes_per_tet"] / row["ns_per_tet"] / found["copy_gb_per_s"]
            assert row["copy_fraction"] == pytest.approx(fraction)
    bytes_of = {(row["stage"], row["variant"]): row["bytes_per_tet"] for row in rows}
    force = bytes_of["whole force", "corotated, own rotations"]
    assert force < bytes_of["whole force", "corotated, general mesh"]
    assert force < bytes_of["whole step", "corotated, own rotations"]
    flops = {row["variant"]: row["flops_per_tet"] for row in rows if row["stage"] == "stiffness product"}
    assert flops["factored"] < flops["sparse K_T by type"] < flops["dense 12x12"]


def test_the_history_takes_runs_and_its_page_is_up_to_date(run, tmp_path):
    lines = (BENCHMARKS / "history.jsonl").read_text(encoding="utf-8")
    (tmp_path / "history.jsonl").write_text(lines, encoding="utf-8")
    assert run("history.py", "--folder", tmp_path).returncode == 0
    table = (tmp_path / "history.md").read_text(encoding="utf-8")
    assert table == (BENCHMARKS / "history.md").read_text(encoding="utf-8")
    rows = [{"stage": "whole force", "variant": "corotated, own rotations", "gtet_per_s": 12.34}]
    report = {"name": "a card", "warp": "1", "warp_corot": "2", "tets": 3072, "rows": rows}
    (tmp_path / "run.json").write_text(json.dumps(report), encoding="utf-8")
    named = ("--commit", "abc", "--date", "2030-01-02", "--folder", tmp_path)
    assert run("history.py", tmp_path / "run.json", *named).returncode == 0
    newest = (tmp_path / "history.md").read_text(encoding="utf-8").splitlines()[9]
    assert newest.startswith("| 2030-01-02 | `abc` | a card | 3,072 | 12.3 | –")
    kept = (tmp_path / "history.jsonl").read_text(encoding="utf-8")
    assert kept.startswith(lines)
    for bad in ("{}", "not JSON", json.dumps(report | {"rows": []})):
        (tmp_path / "run.json").write_text(bad, encoding="utf-8")
        done = run("history.py", tmp_path / "run.json", *named)
        assert done.returncode == 2
        assert done.stderr.startswith("history.py: error: ")
        assert done.stderr.count("\n") == 1
        assert (tmp_path / "history.jsonl").read_text(encoding="utf-8") == kept


@pytest.mark.slow
@pytest.mark.parametrize(
    ("package", "rows"),
    [
        ("newton", ("eval_tetrahedra", "SemiImplicit", "VBD", "XPBD")),
        ("mujoco", ("flex",)),
    ],
)
def test_peers(run, package, rows, device, tmp_path):
    if importlib.util.find_spec(package) is None:
        pytest.skip(f"{package} is not installed")
    path = tmp_path / "peers.json"
    arguments = ["--device", device, "--level", 3, "--step-level", 3, "--rounds", 1, "--json", path]
    found = report(run("peers.py", *arguments), path)
    for name in rows:
        (row,) = (row for row in found["rows"] if name in row["variant"])
        # The iterations of VBD and XPBD leave some of their residual; everything else is rounding.
        assert row["error"] <= (1.0 if name in ("VBD", "XPBD") else 1e-4)


@pytest.mark.parametrize("script", ["kernels.py", "peers.py", "states.py"])
@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--device", "cuda:99", "cuda:99"),
        ("--level", "2", "--level is 2; it must be from 3 to"),
        ("--level", "many", "many"),
        ("--rounds", "0", "--rounds is 0"),
        ("--json", "nowhere/at/all.json", "nowhere/at"),
    ],
)
def test_bad_options_are_said_in_one_line(run, script, option, value, said):
    ended = run(script, option, value)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f"{script}: error: ")
    assert said in line


# --- the pieces -------------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("benchmarks")
@pytest.mark.parametrize("error", [0.02, math.nan, math.inf])
def test_a_wrong_result_fails_the_run(error, tmp_path, capsys):
    from measure import Case, finish, measure

    a = wp.zeros(4, dtype=wp.float32, device="cpu")
    cases = [
        Case("stage", name, lambda: a.fill_(1.0), lambda found=found: found, tets=4)
        for name, found in (("right", 1e-7), ("off", error))
    ]
    results = measure(cases, wp.get_device("cpu"), rounds=1, tell=lambda _: None)
    options = argparse.Namespace(json=None)
    assert finish(options, {}, results[:1]) == 0
    assert finish(options, {}, results) == 1
    assert "WRONG: stage, off" in capsys.readouterr().err


def test_remesh(run, device, tmp_path):
    path = tmp_path / "remesh.json"
    done = run("remesh.py", "--device", device, "--level", 6, "--rounds", 1, "--json", path)
    rows = report(done, path)["rows"]
    assert {row["stage"] for row in rows} == {
        "a time step",
        "nothing",
        "1 %, in one place",
        "1 %, scattered",
        "doubled",
    }
    for row in rows:
        assert row["error"] <= 1e-9
        assert row["bisected"] >= {"doubled": 384}.get(row["stage"], 0)


@pytest.mark.parametrize("poisson", [0.44, pytest.param(0.49, marks=pytest.mark.slow)])
def test_states(run, device, poisson, tmp_path):
    """Above 0.45 elements share their dilatation."""
    path = tmp_path / "states.json"
    laws = ("corotated", "neo-Hookean")
    done = run("states.py", "--device", device, "--quick", "--poisson", poisson, "--laws", *laws, "--json", path)
    found = report(done, path)
    assert {(row["state"], row["body"]) for row in found["states"]} >= {
        ("at rest", "beam 3"),
        ("under its weight", "beam 3"),
        ("all leaves turned over", "cube 3"),
    }
    for row in found["states"]:
        inverted = {"one leaf turned over": 1 / 48, "all leaves turned over": 1.0}
        if row["state"] in inverted:
            assert row["inverted"] == pytest.approx(inverted[row["state"]])
        assert 1.0 <= row["condition"][0] <= row["condition"][2]
    for row in found["rows"]:
        assert row["error"] <= 1e-3
        assert row["over_rest"] > 0
        assert row["over_general"] > 0
        if row["stage"].endswith("at rest") and row["variant"] == "corotated":
            assert row["flagged"] == 0.0


@pytest.mark.slow
def test_bodies(run, tmp_path):
    """A body that is meshed, one that is refused, and an earlier run for comparison."""
    pytest.importorskip("trimesh")
    table, numbers = tmp_path / "bodies.md", tmp_path / "bodies.json"
    command = ("bodies.py", "cube-askew", "open-bowl", "--tets", 500, "--json", numbers, "-o", table)
    done = run(*command)
    assert done.returncode == 0, done.stderr
    found = json.loads(numbers.read_text(encoding="utf-8"))
    assert found["cube-askew"]["volume"] == pytest.approx(1.0, abs=0.1)
    assert 0 < found["cube-askew"]["elements"] <= 500
    assert "the surface is open" in found["open-bowl"]["refused"]
    lines = table.read_text(encoding="utf-8").splitlines()
    assert any(line.startswith("| cube-askew | ") for line in lines)
    assert lines[0].startswith("2 bodies at 500 elements; 1 meshed")
    listed = run("bodies.py", "--list").stdout.split()
    assert len(listed) >= 44
    assert {"cube", "windpipe", "rough-ball-1-7-million"} <= set(listed)


def test_dragging_changes_patches_and_no_recording(run):
    done = run("dragging.py", "--device", "cpu", "--level", "6")
    assert done.returncode == 0, done.stderr
    assert len(done.stdout.splitlines()) == 2 + 6
    assert "follow keyframes" in done.stdout


def test_the_haptic_loop_is_timed(run, tmp_path):
    done = run("haptics.py", "--device", "cpu", "--level", "3", "--seconds", "1", "--json", tmp_path / "a.json")
    assert done.returncode == 0, done.stderr
    found = json.loads((tmp_path / "a.json").read_text(encoding="utf-8"))
    assert found["readings"] > 10
    assert 0.0 < found["period"] <= found["period_99"] <= found["period_most"]
    assert found["delay"] > 0.0
    assert all(word in done.stdout for word in ("median", "99 %", "longest", "delay"))


@pytest.mark.parametrize("scenes", ["standing,dropped,worlds", "pressed,lifted,refined", "squeezed"])
def test_standing_scenes_run_through(scenes, run, tmp_path):
    """All steps are solved, and positions stay finite."""
    path = tmp_path / "rows.jsonl"
    small = ["--elements", "600", "--young", "5e3", "--poisson", "0.49", "--duration", "0.1", "--device", "cpu"]
    done = run("scenes.py", "--scenes", scenes, *small, "--rows", path)
    assert done.returncode == 0, done.stderr
    rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
    assert [row["scene"] for row in rows] == [name for name in scenes.split(",") for _ in range(2)]
    for row in rows:
        assert row["factor"] > 0.0
        assert "failure" not in row, row
        assert not row.get("unfinished"), row
        assert row["launches"] is None or row["launches"] > 0


def test_beam_of_sofa_bends(run):
    done = run("sofa_beam.py", "--steps", 5)
    assert done.returncode == 0, done.stderr
    assert "18954 tetrahedra" in done.stdout
    assert " 0 unfinished" in done.stdout


@pytest.mark.slow
def test_newtons_examples_are_timed(run):
    pytest.importorskip("newton")
    done = run("newton_examples.py", "--frames", 6, "--scenes", "hanging", "grasp")
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("SolverCorotated") == 4


def test_implicit_steps_are_timed(run, tmp_path):
    path = tmp_path / "steps.json"
    options = ["--levels", 3, "--tolerances", "1e-2", "--repeats", 1, "--json", path]
    done = run("implicit_steps.py", "--device", "cpu", *options)
    assert done.returncode == 0, done.stderr
    (row,) = json.loads(path.read_text(encoding="utf-8"))["rows"]
    assert row["seconds"] > 0.0
    assert row["setups"] < 43
    assert row["error"] < 0.02


def test_preconditioners_are_compared(run, tmp_path):
    path = tmp_path / "solvers.json"
    done = run("solvers.py", "--device", "cpu", "--levels", 5, "--poisson", 0.3, "--json", path)
    assert done.returncode == 0, done.stderr
    found = {(row["body"], row["preconditioner"]): row for row in json.loads(path.read_text(encoding="utf-8"))["rows"]}
    for body in ("beam", "balls"):
        counts = [found[body, name]["iterations"] for name in ("none", "diagonal", "multigrid")]
        assert counts[0] > counts[1] > 2 * counts[2] > 0
        assert all(found[body, name]["error"] < 1e-3 for name in ("none", "diagonal", "multigrid"))


@needs_mpi
@pytest.mark.slow
@pytest.mark.parametrize("strong", ["", "6"])
def test_scaling(strong, run, monkeypatch, tmp_path):
    """Weak scaling and its predictions; strong scaling takes as many processes again."""
    monkeypatch.setenv("OMPI_MCA_mpi_yield_when_idle", "1")  # ranks that wait leave the cores to other tests
    path = tmp_path / "scaling.json"
    done = run("scaling.py", "--ranks", "1,2", "--weak", "6", "--strong", strong, "--json", path)
    assert done.returncode == 0, done.stderr
    found = json.loads(path.read_text(encoding="utf-8"))
    rows = {(row["scaling"], row["ranks"]): row for row in found["rows"]}
    assert rows["weak", 2]["elements"] == 2 * rows["weak", 1]["elements"]
    assert not strong or rows["strong", 1]["elements"] == rows["weak", 2]["elements"]
    for (_, ranks), row in rows.items():
        assert row["step_us"] > 0
        assert (row["sent_bytes"] > 0) == (ranks == 2)
    assert {each["ranks"] for each in found["predictions"]} == {1, 2, 8, 64}
