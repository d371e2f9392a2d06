"""Recording: whole steps in a frame, several bodies in one stage, and signals that wait for a complete frame."""

import os
import signal

import numpy as np
import pytest
from pxr import Usd, UsdGeom

import warp_corot as wc
from warp_corot.io.write.animate import Recording, record, rounding, signals_held_back, steps_per_frame


def beam(device, x=0.0, young=1e4):
    mesh = wc.TetForest.box((1, 1, 2), 0.05, 3, origin=(x, 0.0, 0.0))
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), device=device)
    body.fix(mesh.points[:, 2] == 0)
    return body


def test_least_whole_number_of_steps(rng):
    for fps, dt in rng.uniform([1, 1e-5], [120, 2e-2], (500, 2)):
        n = steps_per_frame(fps, dt)
        assert 1.0 / (fps * n) <= dt * (1 + 1e-6)
        assert n == 1 or 1.0 / (fps * (n - 1)) > dt
    assert steps_per_frame(25.0, 2e-4) == 200  # exact if it divides exactly
    assert steps_per_frame(30.0, 1.0 / 3000.0) == 100
    with pytest.raises(wc.InputError, match=r"a frame of 0\.04 s would take 4e\+28 steps"):
        steps_per_frame(25.0, 1e-30)


def test_several_bodies_are_one_mesh(device, tmp_path):
    bodies = [beam(device), beam(device, x=0.1, young=2e4)]
    sim = wc.Simulation(bodies, model=[wc.Corotated(), wc.Linear()], integrator=wc.SymplecticEuler(damping=5.0))
    done = record(sim, tmp_path / "a.usd", duration=0.1, fps=20)
    assert (done.frames, done.steps) == (3, sim.steps)
    assert done.simulated == pytest.approx(0.1, rel=1e-12)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    tets = UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra")
    together = np.concatenate([body.positions.numpy() for body in bodies])
    np.testing.assert_array_equal(np.array(tets.GetPointsAttr().Get(2)), together)
    primvars = UsdGeom.PrimvarsAPI(tets)
    count = len(bodies[0].mesh.tets)
    np.testing.assert_allclose(np.array(primvars.GetPrimvar("young").Get()), np.repeat([1e4, 2e4], count))
    stress = np.concatenate([sim.von_mises(body) for body in bodies])
    np.testing.assert_allclose(np.array(primvars.GetPrimvar("vonMises").Get(2)), stress, rtol=1e-6)
    moved = np.linalg.norm(together - np.concatenate([b.mesh.points for b in bodies]), axis=1).max()
    assert done.final_displacement == pytest.approx(moved, rel=1e-4)
    assert done.largest_displacement >= done.final_displacement


def test_a_recording_continues_from_the_current_state(tmp_path):
    sim = wc.Simulation(beam("cpu"))
    sim.advance(0.05)
    before = sim.body.positions.numpy().copy()
    done = record(sim, tmp_path / "a.usd", duration=0.05, fps=40)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    tets = UsdGeom.TetMesh.Get(stage, "/SoftBody/tetrahedra")
    np.testing.assert_array_equal(np.array(tets.GetPointsAttr().Get(0)), before)
    assert done.simulated == pytest.approx(0.05, abs=sim.dt)
    assert sim.time == pytest.approx(0.1, abs=2 * sim.dt)


@pytest.mark.parametrize(("duration", "fps"), [(0.0, 24.0), (np.nan, 24.0), (1.0, 0.0), (1.0, -3.0), (1e-3, 24.0)])
def test_bad_times_are_refused_before_anything_happens(tmp_path, duration, fps):
    sim = wc.Simulation(beam("cpu"))
    with pytest.raises(wc.InputError):
        record(sim, tmp_path / "a.usd", duration=duration, fps=fps)
    assert sim.steps == 0
    assert list(tmp_path.iterdir()) == []


def test_a_duration_between_two_frames_is_reported():
    assert rounding(0.5, 24.0) is None
    assert rounding(1e3 / 24, 24.0) is None
    told = rounding(0.1, 24.0)
    assert told is not None
    assert "0.08333 s, not 0.1 s" in told
    assert "--fps 30" in told
    assert "--fps" not in str(rounding(0.1234567, 24.0))


def test_frames_are_kept_however_a_run_ends(tmp_path):
    sim = wc.Simulation(beam("cpu"))
    done = Recording(tmp_path / "a.usd")

    def end(frame, count):
        if frame == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(sim, tmp_path / "a.usd", duration=1.0, fps=50, progress=end, recording=done)
    assert done.frames == 4
    assert Usd.Stage.Open(str(tmp_path / "a.usd")).GetEndTimeCode() == 3


@pytest.mark.skipif(os.name != "posix", reason="POSIX signals")
def test_signals_wait():
    came = []
    before = signal.signal(signal.SIGTERM, lambda *_: came.append("after"))
    try:
        with signals_held_back():
            os.kill(os.getpid(), signal.SIGTERM)
            came.append("inside")
        assert came == ["inside", "after"]
    finally:
        signal.signal(signal.SIGTERM, before)
