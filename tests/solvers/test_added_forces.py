"""Forces besides elasticity: their work counts in the balance of energy, and their stiffness in the step."""

import numpy as np
import pytest
import warp as wp

import warp_corot as wc


@wp.kernel
def pull_home(stiffness: float, mass: wp.array[wp.float32], u: wp.array[wp.vec4], f: wp.array[wp.vec4]):
    i = wp.tid()
    f[i] = f[i] - stiffness * mass[i] * u[i]


class Springs:
    """Pull every node to its rest position [1/s^2, for each kilogram of its mass]."""

    def __init__(self, body, curvature, *, says_so=True):
        self.body, self.stiffness = body, curvature
        if says_so:
            self.curvature = curvature

    def add_forces(self):
        state = self.body.state
        inputs = [self.stiffness, self.body.conditions.mass, state.displacements]
        wp.launch(pull_home, self.body.sizes.launch_nodes, inputs, [state.forces], device=self.body.device)


def block(device, worlds=1):
    mesh = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.05, level=3)
    return wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device, worlds=worlds)


@pytest.mark.parametrize("worlds", [1, 2])
def test_a_spring_that_gives_energy_back_is_no_error(device, worlds):
    """A body bounces on springs like on a single one: its height is g / w^2 (1 - cos w t), with the same steps as
    without them."""
    body = block(device, worlds)
    sim = wc.Simulation(body)
    longest, w2 = sim.dt, 100.0
    sim.add_forces(Springs(body, w2))
    for _ in range(5):
        sim.advance(0.2)
        heights = body.displacements.numpy()[:, 1].astype(float)
        expected = -9.81 / w2 * (1.0 - np.cos(np.sqrt(w2) * sim.time))
        # Of first order: velocities are half a step behind from the start.
        off = 0.6 * longest * 9.81 / np.sqrt(w2)
        assert (body.masses @ heights) / body.masses.sum() == pytest.approx(expected, abs=off)
    assert sim.dt_range[0] > 0.9 * longest
    assert sim.guard.gain < 1e-3


def test_a_stiff_spring_shortens_the_step(device):
    body = block(device)
    sim = wc.Simulation(body)
    before = sim.stable_dt
    curvature = 12.0 / before**2  # that of the body is 4 / dt^2
    sim.add_forces(Springs(body, curvature))
    assert sim.stable_dt == pytest.approx(0.5 * before, rel=1e-6)
    assert sim.dt < 0.5 * before
    sim.advance(0.05)
    # It swings about the depth g / w^2 at which the springs bear it, by up to twice as much: steps of w dt = sqrt(3)
    # swing 1 / sqrt(1 - (w dt)^2 / 4) times as far as short ones.
    assert np.abs(body.displacements.numpy()).max() < 3.0 * 9.81 / curvature


def test_invalid_forces_are_refused(device):
    sim = wc.Simulation(block(device))
    with pytest.raises(wc.InputError, match="add_forces"):
        sim.add_forces(3.0)
    with pytest.raises(wc.InputError, match="curvature"):
        sim.add_forces(Springs(sim.body, -1.0))
