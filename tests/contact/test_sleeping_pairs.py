"""Pairs of soft surfaces that are beside one another sleep until they could face each other; nothing depends on it."""

import numpy as np
import pytest

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)


def thrown(device, itself, *, sleeps, together):
    """A block thrown at another one, so that it turns and slides on it."""
    rng = np.random.default_rng(3)
    low = wc.SoftBody(wc.TetForest.box((2, 2, 1), 0.02, 3), SOFT, device=device)
    low.fix("z < 1e-9")
    high = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.02, 3, origin=(0.013, 0.009, 0.0202)), SOFT, device=device)
    x = high.positions.numpy()
    high.velocities = np.cross(rng.uniform(-20.0, 20.0, 3), x - x.mean(axis=0)) + (0.4, 0.1, -0.5)
    sim = wc.Simulation(
        [low, high],
        contact=wc.Contact(self_contact=itself),
        gravity=(0.0, 0.0, -9.81),
        integrator=wc.SymplecticEuler(viscosity=1e-3),
        deterministic=True,
    )
    pairs = sim.contact.pairs
    if not sleeps:
        pairs.stay_awake()
    pairs.together = together
    return sim


@pytest.mark.parametrize("itself", [False, True])
def test_results_do_not_depend_on_sleep_and_launches(device, itself):
    """Also when a body is put elsewhere between runs."""
    sims = [
        thrown(device, itself, sleeps=sleeps, together=together)
        for sleeps, together in ((False, False), (True, False), (True, True))
    ]
    asleep = touching = 0
    for run in range(12):
        for sim in sims:
            if run == 6:
                high = sim.bodies[1]
                high.positions = high.positions.numpy() + np.array([1e-3, -5e-4, 0.0], np.float32)
            sim.advance_steps(20)
        first = sims[0]
        for sim in sims[1:]:
            for body, same in zip(sim.bodies, first.bodies, strict=True):
                np.testing.assert_array_equal(body.positions.numpy(), same.positions.numpy())
        rows = sims[1].contact.pairs.rows
        count = int(rows.total.numpy()[0])
        asleep += int(np.sum(rows.asleep.numpy()[:count] > rows.path.numpy()[0]))
        touching += len(first.contacts())
    assert asleep > 100 and touching > 20
