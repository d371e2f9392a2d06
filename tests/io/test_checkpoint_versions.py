"""Checkpoints have one version, and know the time from before a reset."""

import json

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.io.checkpoint.archive import VERSION


def beam(worlds=2):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), worlds=worlds, device="cpu")
    body.fix(mesh.points[:, 2] < 1e-9)
    body.prescribe(mesh.points[:, 2] > 0.2 - 1e-9, times=[0.0, 1.0], displacements=[[0, 0, 0], [0, 0, 0.02]])
    return body


@pytest.mark.parametrize("version", [VERSION - 1, VERSION + 1])
def test_other_versions_are_refused_in_a_line(tmp_path, version):
    wc.Simulation(beam()).save(tmp_path / "now.npz")
    with np.load(tmp_path / "now.npz") as archive:
        arrays = dict(archive)
    header = json.loads(arrays["header"].tobytes()) | {"version": version}
    arrays["header"] = np.frombuffer(json.dumps(header).encode(), np.uint8)
    np.savez(tmp_path / "other.npz", **arrays)
    with pytest.raises(wc.InputError, match=f"has version {version}; this warp_corot reads version {VERSION} only"):
        wc.Simulation.load(tmp_path / "other.npz")


def test_time_from_before_a_reset_is_kept(tmp_path):
    sim = wc.Simulation(beam(worlds=1), gravity=(0, 0, 0))
    sim.advance_steps(7)
    sim.reset()
    sim.advance_steps(4)
    sim.save(tmp_path / "a.npz")
    again = wc.Simulation.load(tmp_path / "a.npz")
    assert (again.steps, again.total_steps) == (4, 11)
    assert (again.time, again.total_time) == (sim.time, sim.total_time)
