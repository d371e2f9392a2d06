"""A resumed run equals the uninterrupted run; a checkpoint is complete or absent."""

import contextlib
import json
import os
import resource
import subprocess
import sys
import warnings

import numpy as np
import pytest

import warp_corot as wc

MATERIAL = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)


def forest_body(device):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3).refine([0, 7])
    body = wc.SoftBody(mesh, MATERIAL, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def general_body(device):
    forest = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=2)
    rng = np.random.default_rng(3)
    mesh = wc.TetMesh(forest.points + 0.003 * rng.standard_normal(forest.points.shape), forest.tets)
    young = 1e4 * (1 + rng.random(len(mesh.tets)))
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), device=device)
    top = np.flatnonzero(forest.points[:, 2] > 0.2 - 1e-9)
    body.fix(forest.points[:, 2] < 1e-9)
    body.prescribe(top, times=[0, 0.05, 0.1], displacements=[[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0]])
    body.load([5], [0.1, 0, 0])
    return body


def given(dt):
    return wc.SymplecticEuler(dt=dt, damping=2.0)


@pytest.mark.parametrize(
    ("make", "model"),
    [
        (forest_body, wc.Corotated()),
        (forest_body, wc.Corotated(rotation_level=1)),
        (forest_body, wc.Corotated(iterations=4)),
        (forest_body, wc.EdgeStVK("quadratic")),
        (general_body, wc.Corotated(rotation="svd")),
        (general_body, wc.NeoHookean()),
        (general_body, wc.MassSpring()),
    ],
    ids=lambda v: getattr(v, "__name__", repr(v)),
)
def test_a_resumed_run_is_the_uninterrupted_one(device, tmp_path, make, model):
    integrator = wc.SymplecticEuler(damping=2.0)
    whole = wc.Simulation(make(device), model=model, integrator=integrator, gravity=(0.1, -9.8, 0))
    if whole.device.is_cuda:  # where forces are summed in any order, the step that follows them is never quite the same
        integrator = given(0.5 * whole.dt)  # stretched springs are stiffer: half of the stable step at rest
        whole = wc.Simulation(make(device), model=model, integrator=integrator, gravity=(0.1, -9.8, 0))
    parted = wc.Simulation(make(device), model=model, integrator=integrator, gravity=(0.1, -9.8, 0))
    whole.advance_steps(150)
    parted.advance_steps(70)
    parted.save(tmp_path / "state.npz")
    resumed = wc.Simulation.load(tmp_path / "state.npz")
    assert resumed.dt == parted.dt
    assert resumed.steps == 70
    resumed.advance_steps(80)
    assert resumed.dt == whole.dt
    assert resumed.time == whole.time
    for name in ("positions", "displacements", "velocities", "reactions"):
        a, b = getattr(whole.body, name).numpy(), getattr(resumed.body, name).numpy()
        if whole.device.is_cpu:
            np.testing.assert_array_equal(a, b, err_msg=name)
        # Float atomics add in any order on CUDA; 150 undamped steps amplify that.
        np.testing.assert_allclose(a, b, rtol=0, atol=5e-3 * np.abs(a).max(), err_msg=name)


@pytest.mark.parametrize(("saved", "level", "pull"), [(0.03, 4, [0, 0, 0.06]), (0.05, 5, [0.06, 0, 0])])
def test_a_run_that_went_back_resumes(tmp_path, saved, level, pull):
    """One end of very soft tissue is pulled fast. The run goes back to shorter steps after the checkpoint, or before
    and after it; each step depends on what was counted before."""
    body = wc.SoftBody(wc.TetForest.box((1, 1, 3), 0.064, level), wc.Isotropic(300.0, 0.49, 1000.0), device="cpu")
    body.fix("z == zmin")
    body.prescribe("z == zmax", times=[0.0, 0.05], displacements=[[0, 0, 0], pull])
    whole = wc.Simulation(body)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wc.StabilityWarning)
        whole.advance(saved)
        whole.save(tmp_path / "state.npz")
        resumed = wc.Simulation.load(tmp_path / "state.npz")
        # A copy that was only loaded and saved is the same checkpoint.
        resumed.save(tmp_path / "copy.npz")
        resumed = wc.Simulation.load(tmp_path / "copy.npz")
        for sim in (whole, resumed):
            sim.advance(0.04)
    assert (resumed.steps, resumed.dt) == (whole.steps, whole.dt)
    np.testing.assert_array_equal(resumed.body.positions.numpy(), whole.body.positions.numpy())


def test_several_bodies_are_kept(tmp_path):
    bodies = [forest_body("cpu"), general_body("cpu")]
    sim = wc.Simulation(bodies, model=[wc.Linear(), wc.StVenantKirchhoff()])
    sim.advance_steps(10)
    sim.save(tmp_path / "two.npz")
    again = wc.Simulation.load(tmp_path / "two.npz", device="cpu")
    assert again.models == sim.models
    assert again.energy() == sim.energy()
    np.testing.assert_array_equal(again.bodies[1].constrained, bodies[1].constrained)
    assert again.bodies[0].mesh.levels.tolist() == bodies[0].mesh.levels.tolist()
    assert again.bodies[1].mesh.up_axis == "Y"


def test_a_failed_save_leaves_the_good_checkpoint(tmp_path):
    sim = wc.Simulation(forest_body("cpu"))
    path = tmp_path / "state.npz"
    sim.save(path)
    good = path.read_bytes()
    sim.advance_steps(5)
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    import signal

    old = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (2000, hard))
    try:
        with pytest.raises(wc.InputError, match="cannot save"):
            sim.save(path)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
        signal.signal(signal.SIGXFSZ, old)
    assert path.read_bytes() == good
    assert [p.name for p in tmp_path.iterdir()] == ["state.npz"]


def test_a_killed_save_leaves_the_good_checkpoint(tmp_path):
    path = tmp_path / "state.npz"
    sim = wc.Simulation(forest_body("cpu"))
    sim.save(path)
    script = f"""
import os, threading, time
import warp_corot as wc
sim = wc.Simulation.load({os.fspath(path)!r})
threading.Timer(0.2, lambda: os.kill(os.getpid(), 9)).start()
while True:
    sim.save({os.fspath(path)!r})
"""
    subprocess.run([sys.executable, "-c", script], check=False, capture_output=True)
    assert wc.Simulation.load(path).steps == 0


@pytest.mark.parametrize("content", [None, b"", b"no archive", b"PK\x03\x04 half an archive"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "state.npz"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(wc.InputError, match="checkpoint"):
        wc.Simulation.load(path)


def test_other_archives_and_pickles_are_refused(tmp_path):
    np.savez(tmp_path / "other.npz", a=np.zeros(3))
    np.savez(tmp_path / "pickle.npz", header=np.array([{"format": 1}], dtype=object))
    for name in ("other.npz", "pickle.npz"):
        with pytest.raises(wc.InputError, match="not a complete checkpoint"):
            wc.Simulation.load(tmp_path / name)


def test_damaged_archives_are_refused(tmp_path, rng):
    """A flipped bit anywhere, or a missing part, is detected and raises only an ``InputError``."""
    sim = wc.Simulation(forest_body("cpu"))
    path, other = tmp_path / "state.npz", tmp_path / "damaged.npz"
    sim.save(path)
    whole = path.read_bytes()
    for _ in range(60):
        damaged = bytearray(whole)
        damaged[rng.integers(len(whole))] ^= 1 << rng.integers(8)
        other.write_bytes(damaged)
        with contextlib.suppress(wc.InputError):  # a bit of a date does not matter
            assert wc.Simulation.load(other).steps == 0
    with np.load(path) as archive:
        parts = dict(archive)
    header = json.loads(parts["header"].tobytes())
    variants = [{k: v for k, v in parts.items() if k != name} for name in parts]
    for name in header:
        less = json.dumps({k: v for k, v in header.items() if k != name}).encode()
        variants.append(parts | {"header": np.frombuffer(less, np.uint8)})
    for variant in variants:
        np.savez(other, **variant)
        with pytest.raises(wc.InputError, match="not a complete checkpoint"):
            wc.Simulation.load(other)


@pytest.mark.skipif(os.name != "posix", reason="POSIX permissions")
def test_others_may_read_what_the_umask_lets_them(tmp_path):
    before = os.umask(0o022)
    try:
        wc.Simulation(forest_body("cpu")).save(tmp_path / "state.npz")
    finally:
        os.umask(before)
    assert (tmp_path / "state.npz").stat().st_mode & 0o777 == 0o644


def test_a_missing_folder_is_named(tmp_path):
    sim = wc.Simulation(forest_body("cpu"))
    with pytest.raises(wc.InputError, match="does not exist"):
        sim.save(tmp_path / "nowhere" / "state.npz")
    with pytest.raises(wc.InputError, match="is a folder"):
        sim.save(tmp_path)
