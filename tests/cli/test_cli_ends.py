"""Ends of commands: their messages and exit statuses."""

import errno
import functools
import importlib
import re
import signal
import sys
import time

import numpy as np
import pytest
from command_line import SHORT, lines_of, run, simulate
from stages import frames

from warp_corot.cli.terminal import interrupt_status, terminable

OPTIONS = ["young", "poisson", "density", "model", "rotation-level", "fix", "scale", "gravity", "duration", "fps", "dt"]
OPTIONS += ["damping", "device", "preview", "unit", "tets", "min-layers", "labels"]
OPTIONS += ["smoothing", "draw-tets", "draw-labels"]


@pytest.fixture(autouse=True)
def nothing_said_of_compiling(monkeypatch):
    """Suppress the message about compiling, which depends on what ran before and is tested elsewhere."""
    monkeypatch.setattr("warp_corot.cli.run_setup.tell_compiling", lambda device: None)


def test_a_free_fall_is_noted(folder, capsys):
    assert simulate("box", "-o", "a.usd", "--fix", "none", "--damping", 0, *SHORT) == 0
    assert "note: no node is held ('none'): the body falls freely" in capsys.readouterr().err
    first, *_, last = frames(folder / "a.usd")
    # Symplectic Euler falls by half a step more than t^2/2, here 0.6 %.
    np.testing.assert_allclose(last - first, np.tile([0.0, -0.5 * 9.8 * 0.05**2, 0.0], (325, 1)), rtol=0.01, atol=1e-6)


def test_very_many_steps_are_announced(folder, capsys, monkeypatch):
    def end(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr("warp_corot.io.write.animate.record", end)
    assert simulate("box", "-o", "a.usd", *SHORT, "--dt", "1e-9") == 130
    assert "warp-corot: note: 2.5e+07 steps of 1e-09 s make a frame" in capsys.readouterr().err


def test_unstable_step_warns_and_keeps_frames(folder, capsys):
    explicit = "--integrator", "symplectic-euler", "--dt", 2e-3, "--duration", 2, "--fps", 100
    assert simulate("box", "-o", "a.usd", *explicit, "--device", "cpu") == 3
    out, err = capsys.readouterr()
    assert out == ""
    warning, error = err.splitlines()
    assert re.match(r"warp-corot: warning: the time step 0\.002 s is beyond the largest stable one", warning)
    match = re.match(r"warp-corot: error: .* (?:at|since) step (\d+) .*; (\d+) frames?\b.* a\.usd", error)
    assert match
    recorded = frames(folder / "a.usd")
    assert len(recorded) == int(match[2])
    assert len(recorded) == (int(match[1]) - 1) // 5 + 1  # frames of five steps, and the first
    assert all(np.isfinite(x).all() for x in recorded)


def test_failed_write_is_one_line(folder, capsys, monkeypatch):
    def fail(*_, **__):
        raise OSError("a.usd: cannot be written: No space left on device")

    monkeypatch.setattr("warp_corot.io.write.usd.writer.UsdWriter.write", fail)
    assert simulate("box", "-o", "a.usd", *SHORT) == 1
    said = lines_of(capsys.readouterr().err)
    assert said == ["warp-corot: error: a.usd: cannot be written: No space left on device"]


@pytest.mark.parametrize("name", ["a.pvd", "a.vtu"])
def test_a_file_for_paraview_that_cannot_be_written_is_named(folder, capsys, monkeypatch, name):
    def fail(*_):
        raise OSError(errno.ENOSPC, "a long story")

    monkeypatch.setattr("meshio.write", lambda *_, **__: fail())
    assert simulate("box", "-o", "a.usd", "--also", name, *SHORT) == 1
    named = "a_frames/a_00000.vtu" if name == "a.pvd" else name
    said = lines_of(capsys.readouterr().err)
    assert said == [f"warp-corot: error: {named}: cannot be written: No space left on device"]
    assert len(frames(folder / "a.usd")) >= 1


@pytest.mark.parametrize("args", [["--help"], ["simulate", "--help"], ["verify", "--help"]])
def test_help(args, capsys):
    assert run(*args) == 0
    said = capsys.readouterr().out
    assert "usage: warp-corot" in said
    if args[0] == "simulate":
        for name in OPTIONS:
            assert f"--{name} " in said


@pytest.mark.parametrize("stage", ["cli.subcommand", "inputs.processes.start_warp"])
def test_interrupted_before_anything_runs(stage, capsys, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"warp_corot.{stage}", interrupt)
    assert simulate("box", "-o", "a.usd") == 130
    assert capsys.readouterr() == ("", "warp-corot: interrupted\n")


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow)]
)
def test_signals_wait_for_the_end_of_an_import(number, status, request, tmp_path, monkeypatch):
    """Some modules swallow an exception during their import; after it they do not."""
    # A shell lets its background jobs ignore Ctrl-C.
    request.addfinalizer(functools.partial(signal.signal, number, signal.getsignal(number)))
    signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    (tmp_path / "swallowing.py").write_text(f"""
import signal, time
came_to = ["the signal"]
try:
    signal.raise_signal({int(number)})
    time.sleep(0.1)
except BaseException:
    came_to.append("an exception")
came_to.append("the end")
""")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "swallowing", raising=False)

    def run():
        importlib.import_module("swallowing")
        for _ in range(100):  # the exception comes between two of these
            time.sleep(0.05)

    with terminable(), pytest.raises(KeyboardInterrupt) as raised:
        run()
    swallowing = sys.modules["swallowing"]
    assert swallowing.came_to == ["the signal", "the end"]
    assert interrupt_status(raised.value) == status


def test_no_command_is_an_error(capsys):
    assert run() == 2
    assert capsys.readouterr().err.startswith("warp-corot: error: ")
