"""Contact on the surface of an organ, which lies inside the tetrahedra that carry it."""

import numpy as np
import pytest
import warp as wp
from organs import BALL, SOFT, ball_mesh, brick_mesh, crossing, fork_mesh, ground

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

AXIS = (0.5, 0.5, 0.5, 0.5)


@pytest.fixture(scope="module")
def ball():
    return ball_mesh()


@pytest.fixture(scope="module")
def brick():
    return brick_mesh()


def momenta(body):
    """Momentum and angular momentum."""
    p = body.masses[:, None] * body.velocities.numpy().astype(float)
    return np.array([p.sum(axis=0), np.cross(body.positions.numpy().astype(float), p).sum(axis=0)])


@pytest.mark.parametrize(("on", "apart"), [("surface", 2e-4), ("tetrahedra", None)])
def test_bodies_touch_where_their_surface_is(ball, device, on, apart):
    body = wc.SoftBody(ball, SOFT, device=device)
    body.fix("z < -0.012")
    lowest = BALL if apart is None else BALL - apart
    plate = wc.Tool(wc.Box((0.1, 0.1, 0.02), position=(0.0, 0.0, BALL + 0.011)), speed=0.1)
    sim = wc.Simulation(body, obstacles=[plate], contact=wc.Contact(on=on), gravity=(0, 0, 0))
    plate.move((0.0, 0.0, BALL + 0.01 + 1e-4))
    sim.advance(0.02)
    assert (plate.wrench.numpy()[0][2] == 0.0) == (on == "surface")
    plate.move((0.0, 0.0, lowest + 0.01 - 2e-4))
    sim.advance(0.02)
    assert plate.wrench.numpy()[0][2] > 0.0
    if on == "surface":
        assert len(body.contact_surface.points) != len(np.unique(body.surface_triangles))
    else:
        np.testing.assert_array_equal(
            body.contact_surface.points[body.contact_surface.triangles], ball.points[body.surface_triangles]
        )


def test_a_short_step_throws_nothing(brick, device):
    """A run that ends at a given time may end with a step of any length; gaps hardly close in it."""
    body, below = wc.SoftBody(brick, SOFT, device=device), ground(-0.007)
    calm = wc.SymplecticEuler(damping=20.0)
    sim = wc.Simulation(body, obstacles=below, gravity=(0.0, 0.0, -9.81), integrator=calm)
    sim.advance(0.6)
    for _ in range(5):
        for seconds in (2e-7, 2e-3):
            sim.advance(seconds)
            assert -below.wrench.numpy()[0][2] == pytest.approx(9.81 * body.masses.sum(), rel=0.05)
            assert np.abs(body.velocities.numpy()).max() < 0.02


def test_forces_and_torques_on_nodes_are_those_on_tools(ball, device):
    body = wc.SoftBody(ball, SOFT, device=device)
    rod = wc.Tool(wc.Capsule(0.004, 0.03))
    rod.follow([0, 0.02], [(0.002, 0.001, 0.0235), (0.005, 0.003, 0.0205)], [AXIS, AXIS])
    below = ground()
    sim = wc.Simulation(body, obstacles=[below, rod], contact=wc.Contact(friction=0.5), gravity=(0, 0, 0))
    sim.advance(0.018)
    points = sim.contacts()
    assert {point.other for point in points} == {below, rod}
    forces, x = body.contact_forces.numpy().astype(float), body.positions.numpy().astype(float)
    total, torque = forces.sum(axis=0), np.cross(x, forces).sum(axis=0)
    for tool, pose in zip((below, rod), sim.contact.obstacles.poses()[0], strict=True):
        wrench = tool.wrench.numpy()[0].astype(float)
        total += wrench[:3]
        torque += wrench[3:] + np.cross(pose[:3], wrench[:3])
    scale = np.abs(forces).sum()
    assert np.abs(total).max() < 1e-6 * scale
    assert np.abs(torque).max() < 1e-6 * scale * BALL
    np.testing.assert_allclose(sum(point.force for point in points), forces.sum(axis=0), atol=1e-6 * scale)
    for point in points:
        assert point.shares.sum() == pytest.approx(1.0)
        held = np.asarray(point.shares) @ x[list(point.nodes)]
        # Points are those at the beginning of the last step.
        assert np.linalg.norm(held - point.point) < 3e-4


def test_pressure_adds_up_to_the_force(ball, device):
    body = wc.SoftBody(ball, SOFT, device=device)
    below = ground()
    integrator = wc.SymplecticEuler(damping=40.0)
    sim = wc.Simulation(body, obstacles=[below], integrator=integrator, gravity=(0.0, 0.0, -9.81))
    sim.advance(0.5)
    weight = 9.81 * body.masses.sum()
    assert -below.wrench.numpy()[0][2] == pytest.approx(weight, rel=1e-3)
    surface = body.contact_surface
    a, b, c = np.moveaxis(surface.moved(body.displacements.numpy())[surface.triangles], 1, 0)
    areas = 0.5 * np.cross(b - a, c - a)
    carried = -(body.contact_pressure.numpy()[:, None] * areas).sum(axis=0)
    assert carried[2] == pytest.approx(weight, rel=0.02)


def test_work_of_contact_is_in_the_balance_of_energy(ball, device):
    """As ``test_balance.test_all_energy_comes_from_somewhere``, for one length of the steps."""
    body = wc.SoftBody(ball, SOFT, device=device)
    probe = wc.Tool(wc.Sphere(0.01))
    probe.follow([0, 0.02], [(0.003, 0.0, 0.0293), (0.006, 0.001, 0.0275)])
    given = {"obstacles": [ground(), probe], "contact": wc.Contact(friction=0.5), "gravity": (0, 0, 0)}
    dt, steps = 2.5e-5, 500
    sim = wc.Simulation(body, model=wc.Linear(), integrator=wc.SymplecticEuler(dt), **given)
    sim.advance((steps - 1) * dt)
    before, elastic = body.velocities.numpy().astype(float), sim.energy().elastic
    work = sum(float(account.numpy()[0].sum()) for account in sim.system.accounts)
    assert work > 1e-5
    sim.advance(dt)
    assert sim.steps == steps
    mass = body.masses[:, None]
    after, touched = body.velocities.numpy().astype(float), body.contact_forces.numpy().astype(float)
    assert np.any(touched != 0.0)
    others = mass * (after - before) - dt * touched
    energy = 0.5 * np.sum(mass * before**2) + 0.5 * np.sum(before * others) + elastic
    assert energy == pytest.approx(work, rel=1e-5)


@pytest.mark.parametrize("share", [0.99, 1.01])
def test_an_organ_slips_at_the_angle_of_friction(brick, device, share):
    friction, body = 0.5, wc.SoftBody(brick, SOFT, device=device)
    angle = share * np.arctan(friction)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    integrator = wc.SymplecticEuler(viscosity=2e-3)
    contact = wc.Contact(friction=friction)
    sim = wc.Simulation(body, obstacles=[ground(-0.007)], integrator=integrator, contact=contact, gravity=gravity)
    sim.advance(0.3)
    x, v = (array.numpy()[:, 0].astype(float).mean() for array in (body.positions, body.velocities))
    sim.advance(0.3)
    if share < 1.0:
        assert abs(body.positions.numpy()[:, 0].mean() - x) < 1e-7
    else:
        gained = body.velocities.numpy()[:, 0].astype(float).mean() - v
        assert gained / 0.3 == pytest.approx(gravity[0] + friction * gravity[2], rel=0.01)


def test_two_organs_collide(ball, device):
    """They keep their momentum and gain no energy. Forces between them have no torque but that of
    friction across gaps."""
    bodies = [wc.SoftBody(ball, SOFT, device=device) for _ in range(2)]
    other = bodies[1]
    start = np.array([0.01, 0.0, 0.0415])
    other.displacements = np.tile(start, (len(ball.points), 1))
    other.velocities = np.tile([0.0, 0.0, -1.0], (len(ball.points), 1))
    sim = wc.Simulation(bodies, contact=wc.Contact(friction=0.3), gravity=(0, 0, 0))
    before, energy = sum(momenta(body) for body in bodies), sim.energy()
    pushed = 0.0
    for _ in range(10):
        sim.advance(0.004)
        forces = np.concatenate([body.contact_forces.numpy().astype(float) for body in bodies])
        # Forces act where the step begins.
        x = [body.positions.numpy().astype(float) - sim.dt * body.velocities.numpy().astype(float) for body in bodies]
        x = np.concatenate(x)
        push = 0.5 * np.abs(forces).sum()
        assert np.abs(forces.sum(axis=0)).max() <= 1e-6 * push
        torque = np.cross(x, forces).sum(axis=0)
        # Friction acts across gaps that close in the step.
        torque -= sum(np.cross(each.gap * each.normal, each.force) for each in sim.contacts())
        assert np.abs(torque).max() <= 5e-4 * push * BALL
        pushed = max(pushed, push)
    assert pushed > 0.1
    after = sum(momenta(body) for body in bodies)
    assert np.abs(after[0] - before[0]).max() < 1e-5 * np.abs(before[0]).max()
    assert momenta(bodies[0])[0, 2] < 0.3 * before[0, 2]
    now = sim.energy()
    assert now.kinetic + now.elastic < 1.001 * (energy.kinetic + energy.elastic)


def test_the_prongs_of_a_fork_touch_each_other(device):
    """Two plates press them together. The tetrahedra around them would have crossed by 6 mm."""
    body = wc.SoftBody(fork_mesh(), SOFT, device=device)
    body.fix("z < 0.002")
    plates = [wc.Tool(wc.Box((0.01, 0.04, 0.012), position=(x, 0.0, 0.042)), speed=0.2) for x in (-0.024, 0.024)]
    integrator = wc.SymplecticEuler(damping=20.0, viscosity=3e-3)
    contact = wc.Contact(friction=0.3, self_contact=True)
    sim = wc.Simulation(body, obstacles=plates, contact=contact, integrator=integrator, gravity=(0, 0, 0))
    for sign, plate in zip((-1, 1), plates, strict=True):
        plate.move((sign * 0.0135, 0.0, 0.042))
    sim.advance(0.08)
    own = [point for point in sim.contacts() if point.other is body]
    assert own
    assert min(point.gap for point in own) > -1e-4
    assert crossing(body) < 4e-4
    assert -plates[0].wrench.numpy()[0][0] == pytest.approx(plates[1].wrench.numpy()[0][0], rel=0.2)


def test_a_needle_does_not_pass_between_the_points(ball, device):
    body = wc.SoftBody(ball, SOFT, device=device)
    body.fix("z < -0.012")
    up, depth = np.array([0.0013, 0.0007, BALL + 0.0215]), np.array([0.0, 0.0, 0.016])
    needle = wc.Tool(wc.Capsule(1e-3, 0.04))
    needle.follow([0.0, 0.016, 0.02, 0.04], [up, up - depth, up - depth, up + depth])
    integrator = wc.SymplecticEuler(viscosity=1e-3)
    sim = wc.Simulation(body, obstacles=[needle], integrator=integrator, gravity=(0, 0, 0))
    sim.advance(0.016)
    tip = up - depth - (0.0, 0.0, 0.021)
    assert needle.wrench.numpy()[0][2] > 0.1
    points = body.contact_surface.moved(body.displacements.numpy())
    above = points[points[:, 2] > tip[2] + 1e-3]
    assert np.linalg.norm(above[:, :2] - tip[:2], axis=1).min() > 0.9e-3
    sim.advance(0.5)
    assert np.abs(body.displacements.numpy()).max() < 1e-3


def test_a_tool_on_the_edge_of_a_support_throws_nothing(ball, device):
    """Some points are borne by nodes of which only some are free."""
    body = wc.SoftBody(ball, SOFT, device=device)
    body.fix("z < 0.014")
    plate = wc.Tool(wc.Box((0.1, 0.1, 0.02), position=(0.0, 0.0, BALL + 0.0102)), speed=0.1)
    sim = wc.Simulation(body, obstacles=[plate], gravity=(0, 0, 0))
    plate.move((0.0, 0.0, BALL + 0.003))
    fastest = 0.0
    for _ in range(40):
        sim.advance(0.002)
        fastest = max(fastest, float(np.linalg.norm(body.velocities.numpy(), axis=1).max()))
    assert fastest < 2.0


def test_a_resumed_run_goes_on_bit_by_bit(ball, tmp_path):
    def made():
        body = wc.SoftBody(ball, SOFT, device="cpu")  # sums of floats on CUDA have no order
        probe = wc.Tool(wc.Sphere(0.006))
        probe.follow([0.0, 0.03], [(0.0, 0.0, 0.027), (0.002, 0.0, 0.022)])
        contact = wc.Contact(self_contact=True)
        return wc.Simulation(body, obstacles=[ground(), probe], contact=contact, gravity=(0.0, 0.0, -9.81))

    whole = made()
    whole.advance(0.03)
    whole.save(tmp_path / "half.npz")
    whole.advance(0.01)
    rest = wc.Simulation.load(tmp_path / "half.npz")
    rest.advance(0.01)
    assert rest.contact.surface.is_borne
    np.testing.assert_array_equal(rest.bodies[0].positions.numpy(), whole.bodies[0].positions.numpy())
    np.testing.assert_array_equal(rest.obstacles[1].wrench.numpy(), whole.obstacles[1].wrench.numpy())


def test_worlds_and_remeshed_bodies(ball, device):
    """A tool presses harder in each of three worlds; and contact goes on while the mesh changes."""
    many = wc.SoftBody(ball, SOFT, worlds=3, device=device)
    probe = wc.Tool(wc.Sphere(0.006, position=(0.0, 0.0, 0.0258)), speed=0.5)
    poses = np.tile(np.float32([0, 0, 0.03, 0, 0, 0, 1]), (3, 1))
    poses[:, 2] = (0.03, 0.0235, 0.0225)
    probe.use_poses(wp.array(poses, dtype=wp.transform, device=device))
    integrator = wc.SymplecticEuler(viscosity=1e-3)
    sim = wc.Simulation(many, obstacles=[ground(), probe], integrator=integrator, gravity=(0.0, 0.0, -9.81))
    sim.advance(0.05)
    pushed = probe.wrench.numpy()[:, 2]
    assert pushed[0] == 0.0
    assert 0.0 < pushed[1] < pushed[2]
    assert many.contact_pressure.shape == (3 * len(many.contact_surface.triangles),)

    one = wc.SoftBody(ball, SOFT, device=device)
    probe = wc.Tool(wc.Sphere(0.006))
    probe.follow([0.0, 0.03], [(0.0, 0.0, 0.0262), (0.0, 0.0, 0.019)])
    remesh = wc.OnlineRemesh(2000, every=20, min_level=0)
    given = {"obstacles": [ground(), probe], "remesh": remesh, "integrator": integrator}
    sim = wc.Simulation(one, gravity=(0.0, 0.0, -9.81), **given)
    sim.advance(0.04)
    assert len(one.mesh.tets) != len(ball.tets)
    points = sim.contacts()
    assert {point.other for point in points} == set(sim.obstacles)
    assert min(point.gap for point in points) > -2e-4


def test_what_contact_acts_on_is_checked():
    with pytest.raises(wc.InputError, match="on is 'skin'; it must be 'surface' or 'tetrahedra'"):
        wc.Contact(on="skin")


@pytest.mark.parametrize(("finest", "error"), [(12, 0.05), pytest.param(15, 0.03, marks=pytest.mark.slow)])
def test_a_ball_sinks_into_an_embedded_half_space_as_hertz_says(device, finest, error):
    """The surface lies within the elements: with 2 and 4 of them over the radius of contact, forces are 3 and 1 % off.
    On the boundary of the tetrahedra, the force is twice that of the closed form."""
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
    integrator = wc.SymplecticEuler(damping=150.0)
    contact = wc.Contact(friction=0.0)
    sim = wc.Simulation(body, obstacles=[tool], contact=contact, integrator=integrator, gravity=(0.0, 0.0, 0.0))
    sim.advance(0.3)
    assert tool.wrench.numpy()[0, 2] == pytest.approx(FORCE, rel=error)
