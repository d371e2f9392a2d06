"""Gradients of static answers in contact in float64, against central differences of other answers in float64."""

import numpy as np
import pytest

import warp_corot as wc

GRAVITY = np.array((0.0, -9.81, 0.0))
CONTACT = wc.Contact(friction=0.0)
MESH = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=2)
NORMAL = np.array((0.1, 1.0, 0.0)) / np.hypot(0.1, 1.0)


def ground(by):
    return wc.Ground(NORMAL, -0.02 + NORMAL @ by)


def ball(by):
    return wc.Sphere(0.15, position=np.array((0.032, -0.16, 0.18)) + by)


@pytest.fixture
def gradient(device, rng):
    weights = (rng.normal(size=MESH.points.shape) + 1.0) / len(MESH.points)

    def found(obstacles, poisson=0.4, contact=CONTACT, worlds=1):
        body = wc.SoftBody(MESH, wc.Isotropic(5e3, poisson, 1000.0), device=device, worlds=worlds)
        body.fix(MESH.points[:, 2] == 0.0)
        everywhere = np.tile(weights, (worlds, 1))
        return wc.static_gradient(
            body,
            lambda x: (float(np.sum(everywhere * x.numpy())), everywhere),
            wrt=("poisson", "obstacles", "boundary", "rest"),
            gravity=GRAVITY,
            obstacles=obstacles,
            contact=contact,
            precision="float64",
        )

    found.weights = weights
    return found


@pytest.mark.parametrize("obstacle", [ground, pytest.param(ball, marks=pytest.mark.slow)])
def test_derivatives_are_those_of_other_answers(gradient, obstacle):
    found = gradient(obstacle(np.zeros(3)))
    assert len(found.report.contacts) > 2
    slope = (gradient(obstacle(np.zeros(3)), 0.4001).value - gradient(obstacle(np.zeros(3)), 0.3999).value) / 2e-4
    assert found.poisson == pytest.approx(slope, rel=1e-5)
    for by in 1e-6 * np.eye(3)[:2]:
        slope = (gradient(obstacle(by)).value - gradient(obstacle(-by)).value) / 2e-6
        assert found.obstacles[0] @ by == pytest.approx(1e-6 * slope, abs=1e-14)
    # Who moves floor and clamp together moves everything.
    np.testing.assert_allclose(found.boundary.sum(axis=0) + found.obstacles[0], gradient.weights.sum(axis=0), atol=1e-9)


def test_worlds_and_places_that_friction_holds(gradient):
    floor, contact = wc.Ground((0.0, 1.0, 0.0), -0.02), wc.Contact(friction=2.0)
    one, both = (gradient(floor, contact=contact, worlds=worlds) for worlds in (1, 2))
    np.testing.assert_allclose(one.boundary.sum(axis=0) + one.obstacles[0], gradient.weights.sum(axis=0), atol=1e-9)
    np.testing.assert_allclose(both.obstacles, 2.0 * one.obstacles, atol=1e-5)
    assert np.abs(one.obstacles[0, 2]) > 1e-3


def test_other_shapes_are_refused(gradient):
    with pytest.raises(wc.InputError, match="obstacles must be Ground or Sphere"):
        gradient(wc.Box((0.4, 0.04, 0.4), position=(0.03, -0.04, 0.1)))
