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

from newton_assets import stand_in  # noqa: E402

import warp_corot.newton as wn  # noqa: E402

FOLDER = Path(__file__).parents[2] / "examples" / "newton"
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
    assert all(len(path.read_text(encoding="utf-8").splitlines()) <= 110 for path in SCRIPTS)


@pytest.mark.slow
@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_example(harness, path):
    harness(script(path), "--viewer", "null", "--num-frames", "180")


@pytest.mark.parametrize(
    "path",
    # Newton's collisions of the gripper's boxes take a quarter of a minute to compile.
    [pytest.param(path, marks=pytest.mark.slow if path.stem == "gripper" else (), id=path.stem) for path in SCRIPTS],
)
def test_example_draws(harness, path, monkeypatch):
    """Newton's USD viewer writes frames in which things move; a short form of the test above."""
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


class Exchange:
    """Replaces one of Newton's solvers for models with tetrahedra; for others that solver is made."""

    def __init__(self, solver, **options):
        self.solver, self.options, self.made = solver, options, []
        self.register_custom_attributes = solver.register_custom_attributes

    def __call__(self, model, **options):
        if not model.tet_count:
            return self.solver(model, **options)
        self.made.append(wn.SolverCorotated(model, **{"substeps": None, **self.options}))
        self.made[-1].rebuild_bvh = lambda state: None  # of SolverVBD
        return self.made[-1]


@pytest.fixture
def exchanged(harness, monkeypatch):
    """Run one of Newton's examples in test mode with this solver, for a number of frames.

    Returns:
        The example, and the positions [m] and velocities [m/s] of the tetrahedra's particles in every frame, [F, N, 3].
    """

    def run(name, frames, options=(), *, solver="SolverVBD", prepare=None, **solver_options):
        module = importlib.import_module(f"newton.examples.{name}")
        exchange = Exchange(getattr(newton.solvers, solver), **solver_options)
        for place in (newton.solvers, module):
            if hasattr(place, solver):
                monkeypatch.setattr(place, solver, exchange)
        examples_made, path = [], []

        def make():
            create = getattr(module.Example, "create_parser", examples.create_parser)
            viewer, args = examples.init(create())
            example = module.Example(viewer, args)
            if prepare is not None:
                prepare(example)
            soft = np.unique(example.model.tet_indices.numpy())
            step = example.step

            def followed():
                step()
                state = example.state_0
                path.append([array.numpy()[soft] for array in (state.particle_q, state.particle_qd)])

            example.step = followed
            examples_made.append(example)
            examples.run(example, args)

        harness(make, "--viewer", "null", "--num-frames", str(frames), *options)
        assert len(exchange.made) == 1
        exchange.made[0].check()
        assert len(path) == frames
        assert np.isfinite(path).all()
        return examples_made[0], *np.swapaxes(path, 0, 1)

    return run


@pytest.mark.parametrize("frames", [10, pytest.param(300, marks=pytest.mark.slow)])
def test_newtons_hanging_bodies(exchanged, frames):
    _, x, _ = exchanged("softbody.example_softbody_hanging", frames)
    assert x[-1, :, 2].mean() < x[0, :, 2].mean()  # they hang


@pytest.mark.slow
def test_newtons_hanging_bodies_come_to_rest(exchanged):
    """With mass-proportional damping; without it the softest damped one would swing for minutes."""
    _, x, v = exchanged("softbody.example_softbody_hanging", 300, damping=4.0)
    assert np.abs(v[-1]).max() < 5e-3 < 0.1 * np.abs(v).max()
    assert x[-1, :, 2].mean() < x[0, :, 2].mean()


@pytest.mark.slow
def test_newtons_ball_on_a_soft_body(exchanged):
    name, options = "multiphysics.example_rigid_soft_contact", ("--solver", "semi_implicit")
    _, x, _ = exchanged(name, 300, options, solver="SolverSemiImplicit")
    assert x[:, :, 2].min() > -0.1


@pytest.mark.slow
def test_newtons_ball_on_a_soft_body_coupled(exchanged):
    """MuJoCo steps the ball: it is caught."""
    pytest.importorskip("mujoco_warp")
    example, x, _ = exchanged("multiphysics.example_rigid_soft_contact", 40, ("--solver", "coupled"))
    assert x[:, :, 2].min() > -0.02
    assert example.state_0.body_qd.numpy()[0, 2] > 0.0
    assert example.state_0.body_q.numpy()[0, 2] > 1.0 + 0.5 * 0.75  # above the body's top


@pytest.mark.slow
def test_newtons_coupled_gripper(exchanged):
    """MuJoCo steps the fingers, which are proxies here with their joints and close on a soft block.

    The block has next to no damping; implicit steps have numerical damping, explicit ones do not.
    """
    pytest.importorskip("mujoco_warp")
    _, x, v = exchanged("multiphysics.example_proxy_joint_gripper", 120, substeps=24, damping=200.0)
    inner = x[0, :, 0] < 0.01  # the others begin at the fingers' edges
    width = np.ptp(x[:, inner, 1], axis=1)
    assert width[-1] < 0.6 * width[0]  # it is squeezed
    assert np.abs(x[-1, inner, 0]).max() < 0.045  # and held between the fingers
    assert np.abs(v[-1]).max() < 0.05


@pytest.mark.slow
def test_newtons_soft_body_on_cloth(exchanged):
    """SolverVBD steps the cloth, in which the block is a proxy: it pushes the cloth down and bounces back."""
    name, options = "multiphysics.example_softbody_dropping_to_cloth", ("--solver", "coupled")
    example, x, _ = exchanged(name, 60, options)
    cloth = example.state_0.particle_q.numpy()[example.cloth_particles]
    height = x[:, :, 2].mean(axis=1)
    lowest = height.argmin()
    assert 0.6 < height[lowest] < 1.0  # the cloth is at 1 m
    assert 1.2 < height[lowest:].max() < height[0]
    assert x[-1, :, 2].min() > cloth[:, 2].min()


@pytest.mark.slow
def test_newtons_boxes_cloth_and_soft_bodies(exchanged):
    """MuJoCo steps boxes and a chain; one solver steps cloth and soft bodies, without contact between them."""
    pytest.importorskip("mujoco_warp")
    example, x, _ = exchanged("multiphysics.example_mujoco_vbd_coupled_solver", 40)
    assert x[:, :, 2].min() > -0.02
    assert example.state_0.body_q.numpy()[:, 2].min() > 0.9  # on the cloth


@pytest.mark.slow
def test_newtons_arm_lifts_a_soft_block(exchanged, monkeypatch, tmp_path):
    """A Franka arm, moved by inverse kinematics, grips a block, lifts it, puts it down and releases it.

    Boxes replace the arm's parts and a block the duck, since these are downloads; at four times the speed.
    """
    utils = importlib.import_module("newton.utils")
    monkeypatch.setattr(utils, "download_asset", lambda name: stand_in(tmp_path, name))

    def hurry(example):
        example.robot_key_poses_time /= 4.0

    name = "softbody.example_softbody_franka"
    example, x, v = exchanged(name, 250, rigid_solver=None, prepare=hurry)
    times = example.robot_key_poses_time / example.frame_dt
    height = x[:, :, 2].mean(axis=1)
    closed, lifted, held, put_down = times[[2, 3, 4, 5]].astype(int) - 1
    assert height[lifted] - height[closed] == pytest.approx(0.14, abs=0.01)
    assert np.ptp(height[lifted + 5 : held]) < 1e-3
    assert height[put_down] - height[closed] == pytest.approx(0.0, abs=0.02)
    assert x[:, :, 2].min() > 0.2  # the table's top
    assert np.abs(v[-1]).max() < 0.05
    assert x[-1, :, 2].min() == pytest.approx(0.205, abs=1e-3)  # on it, by the particles' radius
