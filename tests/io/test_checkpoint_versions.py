"""Checkpoints of older versions resume as they would have then."""

import json

import numpy as np
import pytest
from older_checkpoints import as_version

import warp_corot as wc


def beam(worlds=2):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), worlds=worlds, device="cpu")
    body.fix(mesh.points[:, 2] < 1e-9)
    body.prescribe(mesh.points[:, 2] > 0.2 - 1e-9, times=[0.0, 1.0], displacements=[[0, 0, 0], [0, 0, 0.02]])
    return body


@pytest.mark.parametrize("version", [2, 3, 4])
def test_versions_of_one_step_go_on_with_it(tmp_path, version):
    """Version 2 had one material and no domains, 3 no changing mesh, 4 no step that follows the state."""
    sim = wc.Simulation(beam(), integrator=wc.SymplecticEuler(dt=1e-3))
    sim.advance_steps(10)
    sim.reset(worlds=1)
    sim.advance_steps(5)
    sim.save(tmp_path / "now.npz")
    as_version(tmp_path / "now.npz", tmp_path / "old.npz", version)
    old = wc.Simulation.load(tmp_path / "old.npz")
    assert (old.worlds, old.steps, old.dt) == (2, 15, sim.dt)
    for each in (sim, old):
        each.advance_steps(15)
    np.testing.assert_array_equal(old.body.positions.numpy(), sim.body.positions.numpy())
    assert old.time == old.total_time == sim.time


def test_version_5_goes_on_with_the_step_that_it_had(tmp_path):
    """It stored neither the state's step at the last check nor the length of the last step, but how the step
    had changed, and whether a user had written velocities."""
    sim = wc.Simulation(beam(worlds=1))
    sim.advance(0.2)
    sim.save(tmp_path / "now.npz")
    with np.load(tmp_path / "now.npz") as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes()) | {"version": 5}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    arrays["kept.control"] = np.insert(arrays["kept.control"][:-1], (5, 6), 0.0)
    arrays["kept.seconds"] = arrays["kept.seconds"][:2]
    arrays["guard.counted"] = arrays["guard.counted"][:6]
    del arrays["guard.lately"]
    np.savez(tmp_path / "old.npz", **arrays)
    old = wc.Simulation.load(tmp_path / "old.npz")
    assert (old.steps, old.time, old.dt) == (sim.steps, sim.time, sim.dt)
    old.advance(0.1)
    assert old.time == pytest.approx(0.3)


def test_time_from_before_a_reset_is_kept(tmp_path):
    sim = wc.Simulation(beam(worlds=1), gravity=(0, 0, 0))
    sim.advance_steps(7)
    sim.reset()
    sim.advance_steps(4)
    sim.save(tmp_path / "a.npz")
    again = wc.Simulation.load(tmp_path / "a.npz")
    assert (again.steps, again.total_steps) == (4, 11)
    assert (again.time, again.total_time) == (sim.time, sim.total_time)
