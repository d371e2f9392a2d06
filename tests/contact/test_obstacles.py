"""Soft bodies against rigid obstacles: weights, slopes, rebounds, a sharp needle, and the forces on either side."""

import numpy as np
import pytest
import warp as wp
from soft_blocks import DOWN, block, force_on, motion, weight

import warp_corot as wc

#: Takes vibrations out of bodies, and leaves their motion as a whole alone [s].
CALM = wc.SymplecticEuler(viscosity=1e-3)


# --- weight and friction -------------------------------------------------------------------------------------------


def test_the_ground_carries_the_weight(device):
    body, ground = block(device), wc.Ground()
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=CALM)
    sim.advance(0.4)
    assert force_on(ground)[2] == pytest.approx(-weight(body), rel=1e-3)
    assert body.contact_forces.numpy()[:, 2].sum() == pytest.approx(weight(body), rel=1e-3)
    assert abs(body.positions.numpy()[:, 2].min()) < 1e-7


def test_pressure_times_area_is_the_force(device):
    body, ground = block(device), wc.Ground()
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=CALM)
    sim.advance(0.2)
    corners = body.positions.numpy().astype(float)[body.surface_triangles]
    areas = 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    pushed = -(body.contact_pressure.numpy()[:, None] * areas).sum(axis=0)
    assert pushed[2] == pytest.approx(-force_on(ground)[2], rel=1e-3)


@pytest.mark.slow
def test_a_block_rests_on_a_slope_for_ten_minutes(device):
    angle = 0.9 * np.arctan(0.3)
    body = block(device, cells=(1, 1, 1))
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    sim = wc.Simulation(body, obstacles=wc.Ground(), gravity=gravity, integrator=CALM, contact=wc.Contact(friction=0.3))
    sim.advance(0.5)
    before = body.displacements.numpy()
    sim.advance(600.0)
    assert np.abs(body.displacements.numpy() - before).max() < 1e-6


def test_a_tilted_ground_is_a_tilted_gravity(device):
    angle = 0.2
    body = block(device)
    normal = np.array([np.sin(angle), 0.0, np.cos(angle)])
    lowest = (body.mesh.points @ normal).min()
    sim = wc.Simulation(
        body, obstacles=wc.Ground(normal, lowest), gravity=DOWN, integrator=CALM, contact=wc.Contact(friction=10.0)
    )
    sim.advance(0.02)
    assert (body.positions.numpy() @ normal).min() > lowest - 1e-6


def test_a_rebound_gains_no_energy(device):
    body, ground = block(device, origin=(0.0, 0.0, 0.005)), wc.Ground()
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN)
    start = sim.energy().total
    highest = start
    for _ in range(20):
        sim.advance(0.01)
        highest = max(highest, sim.energy().total)
    assert highest <= start + 0.01 * weight(body) * 0.005
    assert body.positions.numpy()[:, 2].min() > -1e-6


# --- shapes --------------------------------------------------------------------------------------------------------

BOX_POINTS = 0.01 * np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
BOX_TRIANGLES = np.array([(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)])
BOX_TRIANGLES = np.vstack([BOX_TRIANGLES, [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]])


def ball(points):
    return np.linalg.norm(points, axis=1) - 0.01


HANDS = [
    wc.TriangleMesh(1.11 * BOX_POINTS, BOX_TRIANGLES),
    wc.SignedDistance(ball, (-0.015, -0.015, -0.015), upper=(0.015, 0.015, 0.015)),
    wc.Sphere(0.01),
    wc.Capsule(0.01, 0.02),
    wc.Cylinder(0.01, 0.02),
    wc.Box((0.023, 0.021, 0.02)),
]


def top_of(shape):
    if isinstance(shape, wc.TriangleMesh | wc.SignedDistance | wc.Sphere):
        return 0.0113 if isinstance(shape, wc.TriangleMesh) else 0.01
    return (
        shape.size[2]
        if isinstance(shape, wc.Box)
        else shape.size[1] + (0 if isinstance(shape, wc.Cylinder) else shape.size[0])
    )


@pytest.mark.parametrize("shape", HANDS, ids=repr)
def test_action_is_reaction(device, shape):
    """The wrench on the tool is the sum of the forces on the nodes, and the fixed side bears it."""
    body = block(device)
    body.fix("z == zmin")
    tool = wc.Tool(shape)
    down = top_of(shape)
    tool.follow([0.0, 0.05], [(0.02, 0.02, 0.0201 + down), (0.02, 0.02, 0.0181 + down)])
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0), integrator=wc.SymplecticEuler(viscosity=3e-3))
    sim.advance(0.2)
    felt, held = [], []
    for _ in range(200):  # at sharp edges single steps differ by some per cent
        sim.step()
        felt.append(force_on(tool))
        held.append(body.reactions.numpy().astype(float).sum(axis=0))
        on_nodes = body.contact_forces.numpy().astype(float).sum(axis=0)
        np.testing.assert_allclose(felt[-1], -on_nodes, atol=1e-5 * felt[-1][2])
    mean = np.mean(felt, axis=0)
    assert mean[2] > 0.01
    np.testing.assert_allclose(np.mean(held, axis=0), mean, atol=0.01 * mean[2])


@pytest.mark.parametrize("shape", HANDS, ids=repr)
def test_forces_of_contacts_add_up_to_the_wrench(device, shape):
    body = block(device)
    body.fix("z == zmin")
    tool = wc.Tool(shape)
    down = top_of(shape)
    tool.follow([0.0, 0.02], [(0.021, 0.02, 0.0201 + down), (0.023, 0.02, 0.0191 + down)])
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0), integrator=CALM)
    sim.advance(0.03)
    wrench = tool.wrench.numpy()[0].astype(float)
    points = sim.contacts()
    assert points
    assert all(point.body is body and point.other is tool for point in points)
    forces = np.array([point.force for point in points])
    origin = tool.present_pose[0, :3]
    torques = np.cross(np.array([point.point for point in points]) - origin, forces)
    np.testing.assert_allclose(-forces.sum(axis=0), wrench[:3], atol=1e-5 * abs(wrench[2]))
    np.testing.assert_allclose(-torques.sum(axis=0), wrench[3:], atol=1e-3 * 0.01 * abs(wrench[2]))
    for point in points:
        assert point.normal_force >= 0.0
        assert np.linalg.norm(point.friction_force) <= 0.3 * point.normal_force * (1 + 1e-4) + 1e-9


def closest_to_axis(body, tool):
    """The least distance between a capsule's axis and the body's surface [m], and whether the axis goes through the
    body."""
    pose = tool.present_pose[0]
    half = np.array([0.0, 0.0, tool.shape.size[1]])
    axis = pose[:3] + np.linspace(-1.0, 1.0, 2001)[:, None] * half
    a, b, c = np.moveaxis(body.positions.numpy().astype(float)[body.surface_triangles], 1, 0)
    w = np.array([(i, j, 8 - i - j) for i in range(9) for j in range(9 - i)]) / 8.0
    points = (
        np.einsum("k,td->ktd", w[:, 0], a) + np.einsum("k,td->ktd", w[:, 1], b) + np.einsum("k,td->ktd", w[:, 2], c)
    )
    points = points.reshape(-1, 3)
    far = points - np.array([pose[0], pose[1], 0.0])
    low = axis[0, 2]
    beyond = np.where(points[:, 2] < low, low - points[:, 2], 0.0)
    return float(np.sqrt(far[:, 0] ** 2 + far[:, 1] ** 2 + beyond**2).min())


@pytest.mark.parametrize("speed", [1.0, 10.0, 50.0])
def test_a_needle_does_not_pass(device, speed):
    """A needle of 1 mm meets a sheet of 2 mm between its nodes; waves travel at 3.6 m/s in the sheet."""
    mesh = wc.TetForest.box(cells=(5, 5, 1), cell_size=0.002, level=0, origin=(-0.005, -0.005, -0.002))
    body = wc.SoftBody(mesh, wc.Isotropic(young=5e3, poisson=0.4, density=1000.0), device=device)
    body.fix("(x == xmin) | (x == xmax) | (y == ymin) | (y == ymax)")
    tool = wc.Tool(wc.Capsule(radius=0.0005, length=0.05))
    x, y = 0.00031, 0.00047
    tool.follow([0.0, 0.006 / speed], [(x, y, 0.0255 + 0.001), (x, y, 0.0255 - 0.005)])
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0))
    felt = 0.0
    for _ in range(12):
        sim.advance(0.0005 / speed)
        felt = max(felt, force_on(tool)[2])
        assert closest_to_axis(body, tool) > 0.8 * 0.0005
    assert felt > 0.0


@pytest.mark.parametrize("rod", [wc.Capsule, wc.Box])
def test_a_block_on_two_rods_does_not_creep(device, rod):
    """At 0.7 of the angle of friction, on rods that touch it only between its nodes."""
    mesh = wc.TetForest.box(cells=(4, 1, 1), cell_size=0.01, level=2, origin=(-0.02, -0.005, 0.003))
    body = wc.SoftBody(mesh, wc.Isotropic(young=5e4, poisson=0.3, density=1000.0), device=device)
    along_y = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
    rods = []
    for x in (-0.0113, 0.0121):
        size = (0.003, 0.05) if rod is wc.Capsule else ((0.006, 0.006, 0.05),)
        rods.append(rod(*size, position=(x, 0.0, 0.0), quaternion=along_y))
    angle = 0.7 * np.arctan(0.4)
    sim = wc.Simulation(
        body,
        obstacles=rods,
        contact=wc.Contact(friction=0.4),
        gravity=(9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle)),
        integrator=wc.SymplecticEuler(viscosity=1e-3, damping=2.0),
    )
    sim.advance(0.5)
    before = body.positions.numpy().astype(float)
    sim.advance(0.5)
    moved = body.positions.numpy() - before
    assert np.abs(moved.mean(axis=0)).max() < 1e-7
    assert np.abs(moved).max() < 1e-6
    carried = sum(force_on(each) for each in rods)
    expected = 9.81 * body.masses.sum() * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    np.testing.assert_allclose(carried, expected, atol=2e-3 * np.linalg.norm(expected))


# --- tools ---------------------------------------------------------------------------------------------------------


def test_a_tool_goes_where_it_is_sent(device):
    body, tool = block(device), wc.Tool(wc.Sphere(0.01, position=(0.0, 0.0, 1.0)), speed=2.0)
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0))
    tool.move((0.0, 0.1, 1.0))
    sim.advance(0.02)
    np.testing.assert_allclose(tool.present_pose[0, :3], (0.0, 0.04, 1.0), atol=1e-5)
    sim.advance(0.05)
    np.testing.assert_allclose(tool.present_pose[0, :3], (0.0, 0.1, 1.0), atol=1e-6)


def test_a_tool_follows_an_array_on_the_device(device):
    body, tool = block(device, worlds=2), wc.Tool(wc.Sphere(0.01, position=(0.0, 0.0, 1.0)), speed=100.0)
    poses = wp.array([[0, 0, 1, 0, 0, 0, 1], [0, 0, 2, 0, 0, 0, 1]], dtype=wp.transform, device=device)
    tool.use_poses(poses)
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0))
    sim.advance(0.05)
    np.testing.assert_allclose(tool.present_pose[:, 2], (1.0, 2.0), atol=1e-6)
    poses.assign(np.array([[0, 0, 1.5, 0, 0, 0, 1], [0, 0, 2.5, 0, 0, 0, 1]], np.float32))
    sim.advance(0.05)
    np.testing.assert_allclose(tool.present_pose[:, 2], (1.5, 2.5), atol=1e-6)


@pytest.mark.parametrize("wrong", [(np.nan, 0, 2, 0, 0, 0, 1), (0, 0, np.inf, 0, 0, 0, 1), (0, 0, 2, 0, 0, 0, 0)])
def test_invalid_poses_are_ignored(device, wrong):
    body, tool = block(device), wc.Tool(wc.Sphere(0.01, position=(0.0, 0.0, 1.0)), speed=100.0)
    poses = wp.array([[0, 0, 1.1, 0, 0, 0, 2]], dtype=wp.transform, device=device)
    tool.use_poses(poses)
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0))
    for pose, height in (((0, 0, 1.1, 0, 0, 0, 2), 1.1), (wrong, 1.1), ((0, 0, 1.2, 0, 0, 0, 1), 1.2)):
        poses.assign(np.array([pose], np.float32))
        sim.advance(0.01)
        np.testing.assert_allclose(tool.present_pose[0], (0, 0, height, 0, 0, 0, 1), atol=1e-6)


def test_worlds_have_tools_of_their_own(device):
    body, ground = block(device, worlds=2), wc.Ground()
    tool = wc.Tool(wc.Sphere(0.01), speed=100.0)
    poses = wp.array([[0.02, 0.02, 0.0295, 0, 0, 0, 1], [0, 0, 2, 0, 0, 0, 1]], dtype=wp.transform, device=device)
    tool.move((0.0, 0.0, 2.0))
    tool.use_poses(poses)
    sim = wc.Simulation(body, obstacles=[ground, tool], gravity=DOWN, integrator=CALM)
    sim.advance(0.3)
    assert force_on(tool, 1)[2] == 0.0
    assert force_on(tool, 0)[2] > 0.0
    assert force_on(ground, 1)[2] == pytest.approx(-weight(body), rel=1e-3)
    assert force_on(ground, 0)[2] == pytest.approx(-weight(body) - force_on(tool, 0)[2], rel=1e-2)


def test_an_overlap_at_the_start_warns_and_is_undone_slowly(device):
    body, ground = block(device, origin=(0.0, 0.0, -0.002)), wc.Ground()
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=CALM)
    fastest = 0.0
    with pytest.warns(wc.StabilityWarning, match=r"25 surface nodes begin inside obstacles, by up to 2 mm"):
        sim.advance(0.005)
    for _ in range(30):
        sim.advance(0.01)
        fastest = max(fastest, np.abs(body.velocities.numpy()).max())
    assert fastest < 0.5
    assert body.positions.numpy()[:, 2].min() > -1e-5
    assert motion(body)[0][2] < 0.003  # not thrown up


@pytest.mark.parametrize("z", [50.1, 33.4, 29.6])
def test_a_tool_that_is_too_fast_for_the_given_step_is_refused(device, z):
    """The message names a step with which it is not."""
    tool, fast = wc.Tool(wc.Capsule(0.0005, 0.05, position=(0.0, 0.0, 0.1))), [(0.0, 0.0, 0.1), (0.0, 0.0, z)]
    wc.Simulation(block(device), obstacles=[tool], integrator=wc.SymplecticEuler(dt=1e-4))
    with pytest.raises(wc.InputError, match=r"[345](\.\d+)? mm in a step.* a dt of at most \S+ s$") as refused:
        tool.follow([0.0, 1.0], fast)
    assert tool.keys is None
    tool.follow([0.0, 1.0], [(0.0, 0.0, 0.1), (0.0, 0.0, 0.2)])
    named, tool = float(str(refused.value).split()[-2]), wc.Tool(wc.Capsule(0.0005, 0.05, position=(0.0, 0.0, 0.1)))
    wc.Simulation(block(device), obstacles=[tool], integrator=wc.SymplecticEuler(dt=named))
    tool.follow([0.0, 1.0], fast)
    assert named > 0.98 * 1e-4 / (z - 0.1)


# --- input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: wc.Contact(friction=-0.1), "friction"),
        (lambda: wc.Contact(self_contact="yes"), "self_contact"),
        (lambda: wc.Sphere(0.0), "radius"),
        (lambda: wc.Ground(normal=(0, 0, 0)), "normal"),
        (lambda: wc.Box((0.1, 0.1)), "size"),
        (lambda: wc.Tool(0.1), "shape"),
        (lambda: wc.TriangleMesh(BOX_POINTS, BOX_TRIANGLES[:, ::-1]), "inside out"),
        (lambda: wc.TriangleMesh(BOX_POINTS, BOX_TRIANGLES[1:]), "closed"),
        (lambda: wc.SignedDistance(lambda p: -ball(p), (-1, -1, -1), upper=(1, 1, 1)), "border"),
        (lambda: wc.SignedDistance(np.ones((4, 4, 4)), (-1, -1, -1), spacing=0.1), "negative"),
        (lambda: wc.Tool(wc.Sphere(0.1)).follow([0, 1], [(0, 0, 0), (0, 0, np.nan)]), "positions"),
        (lambda: wc.Tool(wc.Sphere(0.1)).follow([1, 0], [(0, 0, 0), (0, 0, 1)]), "times"),
        (lambda: wc.Tool(wc.Sphere(0.1)).move((0, 0, np.inf)), "position"),
        (lambda: wc.Tool(wc.Sphere(0.1)).wrench, "simulation"),
        (lambda: wc.Simulation(block("cpu"), obstacles=["floor"]), "obstacle"),
        (lambda: wc.Simulation(block("cpu"), contact=0.3), "contact"),
        (lambda: block("cpu").contact_forces, "is in no simulation with contact"),
    ],
)
def test_bad_input_is_refused_in_one_line(make, says):
    with pytest.raises(wc.InputError, match=says) as caught:
        make()
    assert "\n" not in str(caught.value)
