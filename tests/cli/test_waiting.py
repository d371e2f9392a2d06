"""Progress on a terminal during long work."""

import os
import struct
import subprocess
import sys
import time

import pytest

pty = pytest.importorskip("pty", reason="terminals are for POSIX")
fcntl = pytest.importorskip("fcntl")
termios = pytest.importorskip("termios")

SLOW_SCAN = """
import sys, time
from warp_corot.cli import main, run_setup, terminal
terminal.SILENT = terminal.EVERY = 0.02
found = run_setup.find_body
def slow(body):
    from warp_corot.cli.terminal import complain
    time.sleep(0.3)
    complain("of something", kind="note")
    time.sleep(0.3)
    return found(body)
run_setup.find_body = slow
sys.exit(main(["simulate", "box", "-o", "a.usd", "--duration", "0.05", "--fps", "40", "--device", "cpu"]))
"""

MANY_WORLDS = """
import time
import warp_corot as wc
body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 3), wc.Isotropic(1e4, 0.4, 1e3), worlds=256, device="cpu")
body.fix("z < 0.01")
sim = wc.Simulation(body)
sim.on_step(lambda sim: time.sleep(0.15))
wc.record(sim, "a.usd", duration=0.2, fps=50.0, world=3)
"""


def on_terminal(code: str, folder) -> str:
    """The text that a terminal receives from a program's stderr."""
    main, end = pty.openpty()
    fcntl.ioctl(end, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 100, 0, 0))
    process = subprocess.Popen([sys.executable, "-c", code], cwd=folder, stdout=subprocess.DEVNULL, stderr=end)
    os.close(end)
    said = b""
    started = time.monotonic()
    while time.monotonic() - started < 120:
        try:
            part = os.read(main, 4096)
        except OSError:  # the other end is closed
            break
        if not part:
            break
        said += part
    assert process.wait(timeout=60) == 0, said
    os.close(main)
    return said.decode()


def test_reading_and_meshing_show_since_when_and_lines_stay_whole(tmp_path):
    said = on_terminal(SLOW_SCAN, tmp_path)
    assert "meshing box, 00:00" in said
    # The note has a separate line, and the bar is gone at the end.
    assert "\rwarp-corot: note: of something\r\n" in said
    assert said.rpartition("meshing box")[2].count("\r") >= 1


@pytest.mark.slow
def test_a_run_of_many_worlds_shows_how_far_it_is(tmp_path):
    said = on_terminal(MANY_WORLDS, tmp_path)
    assert "simulating" in said
    assert "of 10 frames, " in said


ADVANCE = """
import sys
import warp_corot as wc
from warp_corot.simulation import progress
progress.SILENT = 0.0
body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 3), wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
body.fix("z < 0.01")
sim = wc.Simulation(body)
def advance():
    sim.advance(0.5)
    sim.advance_steps(500)
    print("NEXT", file=sys.stderr)
advance()
"""
QUIETLY = """
wc.show_progress(False)
advance()
wc.show_progress(True)
sim.on_step(lambda sim: None)
advance()
"""


def test_a_run_in_python_shows_how_far_it_is_and_is_quiet_where_it_should_be(tmp_path):
    """No bar is shown where the user says so, and where hooks are called."""
    shown, told, hooked, _ = on_terminal(ADVANCE + QUIETLY, tmp_path).split("NEXT\r\n")
    assert "of 0.5 s, " in shown
    assert "of 500 steps, " in shown
    # The bars are gone at the end.
    assert shown.rstrip().rpartition("\r")[2].strip() == "" or shown.endswith("\r")
    assert "simulating" not in told + hooked


@pytest.mark.parametrize("code", [ADVANCE, MANY_WORLDS.replace("time.sleep(0.15)", "None")], ids=["advance", "record"])
def test_a_run_in_python_is_quiet_in_files(code, folder, capfd, monkeypatch):
    monkeypatch.setattr("warp_corot.simulation.progress.SILENT", 0.0)
    exec(code, {})
    assert "simulating" not in "".join(capfd.readouterr())
