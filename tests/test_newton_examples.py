"""The examples for Newton under its own harness, and Newton's examples with this package's solver in them."""

import importlib
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from pxr import Usd, UsdGeom

newton = pytest.importorskip("newton")
examples = pytest.importorskip("newton.examples")

import warp_corot.newton as wn  # noqa: E402

FOLDER = Path(__file__).parent.parent / "examples" / "newton"
SCRIPTS = sorted(FOLDER.glob("*.py"))


@pytest.fixture
def harness(device, monkeypatch, tmp_path):
    """Run an example's class under Newton's harness in test mode."""
    monkeypatch.chdir(tmp_path)
    before = wp.get_device()

    def run(make, *options):
        monkeypatch.setattr(sys, "argv", ["example", "--device", device, "--test", "--quiet", *options])
        make()

    yield run
    wp.set_device(before)


def script(path):
    return lambda: runpy.run_path(str(path), run_name="__main__")


def test_there_are_examples():
    assert {path.stem for path in SCRIPTS} >= {"hanging", "drop", "gripper"}
    assert all(len(path.read_text().splitlines()) <= 110 for path in SCRIPTS)


@pytest.mark.slow
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_example(harness, path):
    harness(script(path), "--viewer", "null", "--num-frames", "180")


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_example_draws(harness, path, monkeypatch):
    """Newton's USD viewer writes frames in which things move; the short form of the above."""
    made = runpy.run_path(str(path), run_name="example")["Example"]
    monkeypatch.setattr(made, "test_final", lambda self: self.solver.check())

    def run():
        viewer, args = examples.init()
        example = made(viewer, args)
        start = example.state_0.particle_q.numpy().copy()
        examples.run(example, args)
        moved = np.abs(example.state_0.particle_q.numpy() - start).max()
        assert 1e-4 < moved < 1.0

    harness(run, "--viewer", "usd", "--output-path", "out.usd", "--num-frames", "8")
    stage = Usd.Stage.Open("out.usd")
    assert any(prim.IsA(UsdGeom.Mesh) or prim.IsA(UsdGeom.Points) for prim in stage.Traverse())
    assert stage.GetEndTimeCode() >= 7


#: Newton's examples with soft bodies: whose place the solver takes, and options.
NEWTONS = {
    "softbody.example_softbody_hanging": ("SolverVBD",),
    "multiphysics.example_rigid_soft_contact": ("SolverSemiImplicit", "--solver", "semi_implicit"),
}


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("softbody.example_softbody_hanging", 10),
        pytest.param("softbody.example_softbody_hanging", 300, marks=pytest.mark.slow),
        pytest.param("multiphysics.example_rigid_soft_contact", 300, marks=pytest.mark.slow),
    ],
)
def test_newtons_own_examples(harness, monkeypatch, name, frames):
    """Their own final tests hold with the solver exchanged."""
    exchanged, *options = NEWTONS[name]
    made = wn.SolverCorotated
    module = importlib.import_module(f"newton.examples.{name}")
    solvers = []

    def corotated(model, **_options):
        solvers.append(made(model, substeps=None))
        return solvers[-1]

    for place in (newton.solvers, module):
        monkeypatch.setattr(place, exchanged, corotated, raising=False)

    def run():
        viewer, args = examples.init(module.Example.create_parser())
        examples.run(module.Example(viewer, args), args)

    harness(run, "--viewer", "null", "--num-frames", str(frames), *options)
    assert len(solvers) == 1
    solvers[0].check()
