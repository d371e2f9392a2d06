"""Contact sleeps while nothing is near, and wakes in time: steps are those of contact that is always awake."""

from itertools import pairwise

import numpy as np
import pytest

import warp_corot as wc

SOFT = wc.Isotropic(2e4, 0.4, 1000.0)
DT = 2e-4


def cube(device, *, low=0.0, worlds=1, speed=0.0, level=3):
    body = wc.SoftBody(
        wc.TetForest.box((1, 1, 1), 0.04, level, origin=(-0.02, -0.02, low)), SOFT, device=device, worlds=worlds
    )
    velocities = body.velocities.numpy()
    velocities[:] = (0.0, 0.0, -speed)
    body.velocities.assign(velocities)
    return body


def simulation(bodies, *, awake=False, gravity=(0.0, 0.0, 0.0), **options):
    sim = wc.Simulation(bodies, gravity=gravity, integrator=wc.SymplecticEuler(dt=DT, viscosity=5e-4), **options)
    if sim.contact.sleep is None and sim.contact.approach is None:
        pytest.skip("this device cannot leave out contact")
    if awake:
        sim.contact.sleep = sim.contact.approach = None
    return sim


def sleeps(sim):
    return int(sim.contact.search.watch.awake.numpy()[0]) == 0


def moved(sim):
    return np.concatenate([body.displacements.numpy().reshape(-1, 3).astype(float) for body in sim.bodies])


def test_far_obstacles_change_nothing(device):
    """Not a single digit; nor do they cost searches. On CUDA one block makes the steps without contact, in another
    order."""
    swinging = []
    for obstacles in ([], [wc.Ground(offset=-0.3), wc.Sphere(0.05, position=(0.5, 0.0, 0.0))]):
        body = cube(device)
        body.fix("z < 1e-6")
        sim = wc.Simulation(body, obstacles=obstacles, integrator=wc.SymplecticEuler(dt=DT), gravity=(2.0, 0.0, -9.81))
        sim.advance_steps(300)
        swinging.append(moved(sim))
    assert np.abs(swinging[0]).max() > 1e-4
    rounding = 0.0 if device == "cpu" else 1e-5 * np.abs(swinging[0]).max()
    np.testing.assert_allclose(*swinging, rtol=0.0, atol=rounding)
    assert sleeps(sim)
    assert sim.contact.search.count <= 2


@pytest.mark.parametrize("kind", ["ground", "mesh", "grid"])
def test_a_thrown_body_lands_as_without_sleep(device, kind):
    """At 4 m/s, 0.8 mm a step, onto each kind of distance."""
    points = np.array([(x, y, z) for x in (-0.1, 0.1) for y in (-0.1, 0.1) for z in (-0.04, 0.0)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    faces = np.array([(a, b, c) for a, *others in sides for b, c in pairwise(others)])

    def slab(x):
        return (np.abs(x - (0.0, 0.0, -0.02)) - (0.1, 0.1, 0.02)).max(axis=-1)

    obstacle = {
        "ground": lambda: wc.Ground(),
        "mesh": lambda: wc.TriangleMesh(points, faces),
        "grid": lambda: wc.SignedDistance(slab, (-0.13, -0.13, -0.06), upper=(0.13, 0.13, 0.02), resolution=27),
    }[kind]
    landed = []
    for awake in (False, True):
        sim = simulation(cube(device, low=0.2, speed=4.0), awake=awake, obstacles=obstacle())
        sim.advance_steps(20)
        assert sleeps(sim) == (not awake)
        sim.advance_steps(380)
        landed.append((moved(sim), sim.body.velocities.numpy()[..., 2].mean()))
    (slept, up), (felt, _) = landed
    assert up > 0.5, "it bounces"
    np.testing.assert_allclose(slept, felt, rtol=0.0, atol=1e-4 * np.abs(felt).max())


def test_a_tool_wakes_contact(device):
    """A tool that stood still for long is sent through a body that never moved."""
    pushed = []
    for awake in (False, True):
        tool = wc.Tool(wc.Sphere(0.01, position=(0.2, 0.0, 0.02)), speed=3.0)
        sim = simulation(cube(device), awake=awake, obstacles=tool)
        sim.advance_steps(50)
        assert sleeps(sim) == (not awake)
        tool.move((0.0, 0.0, 0.02))
        sim.advance_steps(400)
        pushed.append(moved(sim))
    assert pushed[0][:, 0].mean() < -5e-3
    np.testing.assert_allclose(*pushed, rtol=0.0, atol=1e-4 * np.abs(pushed[1]).max())


def test_a_body_that_is_moved_by_hand_wakes_contact(device):
    """Beside an obstacle that it never came near to by itself; moving it there is no fault."""
    sim = simulation(cube(device, low=0.2), obstacles=wc.Ground())
    sim.advance_steps(20)
    assert sleeps(sim)
    positions = sim.body.positions.numpy()
    positions[..., 2] -= 0.1999
    sim.body.positions.assign(positions)
    velocities = sim.body.velocities.numpy()
    velocities[..., 2] = -0.5
    sim.body.velocities.assign(velocities)
    sim.advance_steps(20)
    assert not sleeps(sim)
    assert not sim.contact.search.has_missed
    assert sim.body.positions.numpy()[..., 2].min() > -1e-5


def test_each_world_wakes_contact(device):
    """In one of two worlds the body falls; the other one hangs."""
    body = cube(device, low=0.03, worlds=2)
    velocities = body.velocities.numpy().reshape(2, -1, 3)
    velocities[1] = (0.0, 0.0, -1.0)
    body.velocities.assign(velocities.reshape((*body.velocities.shape, 3)))
    sim = simulation(body, obstacles=wc.Ground())
    sim.advance_steps(5)
    assert sleeps(sim)
    sim.advance_steps(300)
    heights = sim.body.positions.numpy().reshape(2, -1, 3)[..., 2]
    assert heights[1].min() > -1e-5
    assert sim.body.velocities.numpy().reshape(2, -1, 3)[1, :, 2].mean() > 0.1
    np.testing.assert_allclose(heights[0].min(), 0.03, atol=1e-6)


@pytest.mark.parametrize("itself", [False, True])
def test_soft_bodies_that_are_apart_sleep_until_they_meet(device, itself):
    met = []
    for awake in (False, True):
        bodies = [cube(device), cube(device, low=0.08, speed=2.0)]
        bodies[0].fix("z < 1e-6")
        sim = simulation(bodies, awake=awake, contact=wc.Contact(self_contact=itself))
        sim.advance_steps(30)
        # So few elements are all near one another where searches are for all of them.
        assert sleeps(sim) == (not awake and (not itself or sim.contact.approach is not None))
        sim.advance_steps(220)
        met.append(moved(sim))
    assert np.abs(met[0][: len(met[0]) // 2]).max() > 1e-3, "the upper one hits the lower one"
    np.testing.assert_allclose(*met, rtol=0.0, atol=1e-3 * np.abs(met[1]).max())
