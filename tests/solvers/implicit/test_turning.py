"""Bodies that turn by large angles in a step with one linearisation."""

import numpy as np
import pytest

import warp_corot as wc

STEP, TURN = 0.01, 0.3  # [s], and rad in a step
SCENES = {
    "alone": {},
    "an obstacle far away": {"obstacles": [wc.Ground((0.0, 0.0, 1.0), -1.0)]},
    "soft surfaces": {"contact": wc.Contact(self_contact=True)},
}


def spinning(device, model, scene, worlds=1, **options):
    """A stiff block that spins freely about an axis that is none of its own."""
    mesh = wc.TetForest.box((2, 1, 1), 0.02, level=4)
    body = wc.SoftBody(mesh, wc.Isotropic(1e6, 0.4, 1000.0), worlds=worlds, device=device)
    axis = np.array([0.6, 0.0, 0.8])
    arms = mesh.points - mesh.points.mean(axis=0)
    body.velocities = np.tile(np.cross(TURN / STEP * axis, arms), (worlds, 1)).astype(np.float32)
    sim = wc.Simulation(
        body, model=model, integrator=wc.BackwardEuler(dt=STEP, **options), gravity=(0.0, 0.0, 0.0), **scene
    )
    return body, sim


@pytest.mark.parametrize("scene", SCENES)
@pytest.mark.parametrize("model", [wc.Corotated(), wc.NeoHookean()], ids=["Corotated", "NeoHookean"])
def test_a_stiff_body_that_spins_gains_no_energy_and_keeps_its_size(device, model, scene):
    body, sim = spinning(device, model, SCENES[scene])
    first, longest = sim.energy().total, np.ptp(body.mesh.points @ [1.0, 0.0, 0.0])
    for _ in range(20):
        sim.step()
        energy = sim.energy()
        # Centrifugal forces stretch it by some 1e-4.
        assert energy.total < first * (1.0 + 1e-5)
        assert energy.elastic < 1e-3 * first
    ends = [np.flatnonzero(np.all(body.mesh.points == (x, 0.0, 0.0), axis=1))[0] for x in (0.0, longest)]
    x = body.positions.numpy()
    assert np.linalg.norm(x[ends[1]] - x[ends[0]]) == pytest.approx(longest, rel=1e-3)


@pytest.mark.parametrize("tolerance", [None, 1e-4])
def test_a_turn_has_no_viscosity(device, tolerance):
    _body, sim = spinning(device, None, {}, viscosity=1e-2, tolerance=tolerance)
    totals = [sim.energy().total]
    for _ in range(10):
        sim.step()
        totals.append(sim.energy().total)
    assert np.all(np.diff(totals) < 1e-3 * totals[0])


def test_worlds_with_held_nodes_are_not_turned(device):
    free, loose = spinning(device, None, {}, worlds=2)
    free.fix("x < 1e-9", worlds=[1])
    for _ in range(3):
        loose.step()
    alone, sim = spinning(device, None, {})
    for _ in range(3):
        sim.step()
    x = free.positions.numpy().reshape(2, -1, 3)
    np.testing.assert_allclose(x[0], alone.positions.numpy(), atol=1e-6)
    held = free.mesh.points[:, 0] < 1e-9
    np.testing.assert_array_equal(x[1][held], free.mesh.points[held].astype(np.float32))
