"""Two elastic balls beside the closed form (Johnson, Contact Mechanics, 4.2); ``warp-corot verify`` has a rigid ball, a
cylinder and a punch."""

import numpy as np
import pytest
from half_balls import half_ball

import warp_corot as wc
from warp_corot.experiments.half_spaces import CONTACT, POISSON, RADIUS, YOUNG


@pytest.mark.parametrize("finest", [(12, 9), pytest.param((15, 12), marks=pytest.mark.slow)])
def test_two_elastic_balls_touch_as_hertz_says(device, finest):
    """The meshes do not fit one another: one is turned against the other."""
    radius = 4.0 * RADIUS
    depth = CONTACT**2 / (0.5 * radius)
    force = 4.0 / 3.0 * (0.5 * YOUNG / (1.0 - POISSON**2)) * np.sqrt(0.5 * radius) * depth**1.5
    both = [half_ball(device, level, radius, force, 0.5 * depth, 0.3 * k) for k, level in enumerate(finest)]
    integrator = wc.SymplecticEuler(damping=150.0)
    sim = wc.Simulation(both, contact=wc.Contact(friction=0.0), gravity=(0.0, 0.0, 0.0), integrator=integrator)
    sim.advance(0.3)
    low, high = (body.contact_forces.numpy().astype(float).sum(axis=0) for body in both)
    assert high[2] == pytest.approx(force, rel=0.03)
    np.testing.assert_allclose(low, -high, atol=1e-6 * force)
