"""Obstacles that touch bodies between their nodes, in implicit steps."""

import numpy as np
import pytest
from soft_blocks import block, force_on

import warp_corot as wc

EULER = wc.BackwardEuler(dt=0.01)


@pytest.mark.parametrize("integrator", [EULER, wc.BDF2(dt=0.01)], ids=["BackwardEuler", "BDF2"])
def test_a_block_rests_on_two_rods_between_its_nodes(device, integrator):
    """At 0.7 of the angle of friction."""
    mesh = wc.TetForest.box(cells=(4, 1, 1), cell_size=0.01, level=2, origin=(-0.02, -0.005, 0.003))
    body = wc.SoftBody(mesh, wc.Isotropic(young=5e4, poisson=0.3, density=1000.0), device=device)
    along_y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    rods = [wc.Capsule(0.003, 0.05, position=(x, 0.0, 0.0), quaternion=along_y) for x in (-0.0113, 0.0121)]
    angle = 0.7 * np.arctan(0.4)
    gravity = (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))
    sim = wc.Simulation(body, obstacles=rods, contact=wc.Contact(friction=0.4), gravity=gravity, integrator=integrator)
    sim.advance_steps(40)
    before = body.positions.numpy().astype(float)
    sim.advance_steps(10)
    assert np.abs(body.positions.numpy() - before).max() < 2e-6
    weight = body.masses.sum() * np.array(gravity)
    carried = sum(force_on(each) for each in rods)
    np.testing.assert_allclose(carried, weight, atol=2e-3 * np.linalg.norm(weight))
    felt = body.contact_forces.numpy().astype(float).sum(axis=0)
    np.testing.assert_allclose(felt, -carried, atol=1e-4 * np.linalg.norm(weight))
    points = sim.contacts()
    assert any(len(point.nodes) == 3 for point in points)
    np.testing.assert_allclose(sum(point.force for point in points), felt, atol=1e-4 * np.linalg.norm(weight))


def pressed(device, radius, place, integrator=EULER):
    """The force of a ball that presses a block of elements of 5 mm by 0.4 of its radius."""
    body = block(device, level=6)
    body.fix("z == zmin")
    ball = wc.Tool(wc.Sphere(radius))
    x, y, top = *place, 0.02 + radius
    ball.follow([0.0, 0.1], [(x, y, top + 1e-4), (x, y, top - 0.4 * radius)])
    contact = wc.Contact(friction=0.0)
    sim = wc.Simulation(body, obstacles=ball, gravity=(0.0, 0.0, 0.0), contact=contact, integrator=integrator)
    sim.advance(0.15)
    force = force_on(ball)[2]
    assert body.contact_forces.numpy()[:, 2].sum() == pytest.approx(-force, rel=1e-4)
    return force


def test_the_force_of_a_small_ball_hardly_depends_on_the_place(device):
    """A ball of half an element's size, at a node and between nodes, where none touches it."""
    at_node = pressed(device, 0.0025, (0.02, 0.02))
    for place in ((0.0225, 0.0213), (0.0235, 0.0217)):
        assert pressed(device, 0.0025, place) == pytest.approx(at_node, rel=0.05)


def test_a_large_ball_touches_only_nodes(device):
    """Otherwise triangles that are all tangent to it would make the body too stiff: finer meshes give 0.863 N."""
    assert pressed(device, 0.01, (0.0225, 0.0213)) == pytest.approx(0.863, rel=0.02)


@pytest.mark.parametrize("speed", [1.0, 10.0])
def test_a_thin_rod_does_not_pass_between_nodes(device, speed):
    """A body of elements of 10 mm falls onto a rod of 2 mm; it moves by up to 40 mm a step."""
    body = block(device, origin=(-0.0113, -0.0187, 0.002), level=3)
    along_y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    rod = wc.Capsule(0.001, 0.2, quaternion=along_y)
    body.velocities = np.tile([0.0, 0.0, -speed], (body.node_count, 1))
    integrator = wc.BackwardEuler(dt=0.004)
    sim = wc.Simulation(body, obstacles=rod, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    above = np.flatnonzero(np.abs(body.mesh.points[:, 0]) < 0.012)
    for _ in range(6):
        sim.advance_steps(1)
        assert body.positions.numpy()[above, 2].max() > 0.0
        assert any(len(point.nodes) == 3 for point in sim.contacts()) or force_on(rod)[2] == 0.0
    momentum = (body.masses[:, None] * body.velocities.numpy()).sum(axis=0)[2]
    assert momentum > -0.7 * speed * body.masses.sum()
