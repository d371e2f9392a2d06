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
