"""Newton's viewers that need no display draw the examples, and their files hold the simulation.

Viewers whose packages are missing are skipped; the test extra installs none but USD.
"""

import itertools
import runpy
from pathlib import Path
from urllib.request import urlopen

import numpy as np
import pytest
import warp as wp
from pxr import Usd, UsdGeom

newton = pytest.importorskip("newton")
examples = pytest.importorskip("newton.examples")

import warp_corot as wc  # noqa: E402

FOLDER = Path(__file__).parents[2] / "examples" / "newton"
FRAMES = 3


@pytest.fixture(scope="module")
def made_before():
    return {}


@pytest.fixture
def example(device, made_before):
    """An example by its name, with a viewer; all that do not draw with its camera share one."""

    def make(name, viewer, own=False):
        if own or (name, device) not in made_before:
            made = runpy.run_path(str(FOLDER / f"{name}.py"), run_name="example")["Example"]
            made_before[name, device] = made(viewer, examples.default_args())
        made = made_before[name, device]
        made.viewer = viewer
        viewer.set_model(made.model)
        return made

    with wp.ScopedDevice(device):
        yield make


def run(made, frames=FRAMES):
    """Run some frames like the harness; returns the particles' positions in each drawn frame [frames, P, 3]."""
    drawn = []
    for _ in range(frames):
        made.step()
        made.render()
        drawn.append(made.state_0.particle_q.numpy().copy())
    made.solver.check()
    return np.array(drawn)


# Newton's collisions of the gripper's boxes take a quarter of a minute to compile.
@pytest.mark.parametrize("name", ["drop", pytest.param("gripper", marks=pytest.mark.slow)])
def test_usd_has_every_frame(example, tmp_path, name):
    """Meshes in the stage are at the particles' positions, frame by frame."""
    path = tmp_path / "out.usd"
    viewer = newton.viewer.ViewerUSD(output_path=str(path), num_frames=FRAMES)
    made = example(name, viewer)
    drawn = run(made)
    viewer.close()
    stage = Usd.Stage.Open(str(path))
    assert stage.GetEndTimeCode() == round(made.sim_time * 60)
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]
    moving = [mesh for mesh in meshes if len(mesh.GetPointsAttr().GetTimeSamples()) == FRAMES]
    assert len(moving) == 1
    for k, code in enumerate(moving[0].GetPointsAttr().GetTimeSamples()):
        points = np.array(moving[0].GetPointsAttr().Get(code))
        if made.model.deformable_visual_meshes:
            inside = drawn[k].min(axis=0) - 1e-6, drawn[k].max(axis=0) + 1e-6
            assert ((points >= inside[0]) & (points <= inside[1])).all()
        else:
            assert np.array_equal(points, drawn[k])
        assert np.isfinite(np.array(moving[0].GetNormalsAttr().Get(code))).all()
    assert np.abs(drawn[-1] - drawn[0]).max() > 1e-4
    assert len({prim.GetName() for prim in stage.Traverse() if "shape" in str(prim.GetPath())}) > 1


def test_the_drawn_surface_is_the_ball(example):
    """At rest the skin that is drawn instead of the tetrahedra lies on the meshed sphere."""
    made = example("drop", newton.viewer.ViewerNull(num_frames=1))
    (skin,) = made.model.deformable_visual_meshes
    visuals = newton.geometry.DeformableVisuals(made.model)
    visuals.update(made.model.state())
    points = visuals.get_points(skin).numpy() - [0.02, 0.0, 0.5]
    corners = points[skin.indices.numpy().reshape(-1, 3)]
    assert np.abs(np.linalg.norm(points, axis=1) / 0.15 - 1.0).max() < 0.03
    assert np.linalg.det(corners).sum() / 6 == pytest.approx(4 / 3 * np.pi * 0.15**3, rel=0.04)  # closed, outward


@pytest.mark.parametrize("ending", ["json", "bin"])
def test_recordings_come_back(example, tmp_path, ending):
    """Newton's recordings restore model and states; ``write_attributes`` computes rotations and stress again."""
    if ending == "bin":
        pytest.importorskip("cbor2")
    path = tmp_path / f"out.{ending}"
    viewer = newton.viewer.ViewerFile(str(path), auto_save=False)
    made = example("drop", viewer)
    drawn = run(made)
    viewer.close()
    player = newton.viewer.ViewerFile(str(path))
    player.load_recording()
    assert player.get_frame_count() == FRAMES
    model = newton.Model(device=made.model.device)
    player.load_model(model)
    assert model.particle_count == made.model.particle_count
    assert np.array_equal(model.tet_indices.numpy(), made.model.tet_indices.numpy())
    state = made.model.state()
    for k in range(FRAMES):
        player.load_state(state, k)
        assert np.array_equal(state.particle_q.numpy(), drawn[k])
    made.solver.write_attributes(state)
    kept, found = made.state_0.warp_corot, state.warp_corot
    assert np.allclose(found.stress.numpy(), kept.stress.numpy(), rtol=1e-3, atol=1.0)
    assert np.abs((found.rotation.numpy() * kept.rotation.numpy()).sum(axis=1)) == pytest.approx(1.0, abs=1e-5)


@pytest.fixture
def gl(monkeypatch):
    """Newton's GL viewer without a window, small, on EGL."""
    pyglet = pytest.importorskip("pyglet")
    pyglet.options["headless"] = True
    try:
        from pyglet.libs.egl import egl  # noqa: F401

        viewer = newton.viewer.ViewerGL(width=320, height=180, headless=True)
    except Exception as error:
        pytest.skip(f"OpenGL does not start without a display here: {error}")
    yield viewer
    viewer.close()


def test_gl_draws_what_moves(example, gl):
    """Pictures show the scene and change with it, and the soft block is in the camera's view."""
    made = example("gripper", gl, own=True)
    pictures = []
    for k in range(31):
        made.step()
        if k % 10 == 0:
            made.render()
            pictures.append(gl.get_frame().numpy().astype(int))
    assert pictures[0].shape == (180, 320, 3)
    assert all(len(np.unique(picture.reshape(-1, 3), axis=0)) > 50 for picture in pictures)
    assert all((np.abs(a - b).max(axis=2) > 8).sum() > 100 for a, b in itertools.pairwise(pictures))
    red, _, blue = np.moveaxis(pictures[0], 2, 0)
    warm = np.argwhere(red > blue + 60)  # only soft bodies are drawn in yellow
    assert len(warm) > 300
    assert np.abs(warm.mean(axis=0) / [180, 320] - 0.5).max() < 0.25


def test_rerun_writes_a_recording(example, tmp_path, monkeypatch):
    """It goes to a file, not to the server for which Newton's viewer always looks."""
    rerun = pytest.importorskip("rerun")
    path = tmp_path / "out.rrd"
    monkeypatch.setattr(rerun, "connect_grpc", lambda _address: None)
    viewer = newton.viewer.ViewerRerun(address="nowhere", keep_historical_data=True)
    rerun.save(str(path))
    run(example("drop", viewer))
    viewer.close()
    rerun.disconnect()
    written = path.read_bytes()
    assert written.startswith(b"RRF2")
    assert b"deformable_visual_meshes" in written
    assert b"largest_von_mises_stress_in_Pa" in written


def test_viser_starts_and_stops(example):
    """Without a browser; it serves a web page."""
    pytest.importorskip("viser")
    viewer = newton.viewer.ViewerViser(port=0, verbose=False)
    try:
        run(example("drop", viewer))
        page = urlopen(f"http://127.0.0.1:{viewer._server.get_port()}", timeout=10).read()
        assert b"<html" in page.lower()
        assert viewer.is_running()
    finally:
        viewer.close()
    assert not viewer.is_running()


def test_a_tape_through_the_solvers_step_is_refused(example):
    made = example("hanging", newton.viewer.ViewerNull(num_frames=1))
    with wp.Tape() as tape:
        with pytest.raises(wc.InputError, match="steps have no adjoint"):
            made.solver.step(made.state_0, made.state_1, made.control, None, 1e-4)
        assert not tape.launches
