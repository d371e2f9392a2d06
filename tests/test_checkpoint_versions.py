"""Checkpoints of older versions go on as they would have."""

import json

import numpy as np

import warp_corot as wc


def test_version_2_knew_one_material_and_no_domains(tmp_path):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), worlds=2, device="cpu")
    body.fix(mesh.points[:, 2] < 1e-9)
    sim = wc.Simulation(body)
    sim.advance_steps(12)
    sim.save(tmp_path / "now.npz")
    with np.load(tmp_path / "now.npz") as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes()) | {"version": 2}
    for described in header["bodies"]:
        del described["material"], described["activations"]
        del described["mesh"]["of_domain"], described["mesh"]["label_names"]
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(tmp_path / "old.npz", **arrays)
    old = wc.Simulation.load(tmp_path / "old.npz")
    assert (old.worlds, old.steps) == (2, 12)
    for each in (sim, old):
        each.advance_steps(15)
    np.testing.assert_array_equal(old.body.positions.numpy(), sim.body.positions.numpy())


def test_version_3_knew_one_mesh_and_one_step(tmp_path):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), worlds=2, device="cpu")
    body.fix(mesh.points[:, 2] < 1e-9)
    body.prescribe(mesh.points[:, 2] > 0.2 - 1e-9, times=[0.0, 1.0], displacements=[[0, 0, 0], [0, 0, 0.02]])
    sim = wc.Simulation(body)
    sim.advance_steps(10)
    sim.reset(worlds=1)
    sim.advance_steps(5)
    sim.save(tmp_path / "now.npz")
    with np.load(tmp_path / "now.npz") as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes()) | {"version": 3}
    for name in ("stable_dt", "epoch", "steps_before_reset", "time_before_reset"):
        del header[name]
    for described in header["bodies"]:
        del described["remesh"]
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    arrays["body0.world_starts"] = arrays["body0.world_starts"].astype(np.int64)
    np.savez(tmp_path / "old.npz", **arrays)
    old = wc.Simulation.load(tmp_path / "old.npz")
    assert (old.worlds, old.steps, old.dt) == (2, 15, sim.dt)
    for each in (sim, old):
        each.advance_steps(15)
    np.testing.assert_array_equal(old.body.positions.numpy(), sim.body.positions.numpy())
    assert old.time == old.total_time == sim.time


def test_time_from_before_a_reset_is_kept(tmp_path):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device="cpu")
    sim = wc.Simulation(body, gravity=(0, 0, 0))
    sim.advance_steps(7)
    sim.reset()
    sim.advance_steps(4)
    sim.save(tmp_path / "a.npz")
    again = wc.Simulation.load(tmp_path / "a.npz")
    assert (again.steps, again.total_steps) == (4, 11)
    assert (again.time, again.total_time) == (sim.time, sim.total_time)
