"""Kernels are loaded before the first step, several modules at a time."""

import subprocess
import sys
import time
from concurrent.futures import Future

from warp_corot.inputs import loading

STEPS = """
import warp_corot as wc
forest = wc.TetForest.box((1, 1, 2), 0.1, 4).refine([0, 1])
tets = wc.TetMesh(forest.points, forest.tets)
corotated, neo_hookean = wc.Corotated(), wc.NeoHookean()
for mesh, model, poisson in (
    (forest, corotated, 0.49), (tets, corotated, 0.49), (forest, neo_hookean, 0.3), (tets, corotated, 0.3)
):
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, poisson, 1e3), device="cpu")
    body.fix("z == zmin")
    sim = wc.Simulation(body, model=model)
    print("steps", flush=True)
    sim.advance(0.01)
    sim.von_mises(), sim.energy()
    print("end", flush=True)
"""


def test_steps_load_no_kernels():
    """Warp says which modules it loads, and when."""
    ran = subprocess.run([sys.executable, "-c", STEPS], capture_output=True, text=True, check=True)
    found = [line.split()[:2] for line in ran.stdout.splitlines() if line.startswith(("steps", "end", "Module"))]
    assert found.count(["steps"]) == found.count(["end"]) == 4
    assert any(words[0] == "Module" for words in found)
    for number, words in enumerate(found):
        if words == ["steps"]:
            assert found[number + 1] == ["end"], found[number + 1]


def test_progress_counts_the_modules_that_are_being_loaded(monkeypatch):
    """It estimates the time left by the time so far, and not before a quarter are loaded."""
    ended, waits = Future(), Future()
    ended.set_result(None)
    monkeypatch.setattr(loading, "_begun", {("first", "cpu"): ended, **{(k, "cpu"): waits for k in range(4)}})
    monkeypatch.setattr(loading, "_since", [time.monotonic() - 3.0])
    assert loading.progress() == (1, 5, None)
    del loading._begun[3, "cpu"]
    done, count, left = loading.progress()
    assert (done, count) == (1, 4)
    assert 9.0 <= left < 90.0
    waits.set_result(None)
    assert loading.progress() is None
