"""Gradients of implicit runs that touch obstacles, against central differences of other runs."""

import numpy as np
import pytest

import warp_corot as wc

STEPS = 14
GRAVITY = np.array((0.0, -9.81, 0.0))
EULER = wc.BackwardEuler(dt=0.01, tolerance=1e-7, linear_tolerance=1e-7, iterations=40)
CONTACT = wc.Contact(friction=0.0)
MESH = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=2)
HELD = MESH.points[:, 2] == 0.0


def ball(by=(0.0, 0.0, 0.0)):
    """A ball below the free end of a beam, which falls on it in the fifth step."""
    return wc.Sphere(0.15, position=np.array((0.032, -0.16, 0.18)) + by)


def beam(device, young=5e3, poisson=0.4, motion=None, worlds=1):
    body = wc.SoftBody(MESH, wc.Isotropic(young, poisson, 1000.0), device=device, worlds=worlds)
    body.fix(HELD)
    if motion is not None:
        body.velocities = motion
    return body


@pytest.mark.parametrize("all_of_them", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_derivatives_are_those_of_other_runs(device, rng, all_of_them):
    """Nodes begin to touch on the way, the same ones in the other runs."""
    weights = (rng.normal(size=MESH.points.shape) + 1.0) / len(MESH.points)
    motion = np.where(HELD[:, None], 0.0, rng.normal(size=MESH.points.shape) * 0.05)

    def value(by=(0.0, 0.0, 0.0), gravity=GRAVITY, pushed=0.0, **material):
        body = beam(device, motion=pushed * motion, **material)
        sim = wc.Simulation(body, integrator=EULER, gravity=gravity, obstacles=ball(by), contact=CONTACT)
        touched = []
        for _ in range(STEPS):
            sim.step()
            touched.append(len(sim.contacts()))
        assert touched == before
        return np.sum(weights * body.positions.numpy().astype(float))

    before = [0, 0, 0, 0, 3, 3] + [5] * 8
    found = wc.run_gradient(
        beam(device),
        lambda x: (float(np.sum(weights * x.numpy())), weights),
        integrator=EULER,
        steps=STEPS,
        wrt=("young", "poisson", "gravity", "velocities", "obstacles"),
        gravity=GRAVITY,
        obstacles=ball(),
        contact=CONTACT,
    )
    assert found.value == pytest.approx(value(), rel=1e-6)
    assert found.young == pytest.approx((value(young=5050.0) - value(young=4950.0)) / 100.0, rel=2e-3)
    slope = (value(pushed=0.02) - value(pushed=-0.02)) / 0.04
    assert np.sum(found.velocities * motion) == pytest.approx(slope, rel=2e-3)
    for axis in np.eye(3) if all_of_them else np.eye(3)[2:]:
        slope = (value(by=2e-4 * axis) - value(by=-2e-4 * axis)) / 4e-4
        assert found.obstacles[0] @ axis == pytest.approx(slope, abs=1e-3 * np.abs(found.obstacles).max())
    if not all_of_them:
        return
    assert found.poisson == pytest.approx((value(poisson=0.402) - value(poisson=0.398)) / 0.004, rel=2e-3)
    slope = (value(gravity=GRAVITY * 1.005) - value(gravity=GRAVITY * 0.995)) / 0.01
    assert found.gravity @ GRAVITY == pytest.approx(slope, rel=2e-3)


def test_worlds_touch_each_for_itself(device):
    """The same in two worlds as in each of them."""
    given = {"integrator": EULER, "steps": 8, "gravity": GRAVITY, "obstacles": ball(), "contact": CONTACT}

    def objective(x):
        weights = np.zeros((len(x), 3))
        weights[:, 1] = np.tile(MESH.points[:, 2], len(x) // len(MESH.points))
        return float(np.sum(weights * x.numpy())), weights

    each = [
        wc.run_gradient(beam(device, young), objective, wrt=("obstacles", "young"), **given) for young in (4e3, 6e3)
    ]
    both = beam(device, [[4e3], [6e3]], worlds=2)
    found = wc.run_gradient(both, objective, wrt=("obstacles", "young"), **given)
    assert np.abs(found.obstacles[0]).max() > 0.1
    np.testing.assert_allclose(found.obstacles, each[0].obstacles + each[1].obstacles, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(found.young.ravel(), [one.young for one in each], rtol=1e-4)


def test_what_has_no_gradient_is_refused(device):
    body, run = beam(device), {"steps": 8, "gravity": GRAVITY, "integrator": EULER}

    def objective(x):
        return 0.0, np.ones_like(x.numpy())

    for given, words in (
        ({"obstacles": ball()}, "obstacles have friction"),
        ({"obstacles": ball(), "contact": CONTACT, "integrator": wc.BDF2(dt=0.01)}, "need BackwardEuler"),
        ({"contact": wc.Contact(friction=0.0, self_contact=True)}, "with obstacles only"),
        ({"obstacles": wc.Sphere(0.005, position=(0.03, -0.01, 0.15)), "contact": CONTACT}, "between the nodes"),
    ):
        with pytest.raises(wc.InputError, match=words):
            wc.run_gradient(body, objective, **(run | given))
