"""Where something is near in most runs, steps on CUDA do not ask whether contact may sleep; results are the same."""

import numpy as np

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)


def falling(device, persistent):
    """A block that falls on another one and bounces."""
    low = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.02, 2), SOFT, device=device)
    low.fix("z < 1e-9")
    high = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.02, 2, origin=(0.003, 0.002, 0.05)), SOFT, device=device)
    high.velocities = np.tile((0.0, 0.0, -1.5), (high.node_count, 1))
    sim = wc.Simulation([low, high], contact=wc.Contact(), deterministic=True)
    sim.contact.persistent = persistent
    return sim


def test_results_do_not_depend_on_whether_steps_ask(device):
    asked, sims = set(), [falling(device, persistent) for persistent in (None, 2)]
    for _ in range(40):
        for sim in sims:
            sim.advance_steps(10)
        asked.add(sims[1].contact.asks)
        for one, other in zip(*(sim.bodies for sim in sims), strict=True):
            np.testing.assert_array_equal(one.positions.numpy(), other.positions.numpy())
    # It slept, was awake all the time, and slept again.
    assert asked == {True, False}
    assert sims[1].contact.asks
    assert sims[0].contact.asks
