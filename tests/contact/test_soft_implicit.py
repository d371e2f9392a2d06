"""Soft bodies against one another and against themselves, in implicit steps of 16 ms."""

import numpy as np
import pytest
from half_balls import half_ball
from soft_surfaces import DOWN, block, folded, force_on, roof, weight

import warp_corot as wc
from warp_corot.experiments.half_spaces import CONTACT, POISSON, RADIUS, YOUNG

EULER = wc.BackwardEuler(dt=0.016)


@pytest.mark.parametrize("alike", [True, False], ids=["alike", "unlike"])
def test_a_block_on_a_block_carries_its_weight(device, alike):
    low = block(device, 0.0)
    high = block(device, 0.0202) if alike else block(device, 0.0202, cells=(1, 1, 1), level=4, at=0.011)
    ground = wc.Ground()
    sim = wc.Simulation([low, high], obstacles=ground, gravity=DOWN, integrator=EULER)
    sim.advance_steps(25)
    assert force_on(high)[2] == pytest.approx(weight(high), rel=1e-3)
    on_ground = ground.wrench.numpy()[0].astype(float)[:3]
    assert on_ground[2] == pytest.approx(-weight(high) - weight(low), rel=1e-3)
    np.testing.assert_allclose(force_on(low) + force_on(high) + on_ground, 0.0, atol=1e-5 * weight(low))
    felt = sum(point.force[2] for point in sim.contacts() if point.body is high)
    felt -= sum(point.force[2] for point in sim.contacts() if point.other is high)
    assert felt == pytest.approx(weight(high), rel=1e-3)
    assert high.positions.numpy()[:, 2].min() > 0.0195
    before = sim.solves.linear_iterations
    sim.advance_steps(4)
    # Those of two bodies in four steps; blocks alike take 360 if the friction of the ground is not in the matrix.
    assert (sim.solves.linear_iterations - before) / (4 * 2) < 90


def test_two_elastic_balls_touch_as_hertz_says(device):
    """The meshes do not fit one another: one is turned against the other, as in explicit steps."""
    radius = 4.0 * RADIUS
    depth = CONTACT**2 / (0.5 * radius)
    force = 4.0 / 3.0 * (0.5 * YOUNG / (1.0 - POISSON**2)) * np.sqrt(0.5 * radius) * depth**1.5
    both = [half_ball(device, level, radius, force, 0.5 * depth, 0.3 * k) for k, level in enumerate((12, 9))]
    contact, integrator = wc.Contact(friction=0.0), wc.BackwardEuler(dt=0.02)
    sim = wc.Simulation(both, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    sim.advance_steps(12)
    low, high = (body.contact_forces.numpy().astype(float).sum(axis=0) for body in both)
    assert high[2] == pytest.approx(force, rel=0.03)
    np.testing.assert_allclose(low, -high, atol=1e-6 * force)


def test_a_moving_plate_does_not_sink_into_the_upper_block(device):
    """It moves by 0.4 mm in each step."""
    low, high = block(device, 0.0), block(device, 0.0201)
    low.fix("z == zmin")
    top = float(high.positions.numpy()[:, 2].max()) + 0.0101
    plate = wc.Tool(wc.Box((0.1, 0.1, 0.02), position=(0.02, 0.02, top)))
    plate.follow([0.0, 0.16], [(0.02, 0.02, top), (0.02, 0.02, top - 0.004)])
    sim = wc.Simulation([low, high], obstacles=plate, gravity=(0.0, 0.0, 0.0), integrator=EULER)
    sim.advance_steps(5)
    above = sim.contact.obstacles.poses()[0, 0, 2] - 0.01 - high.positions.numpy()[:, 2].max()
    assert plate.wrench.numpy()[0, 2] > 0.1
    assert abs(above) < 1e-6


@pytest.mark.parametrize("speed", [1.0, 5.0])
def test_nothing_passes(device, speed):
    """A block that moves by up to four times its own height in a step falls on another one of the same height."""
    low, high = block(device, 0.0), block(device, 0.05, cells=(1, 1, 1), level=4, at=0.011)
    low.fix("z == zmin")
    high.velocities = np.tile((0.0, 0.0, -speed), (high.node_count, 1))
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=DOWN, integrator=EULER)
    for _ in range(6):
        sim.advance_steps(2)
        assert high.positions.numpy()[:, 2].min() > 0.012
        assert high.positions.numpy()[:, 2].mean() > low.positions.numpy()[:, 2].max()
        np.testing.assert_allclose(force_on(high)[:2], 0.0, atol=0.5 * max(force_on(high)[2], weight(high)))


@pytest.mark.parametrize("speed", [0.2, 3.0])
def test_an_edge_does_not_pass_an_edge(device, speed):
    low = roof(device, 0, 0.0)
    top = np.sqrt(2.0) * 0.01
    high = roof(device, 1, top + 0.0005)
    moved = high.positions.numpy()
    moved[:, :2] += 0.0017
    high.positions = moved
    low.fix("z < zmin + 0.003")
    high.velocities = np.tile((0.0, 0.0, -speed), (high.node_count, 1))
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=(0.0, 0.0, 0.0), integrator=wc.BackwardEuler(0.004))
    touched, edges = 0.0, 0
    for _ in range(5):
        sim.advance_steps(1)
        touched = max(touched, force_on(high)[2])
        edges += sum(len(point.nodes) == 2 for point in sim.contacts())
        np.testing.assert_allclose(force_on(low) + force_on(high), 0.0, atol=1e-5 * (touched + 1e-3))
    assert touched > 0.0
    assert edges > 0
    crossing = [
        np.linalg.norm((each.mesh.points - each.mesh.points.mean(axis=0)), axis=1) < 0.006 for each in (low, high)
    ]
    heights = [each.positions.numpy()[near, 2].mean() for each, near in zip((low, high), crossing, strict=True)]
    assert heights[1] - heights[0] > 0.5 * top


def test_a_soft_block_rests_on_a_soft_slope(device):
    """At 0.95 of the angle of friction, on a mesh that differs from its own."""
    angle = 0.95 * np.arctan(0.4)
    low, high = block(device, 0.0), block(device, 0.0200005, cells=(1, 1, 1), at=0.0107)
    low.fix("z == zmin")
    gravity = (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))
    sim = wc.Simulation([low, high], contact=wc.Contact(friction=0.4), gravity=gravity, integrator=EULER)
    sim.advance_steps(30)
    before = high.positions.numpy().astype(float)
    sim.advance_steps(30)
    assert np.abs(high.positions.numpy() - before).max() < 2e-6
    along = force_on(high)[0] / force_on(high)[2]
    assert along == pytest.approx(-np.tan(angle), rel=2e-3)


@pytest.mark.parametrize("itself", [True, False])
def test_a_folded_body_touches_itself(device, itself):
    """Without contact its arms would cross."""
    sim, _held, crossing = folded(device, EULER, itself=itself)
    sim.advance_steps(12)
    if itself:
        assert crossing() < 2e-5
        np.testing.assert_allclose(force_on(sim.body), 0.0, atol=1e-5)
        assert np.abs(sim.body.contact_forces.numpy()).max() > 1e-3
    else:
        assert crossing() > 1e-3


@pytest.mark.parametrize("seed", [24, 55])
def test_rims_that_meet_do_not_pass(device, seed):
    """The corners of the arms meet rim on rim. Rounding decides which faces each is next to, so the body is shaken by
    0.1 um before each step."""
    sim, held, crossing = folded(device, EULER)
    rng = np.random.default_rng(seed)
    free = np.setdiff1d(np.arange(sim.body.node_count), held)
    for _ in range(12):
        shaken = sim.body.displacements.numpy().copy()
        shaken[free] += rng.normal(scale=1e-7, size=(len(free), 3))
        sim.body.displacements = shaken
        sim.advance_steps(1)
    assert crossing() < 1e-5


def test_worlds_and_saved_runs(device, tmp_path):
    """Blocks of several worlds are in the same place and do not meet; a loaded run continues bit for bit."""
    low, high = (block(device, z, cells=(1, 1, 1), worlds=2) for z in (0.0, 0.0202))
    low.fix("z == zmin")
    lifted = high.positions.numpy()
    lifted[high.world_node_count :, 2] += 0.1
    high.positions = lifted
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=DOWN, integrator=EULER)
    sim.advance_steps(4)
    forces = high.contact_forces.numpy().reshape(2, -1, 3)
    assert forces[0, :, 2].sum() > 0.0
    assert not forces[1].any()
    sim.save(tmp_path / "state.npz")
    sim.advance_steps(3)
    later = wc.Simulation.load(tmp_path / "state.npz")
    later.advance_steps(3)
    error = np.abs(later.bodies[1].displacements.numpy() - high.displacements.numpy()).max()
    assert error <= (0.0 if high.device.is_cpu else 1e-6)


def test_the_sides_of_a_slit_meet_as_two_bodies_do(device):
    """A slit of 0.2 mm in one body is closed by 1 mm: its sides are nearer at rest than they overlap in a step."""
    low = wc.TetForest.box((1, 1, 1), 0.02, 3)
    high = wc.TetForest.box((1, 1, 1), 0.015, 4, origin=(0.0021, 0.0033, 0.0202))
    points = np.concatenate([low.points, high.points])
    top = points[:, 2] > points[:, 2].max() - 1e-9
    moved = np.where(top[:, None], [0.0, 0.0, -1e-3], 0.0)
    both = wc.TetMesh(points, np.concatenate([low.tets, high.tets + len(low.points)]))
    split = [len(low.points)]
    found = []
    for meshes in ([both], [low, high]):
        bodies = [wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device) for mesh in meshes]
        parts = [slice(None)] if len(meshes) == 1 else [slice(None, *split), slice(*split, None)]
        for body, part in zip(bodies, parts, strict=True):
            body.displacements = moved[part]
            body.fix(top[part] | (points[part][:, 2] < 1e-9))
        contact = wc.Contact(friction=0.0, self_contact=len(meshes) == 1)
        sim = wc.Simulation(bodies, gravity=(0.0, 0.0, 0.0), contact=contact, integrator=wc.BackwardEuler(dt=1e-3))
        sim.advance_steps(10)
        found.append(np.concatenate([body.positions.numpy() for body in bodies]))
    assert found[1][split[0] :, 2].min() < 0.0199
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=2e-5)


def test_coarse_bodies_that_fall_on_one_another_are_solved_for():
    """Their contacts lie at edges of coarse, round surfaces. Found again after each solve, they changed for ever."""
    size = 0.317
    shape = wc.Domain.sphere(size / 3.0) | wc.Domain.sphere(size / 5.0, (0.0, 0.0, 0.45 * size))
    mesh = wc.TetForest.from_domain(shape, target_elements=270)
    low, high = (wc.SoftBody(mesh, wc.Isotropic(young=2.57e5, poisson=0.17, density=376.0)) for _ in range(2))
    height = float(np.ptp(mesh.points[:, 2]))
    for k, body in enumerate((low, high)):
        way = [0.05 * size * k, 0.03 * size * k, 1.02 * height * k - mesh.points[:, 2].min()]
        body.displacements = np.tile(way, (len(mesh.points), 1)).astype(np.float32)
    contact = wc.Contact(friction=0.2, on="tetrahedra")
    sim = wc.Simulation([low, high], obstacles=wc.Ground(), contact=contact, gravity=DOWN, integrator=EULER)
    sim.advance_steps(8)
    assert force_on(high)[2] > 0.1 * weight(high)
    assert sim.solves.unfinished == 0


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.3, 1.0])
def test_an_organ_that_slides_fast_loses_the_speed_that_friction_takes(device, speed):
    """It goes by one to three elements in each step of 10 ms."""
    lower = wc.TetForest.from_domain(
        wc.Domain.box((-0.03, -0.024, -0.0071), (0.2, 0.023, 0.0069)), target_elements=2500
    )
    upper = wc.TetForest.from_domain(
        wc.Domain.box((-0.011, -0.014, 0.0071), (0.015, 0.008, 0.0181)), target_elements=900
    )
    low, high = (wc.SoftBody(mesh, wc.Isotropic(1e5, 0.45, 1000.0), device=device) for mesh in (lower, upper))
    low.fix(lower.points[:, 2] < -0.0065)
    friction, gravity, step = 0.3, 9.81, 0.01
    contact, integrator = wc.Contact(friction=friction), wc.BackwardEuler(dt=step)
    sim = wc.Simulation([low, high], contact=contact, gravity=(0.0, 0.0, -gravity), integrator=integrator)
    sim.advance_steps(5)
    begin = high.velocities.numpy()
    begin[:, 0] += speed
    high.velocities = begin
    steps = 5 if speed < 0.5 else 12
    sim.advance_steps(steps)
    lost = speed - float(high.velocities.numpy()[:, 0].astype(float) @ high.masses / high.masses.sum())
    assert lost == pytest.approx(friction * gravity * steps * step, rel=0.05)


def test_bodies_that_fall_together_have_no_more_pairs_than_at_rest(device):
    """Steps of 16 ms, in which they go by 32 mm, more than their height: the search follows the expected way."""
    found = []
    for speed in (0.0, 2.0):
        bodies = [block(device, 0.0), block(device, 0.0203, at=0.003)]
        for body in bodies:
            body.velocities = np.tile((0.0, 0.0, -speed), (body.node_count, 1))
        sim = wc.Simulation(bodies, contact=wc.Contact(), gravity=(0.0, 0.0, 0.0), integrator=EULER)
        sim.advance_steps(3)
        found.append(int(sim.contact.pairs.rows.total.numpy()[0]))
    assert found[0] == found[1] > 0
