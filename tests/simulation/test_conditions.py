"""Supports, loads and keyframes of a patch: set on the device, at the cost of the patch, from any program's arrays."""

import numpy as np
import pytest
import warp as wp

import warp_corot as wc

RUBBER = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)


def bar(device, worlds=1, **options):
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=6)
    body = wc.SoftBody(mesh, RUBBER, worlds=worlds, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return wc.Simulation(body, integrator=wc.SymplecticEuler(damping=5.0), gravity=(0, 0, 0), **options)


def top_of(sim):
    return np.flatnonzero(sim.body.mesh.points[:, 2] > 0.2 - 1e-9)


def in_warp(values, device):
    return wp.array(values, dtype=wp.vec3, device=device)


def in_rows(values, device):
    return wp.array(values, dtype=wp.float32, device=device)


def in_doubles(values, device):
    return wp.array(np.squeeze(values), dtype=wp.float64, device=device)


def in_torch(values, device):
    torch = pytest.importorskip("torch")
    return torch.tensor(values, dtype=torch.float32, device=str(device))


@pytest.mark.parametrize("made", [in_warp, in_rows, in_doubles, in_torch])
@pytest.mark.parametrize("each", [False, True], ids=["one for all", "one each"])
def test_forces_and_velocities_on_the_device_are_those_of_numpy(made, each, device, rng):
    force, velocity = 1e-2 * rng.standard_normal((2, 3))
    ends = []
    for on_device in (False, True):
        sim = bar(device)
        top = top_of(sim)
        values = [np.outer(np.linspace(0.5, 1.5, len(top)), v) if each else v[None] for v in (force, velocity)]
        given = [made(v, sim.device) if on_device else (v if each else v[0]) for v in values]
        sim.body.load(top, given[0])
        sim.advance(0.01)
        sim.body.prescribe(top, velocity=given[1])
        sim.advance(0.01)
        ends.append(sim.body.displacements.numpy())
    assert np.abs(ends[0]).max() > 1e-5
    np.testing.assert_allclose(ends[1], ends[0], atol=1e-6 * np.abs(ends[0]).max())


def test_velocities_of_a_whole_body_leave_held_nodes_alone(device):
    sim = bar(device)
    body, top = sim.body, top_of(sim)
    body.prescribe(top, velocity=(0.1, 0.0, 0.0))
    body.velocities = np.full((body.node_count, 3), 0.5)
    sim.advance(0.01)
    moved, fixed = body.displacements.numpy(), np.flatnonzero(body.mesh.points[:, 2] < 1e-9)
    np.testing.assert_array_equal(moved[fixed], 0.0)
    np.testing.assert_allclose(moved[top], np.tile([0.001, 0.0, 0.0], (len(top), 1)), atol=1e-5)
    assert (moved[~body.constrained] > 1e-3).any()


def test_one_worlds_values_mean_all_worlds(device):
    sim = bar(device, worlds=3)
    top = top_of(sim)
    forces = np.outer(np.arange(1.0, len(top) + 1.0), [0.0, 1e-3, 0.0])
    sim.body.load(top, in_warp(forces, sim.device), worlds=[0, 2])
    loads = sim.body.loads.numpy().reshape(3, -1, 3)
    np.testing.assert_allclose(loads[0, top], forces, rtol=1e-6)
    np.testing.assert_allclose(loads[2, top], forces, rtol=1e-6)
    assert not loads[1].any()
    with pytest.raises(wc.InputError, match=r"it must be float32 \[3\] or"):
        sim.body.load(top, in_warp(forces[:-1], sim.device))


def test_nodes_may_be_named_by_a_warp_array(device):
    sim = bar(device)
    top = top_of(sim)
    sim.body.fix(wp.array(top, dtype=wp.int32, device=sim.device))
    assert sim.body.constrained[top].all()
    sim.body.release(wp.array(top, dtype=wp.int32, device=sim.device))
    assert not sim.body.constrained[top].any()


def test_a_change_of_a_patch_brings_no_nodal_array_to_the_host(device, monkeypatch):
    """Copying a body's arrays to the host and back takes time in proportion to the body."""
    sim = bar(device)
    sim.advance_steps(2)
    body, top = sim.body, top_of(sim)
    _ = body.loads  # made on first use, as large as the body
    numpy, assign = wp.array.numpy, wp.array.assign
    moved = []
    monkeypatch.setattr(wp.array, "numpy", lambda array: (moved.append(len(array)), numpy(array))[1])
    monkeypatch.setattr(wp.array, "assign", lambda array, given: (moved.append(len(array)), assign(array, given))[1])
    for k in range(3):
        body.prescribe(top, velocity=[0.0, 0.0, 0.1 * k])
        body.prescribe(top, times=[0.0, 1.0], displacements=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.01 * k]])
        body.load(top, [0.0, 0.0, 1e-3 * k])
        body.release(top)
        body.fix(top)
    assert max(moved, default=0) <= len(top) < body.node_count / 4
    monkeypatch.undo()
    body.constrained  # noqa: B018 (it reads all nodes, which the count would have shown)
    assert body.constrained[top].all()


def test_a_hand_that_drags_leaves_recorded_steps_as_they_are(device):
    """Other velocities, loads and keyframes of the same patch are other values in the same launches."""
    sim = bar(device)
    body, top = sim.body, top_of(sim)
    body.load(top, [0.0, 0.0, 0.0])
    body.prescribe(top, times=[0.0, 1.0], displacements=np.zeros((2, 3)))
    sim.advance(0.01)
    revision = body.launch_revision
    for k in range(1, 4):
        there = np.array([0.0, 0.0, 1e-3 * k])
        body.load(top, [1e-3 * k, 0.0, 0.0])
        body.prescribe(
            top, times=[sim.time, sim.time + 0.01], displacements=[body.displacements.numpy()[top[0]], there]
        )
        sim.advance(0.012)
        np.testing.assert_allclose(body.displacements.numpy()[top], np.tile(there, (len(top), 1)), atol=1e-7)
    assert body.launch_revision == revision
    body.prescribe(top[:-1], velocity=[0.0, 0.0, 0.0])
    assert body.launch_revision > revision
    assert [t.host_numbers.tolist() for t in body.conditions.trajectories] == [[top[-1]]]


def test_a_released_node_has_its_former_mass(device):
    sim = bar(device)
    before = sim.body.node_inverse_mass.numpy().copy()
    top = top_of(sim)
    sim.body.fix(top)
    assert not sim.body.node_inverse_mass.numpy()[top].any()
    sim.body.release(top)
    np.testing.assert_array_equal(sim.body.node_inverse_mass.numpy(), before)
    held = sim.body.constrained
    expected = np.where(held, 0.0, 1.0 / sim.body.masses)
    np.testing.assert_allclose(before, expected, rtol=2e-7)


def test_remeshed_bodies_are_held_where_their_pools_are(device):
    remesh = wc.OnlineRemesh(refine_above=1.01, simplify_below=1.0, max_level=7, every=4)
    sim = bar(device, remesh=remesh)
    sim.body.prescribe(top_of(sim), velocity=[0.0, 0.0, 0.5])
    sim.advance(0.02)
    body = sim.body
    top = np.flatnonzero(body.mesh.points[:, 2] > 0.2 - 1e-9)
    assert body.constrained[top].all()
    body.release(top)
    assert not body.constrained[top].any()
    assert (body.node_inverse_mass.numpy()[top] > 0).all()
    sim.advance(0.01)
    assert np.isfinite(body.positions.numpy()).all()
