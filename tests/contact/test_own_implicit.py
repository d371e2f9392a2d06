"""Contact on the surface of an organ in implicit steps and static answers."""

import numpy as np
import pytest
import warp as wp
from organs import BALL, SOFT, ball_mesh, brick_mesh, crossing, fork_mesh, ground
from soft_blocks import DOWN, force_on, weight

import warp_corot as wc
from warp_corot.experiments.half_spaces import (
    CONTACT,
    DEPTH,
    FORCE,
    HALF,
    POISSON,
    RADIUS,
    YOUNG,
    boussinesq,
)

STEP = 0.01
EULER = wc.BackwardEuler(dt=STEP)


@pytest.fixture(scope="module")
def ball():
    return ball_mesh()


@pytest.fixture(scope="module")
def brick():
    return brick_mesh()


def lowest(body):
    return body.contact_surface.moved(body.displacements.numpy())[:, 2].min()


@pytest.mark.parametrize(
    "integrator", [EULER, wc.BDF2(dt=STEP), wc.BackwardEuler(dt=STEP, tolerance=1e-4)], ids=["one", "BDF2", "Newton"]
)
def test_an_organ_rests_on_its_surface(brick, device, integrator):
    """It falls by 0.5 mm."""
    body, below = wc.SoftBody(brick, SOFT, device=device), ground(-0.0075)
    sim = wc.Simulation(body, obstacles=below, integrator=integrator, gravity=DOWN)
    assert sim.contact.surface.is_borne
    sim.advance_steps(60)
    assert force_on(below)[2] == pytest.approx(-weight(body), rel=1e-3)
    assert abs(lowest(body) + 0.0075) < 2e-5
    felt = body.contact_forces.numpy().astype(float).sum(axis=0)
    np.testing.assert_allclose(felt, -force_on(below), atol=1e-5 * weight(body))
    np.testing.assert_allclose(sum(point.force for point in sim.contacts()), felt, atol=1e-5 * weight(body))
    before = sim.solves.linear_iterations
    sim.advance_steps(5)
    # An iteration of an assembled solve costs a fifth of one with multigrid, which takes less than 8 a step here.
    assert sim.solves.linear_iterations - before < 5 * 20


@pytest.mark.parametrize("share", [0.99, 1.01, 1.05])
def test_an_organ_slips_at_the_angle_of_friction(brick, device, share):
    """Friction pulls places at its edge off the slope; then they have no friction, and come back."""
    friction, body = 0.5, wc.SoftBody(brick, SOFT, device=device)
    angle = share * np.arctan(friction)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    contact = wc.Contact(friction=friction)
    sim = wc.Simulation(body, obstacles=ground(-0.007), integrator=EULER, contact=contact, gravity=gravity)
    sim.advance_steps(30)
    x, v = (array.numpy()[:, 0].astype(float).mean() for array in (body.positions, body.velocities))
    before = sim.solves.linear_iterations
    sim.advance_steps(30)
    # Less than 10 with multigrid; the sweeps of the CPU take fewer than CUDA's inverses of blocks (42 at 1.01).
    assert sim.solves.linear_iterations - before < 30 * (50 if wp.get_device(device).is_cuda else 40)
    if share < 1.0:
        assert abs(body.positions.numpy()[:, 0].mean() - x) < 1e-6
    else:
        gained = body.velocities.numpy()[:, 0].astype(float).mean() - v
        assert gained / (30 * STEP) == pytest.approx(gravity[0] + friction * gravity[2], rel=0.01)


def pressed(mesh, device, integrator):
    """The force on a plate that flattens a ball by 3 mm, and displacements."""
    body = wc.SoftBody(mesh, SOFT, device=device)
    body.fix("z < -0.012")
    probe = wc.Tool(wc.Box((0.1, 0.1, 0.02)))
    probe.follow([0.0, 0.1], [(0.0, 0.0, BALL + 0.0101), (0.0, 0.0, BALL + 0.007)])
    contact = wc.Contact(friction=0.0)
    sim = wc.Simulation(body, obstacles=probe, contact=contact, integrator=integrator, gravity=(0, 0, 0))
    sim.advance(0.3)
    return force_on(probe), body.displacements.numpy()


def test_forces_at_rest_are_those_of_explicit_steps(ball, device):
    felt, moved = pressed(ball, device, wc.BackwardEuler(dt=0.02))
    explicit, there = pressed(ball, device, wc.SymplecticEuler(damping=60.0))
    assert np.linalg.norm(felt - explicit) < 0.01 * np.linalg.norm(explicit)
    assert np.abs(moved - there).max() < 0.02 * np.abs(there).max()


def test_a_static_answer_is_where_steps_come_to_rest(ball, device):
    bodies = [wc.SoftBody(ball, SOFT, device=device) for _ in range(2)]
    for body in bodies:
        body.fix("z > 0.014")
        body.displacements = np.where(body.conditions.held_mask()[:, None], (0.0, 0.0, -1e-3), 0.0)
    below, contact = ground(), wc.Contact(friction=0.0)
    report = wc.solve_static(bodies[0], obstacles=below, contact=contact, gravity=DOWN)
    assert report.converged
    other, integrator = ground(), wc.SymplecticEuler(damping=60.0)
    sim = wc.Simulation(bodies[1], obstacles=other, contact=contact, integrator=integrator, gravity=DOWN)
    sim.advance(0.4)
    assert force_on(below)[2] == pytest.approx(force_on(other)[2], rel=0.01)
    a, b = (body.displacements.numpy() for body in bodies)
    assert np.abs(a - b).max() < 0.02 * np.abs(b).max()


def test_a_static_answer_with_many_places_takes_one_search(device):
    """Forces go on from step to step: the 150 places below a brick come to rest with small gaps."""
    body, below = wc.SoftBody(brick_mesh(3000), SOFT, device=device), ground(-0.007)
    report = wc.solve_static(body, obstacles=below, contact=wc.Contact(friction=0.5), gravity=DOWN)
    assert report.converged
    assert report.iterations < 30
    assert len(report.contacts) > 100
    assert force_on(below)[2] == pytest.approx(-weight(body), rel=1e-4)


@pytest.mark.parametrize("steps", [6, pytest.param(40, marks=pytest.mark.slow)])
def test_two_organs_and_the_ground(brick, device, steps):
    """One falls on the other by 0.2 mm, and comes to rest there."""
    low, high = (wc.SoftBody(brick, SOFT, device=device) for _ in range(2))
    high.displacements = np.tile([0.002, 0.001, 0.0142], (high.node_count, 1))
    below = ground(-0.007)
    sim = wc.Simulation([low, high], obstacles=below, integrator=EULER, gravity=DOWN)
    sim.advance_steps(steps)
    felt, below_felt = (each.contact_forces.numpy().astype(float).sum(axis=0) for each in (high, low))
    np.testing.assert_allclose(felt + below_felt + force_on(below), 0.0, atol=1e-4 * weight(low))
    assert felt[2] > 0.1 * weight(high)
    if steps > 10:
        assert felt[2] == pytest.approx(weight(high), rel=2e-3)
        assert force_on(below)[2] == pytest.approx(-weight(low) - weight(high), rel=2e-3)
    assert {point.other for point in sim.contacts()} <= {low, high, below}
    assert min(point.gap for point in sim.contacts()) > -1e-4
    assert lowest(high) > 0.0065


@pytest.mark.slow
def test_the_prongs_of_a_fork_touch_each_other(device):
    """As in explicit steps; plates of 12 mm may sink in between points by a fifth of half of that."""
    body = wc.SoftBody(fork_mesh(), SOFT, device=device)
    body.fix("z < 0.002")
    plates = [wc.Tool(wc.Box((0.01, 0.04, 0.012), position=(x, 0.0, 0.042)), speed=0.2) for x in (-0.024, 0.024)]
    contact = wc.Contact(friction=0.3, self_contact=True)
    sim = wc.Simulation(body, obstacles=plates, contact=contact, integrator=EULER, gravity=(0, 0, 0))
    for sign, plate in zip((-1, 1), plates, strict=True):
        plate.move((sign * 0.0135, 0.0, 0.042))
    sim.advance_steps(60)
    before = sim.solves.linear_iterations
    sim.advance_steps(10)
    assert sim.solves.linear_iterations - before < 10 * 60
    own = [point for point in sim.contacts() if point.other is body]
    assert own
    assert min(point.gap for point in own) > -1e-4
    assert crossing(body) < 4e-4
    assert -plates[0].wrench.numpy()[0][0] == pytest.approx(plates[1].wrench.numpy()[0][0], rel=0.2)


def test_worlds_resumed_and_remeshed_runs(ball, device, tmp_path):
    """A tool presses harder in each of three worlds; a saved run goes on bit by bit; contact goes on while the mesh
    changes."""
    many = wc.SoftBody(ball, SOFT, worlds=3, device=device)
    probe = wc.Tool(wc.Sphere(0.006, position=(0.0, 0.0, 0.0258)), speed=0.25)
    poses = np.tile(np.float32([0, 0, 0.03, 0, 0, 0, 1]), (3, 1))
    poses[:, 2] = (0.03, 0.0235, 0.0225)
    probe.use_poses(wp.array(poses, dtype=wp.transform, device=device))
    sim = wc.Simulation(many, obstacles=[ground(), probe], integrator=EULER, gravity=DOWN)
    sim.advance_steps(5)
    sim.save(tmp_path / "half.npz")
    sim.advance_steps(3)
    pushed = probe.wrench.numpy()[:, 2]
    assert pushed[0] == 0.0
    assert 0.0 < pushed[1] < pushed[2]
    if not sim.device.is_cuda:
        rest = wc.Simulation.load(tmp_path / "half.npz")
        rest.advance_steps(3)
        np.testing.assert_array_equal(rest.bodies[0].positions.numpy(), many.positions.numpy())

    one = wc.SoftBody(ball, SOFT, device=device)
    probe = wc.Tool(wc.Sphere(0.006))
    probe.follow([0.0, 0.1], [(0.0, 0.0, 0.0262), (0.0, 0.0, 0.022)])
    given = {"obstacles": [ground(), probe], "remesh": wc.OnlineRemesh(2000, every=3, min_level=0), "integrator": EULER}
    sim = wc.Simulation(one, gravity=DOWN, **given)
    sim.advance_steps(12)
    assert len(one.mesh.tets) != len(ball.tets)
    points = sim.contacts()
    assert {point.other for point in points} == set(sim.obstacles)
    assert min(point.gap for point in points) > -1.5e-3


@pytest.mark.parametrize("step", [0.016, STEP])
def test_a_small_stiff_rod_comes_to_rest_and_gains_no_energy(device, step):
    """It falls by less than it goes in a step, so that a solve may end anywhere between flight and rest."""
    length, drop = 0.019, 0.006
    ends = (-0.5 * length, 0.0, 0.0), (0.5 * length, 0.0, 0.0)
    mesh = wc.TetForest.from_domain(wc.Domain.capsule(*ends, 0.07 * length), target_elements=700)
    body, below = (
        wc.SoftBody(mesh, wc.Isotropic(3e4, 0.04, 1300.0), device=device),
        ground(mesh.points[:, 2].min() - drop),
    )
    contact = wc.Contact(friction=1.0)
    sim = wc.Simulation(body, obstacles=below, contact=contact, integrator=wc.BackwardEuler(dt=step), gravity=DOWN)
    least = np.inf
    while sim.time < 0.3:
        sim.step()
        total = sim.energy().total
        assert total < least + 0.01 * weight(body) * drop
        least = min(least, total)
    assert force_on(below)[2] == pytest.approx(-weight(body), rel=1e-3)


@pytest.mark.parametrize(("finest", "error"), [(12, 0.025), pytest.param(15, 0.035, marks=pytest.mark.slow)])
def test_a_ball_sinks_into_an_embedded_half_space_as_hertz_says(device, finest, error):
    """As in explicit steps, with 2 and 4 elements over the radius of contact."""
    domain = wc.Domain.box((-HALF, -HALF, -HALF), (HALF, HALF, 0.0))
    mesh = wc.TetForest.from_domain(domain, cell_size=0.515 * HALF, max_level=3)
    for level in range(4, finest + 1):
        far = np.linalg.norm(mesh.points[mesh.tets].mean(axis=1), axis=1)
        size = 0.5 * HALF * 0.5 ** (level // 3)
        mesh = mesh.refine(np.flatnonzero((mesh.levels < level) & (far < max(1.5 * CONTACT, 3.0 * size))))
    x = mesh.points
    edge = np.flatnonzero((np.abs(x[:, :2]).max(axis=1) > HALF - 1e-3) | (x[:, 2] < -HALF + 1e-3))
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device=device)
    body.prescribe(edge, times=[0.0, 0.1], displacements=np.stack([0.0 * x[edge], boussinesq(x[edge])]))
    tool = wc.Tool(wc.Sphere(RADIUS))
    tool.follow([0.0, 0.1], [(0.0, 0.0, RADIUS), (0.0, 0.0, RADIUS - DEPTH)])
    given = {"contact": wc.Contact(friction=0.0), "gravity": (0.0, 0.0, 0.0)}
    sim = wc.Simulation(body, obstacles=[tool], integrator=wc.BackwardEuler(dt=0.02), **given)
    sim.advance(0.3)
    assert tool.wrench.numpy()[0, 2] == pytest.approx(FORCE, rel=error)
