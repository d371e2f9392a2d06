"""Hard cases: many bodies at once, a sheet folded onto itself, thin things that are fast, tools at random."""

import numpy as np
import pytest

import warp_corot as wc

DOWN = (0.0, 0.0, -9.81)


def turned(rng):
    """A random rotation, by quaternions."""
    w, x, y, z = (q := rng.normal(size=4)) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


@pytest.mark.parametrize("count", [30, pytest.param(1000, marks=pytest.mark.slow)])
def test_bodies_poured_into_a_bowl_stay_in_it(device, rng, count):
    """Cubes of 8 mm with one mesh, each in a random orientation: they come to rest, and the bowl carries their
    weight."""
    size = 0.01
    side = max(int(np.ceil((count / 2) ** (1 / 3))), 2)
    places = np.array([(i, j, k) for k in range(4 * side) for i in range(side) for j in range(side)][:count])
    places = 1.5 * size * places + rng.uniform(-1e-3, 1e-3, places.shape)
    radius = 1.1 * size * side + 0.02
    places -= [*(0.5 * places.max(axis=0)[:2]), 0.5 * side * size - radius]

    def distance(points):
        r = np.linalg.norm(points - (0.0, 0.0, radius), axis=1)
        return np.maximum(np.maximum(radius - r, r - 1.2 * radius), points[:, 2] - radius)

    lower, upper = (-1.4 * radius, -1.4 * radius, -0.4 * radius), (1.4 * radius,) * 3
    bowl = wc.SignedDistance(distance, lower=lower, upper=upper, resolution=48)
    cube = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.8 * size, level=0)
    corners = cube.points - cube.points.mean(axis=0)
    points = np.concatenate([corners @ turned(rng).T + place for place in places])
    tets = np.concatenate([cube.tets + k * len(corners) for k in range(count)])
    body = wc.SoftBody(wc.TetMesh(points, tets), wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    contact = wc.Contact(self_contact=True)
    integrator = wc.SymplecticEuler(viscosity=1e-3, damping=4.0)
    sim = wc.Simulation(body, obstacles=bowl, contact=contact, gravity=DOWN, integrator=integrator)
    sim.advance(0.5 if count < 100 else 1.0)
    carried = []
    for _ in range(10):
        sim.advance(0.01)
        carried.append(-bowl.wrench.numpy()[0, 2] / (9.81 * body.masses.sum()))
    now = body.positions.numpy().astype(float)
    assert now[:, 2].max() < radius
    assert np.linalg.norm(now - (0.0, 0.0, radius), axis=1).max() < radius + 2e-4
    assert np.mean(carried) == pytest.approx(1.0, rel=0.03)
    assert np.linalg.norm(body.velocities.numpy(), axis=1).mean() < 0.03
    # No cube is in another: they are as far apart as their insides.
    centres = now.reshape(count, -1, 3).mean(axis=1)
    apart = np.linalg.norm(centres[:, None] - centres[None], axis=2)[np.triu_indices(count, 1)]
    assert apart.min() > 0.6 * size


@pytest.mark.parametrize("itself", [True, False])
def test_a_folded_sheet_lies_on_itself(device, itself):
    """The outer faces of a sheet of 2 mm are brought to within 3 mm of one another; without contact its halves would
    cross."""
    mesh = wc.TetForest.box(cells=(20, 3, 1), cell_size=0.002, level=0, origin=(-0.02, -0.003, -0.001))
    body = wc.SoftBody(mesh, wc.Isotropic(5e4, 0.3, 1000.0), device=device)
    x = mesh.points
    shares = np.linspace(0.0, 1.0, 17)
    for sign in (-1.0, 1.0):
        for s in np.unique(np.round(x[sign * x[:, 0] > 0.0139, 0], 9)):
            nodes = np.flatnonzero((np.abs(x[:, 0] - s) < 1e-6) & (x[:, 2] < 0.0))
            angle = 0.5 * np.pi * shares
            along, up = abs(s) * np.cos(angle) + 0.001 * np.sin(angle), abs(s) * np.sin(angle) - 0.001 * np.cos(angle)
            way = np.column_stack(
                [sign * (along + 0.0005 * shares) - s, np.zeros_like(angle), up + 0.001 - 0.003 * shares]
            )
            body.prescribe(nodes, times=0.1 * shares, displacements=way)
    contact = wc.Contact(self_contact=itself)
    sim = wc.Simulation(body, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=wc.SymplecticEuler(viscosity=1e-4))
    sim.advance(0.12)
    now = body.positions.numpy().astype(float)
    # What lay at x lies before what lay at -x.
    left = np.flatnonzero((np.abs(x[:, 2] - 0.001) < 1e-6) & (x[:, 0] < -0.0139))
    right = [int(np.argmin(np.linalg.norm(x - x[k] * (-1.0, 1.0, 1.0), axis=1))) for k in left]
    crossing = (now[left, 0] - now[right, 0]).max()
    if itself:
        assert crossing < 5e-5
        forces = body.contact_forces.numpy().astype(float)
        assert np.abs(forces).max() > 1e-3
        np.testing.assert_allclose(forces.sum(axis=0), 0.0, atol=1e-4 * np.abs(forces).sum())
    else:
        assert crossing > 5e-4


@pytest.mark.parametrize("speed", [1.0, 10.0, pytest.param(50.0, marks=pytest.mark.slow)])
def test_a_thrown_sheet_does_not_pass_a_sheet(device, speed):
    """Two sheets of 2 mm; waves travel at 7 m/s in the soft one and at 71 m/s in the stiffer one."""
    material = wc.Isotropic(5e4 if speed < 5.0 else 5e6, 0.3, 1000.0)
    low, high = (
        wc.SoftBody(
            wc.TetForest.box(cells=(6, 6, 1), cell_size=0.002, level=1, origin=(at, at, z)), material, device=device
        )
        for at, z in ((0.0, 0.0), (0.0007, 0.0025))
    )
    low.fix("(x < xmin + 1e-6) | (x > xmax - 1e-6)")
    high.velocities = np.tile((0.0, 0.0, -speed), (high.node_count, 1))
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=(0.0, 0.0, 0.0))
    start = sim.energy().total
    touched, centre = 0.0, np.abs(low.mesh.points[:, :2] - 0.006).max(axis=1) < 0.003
    over = np.abs(high.mesh.points[:, :2] - 0.006).max(axis=1) < 0.003
    for _ in range(12):
        sim.advance(0.0005 / speed)
        touched = max(touched, float(high.contact_forces.numpy()[:, 2].sum()))
        heights = [each.positions.numpy()[near, 2].mean() for each, near in ((low, centre), (high, over))]
        assert heights[1] - heights[0] > 0.001
        assert sim.energy().total <= 1.02 * start
    assert touched > 0.0


def surface_of(body):
    """The points on which contact acts, where they are now."""
    return body.contact_surface.moved(body.displacements.numpy())


@pytest.mark.parametrize("seconds", [0.15, pytest.param(5.0, marks=pytest.mark.slow)])
def test_a_tool_at_random_leaves_an_organ_whole(device, rng, seconds):
    """A ball of 12 mm presses and shears a body of 60 mm at up to 1 m/s, and then leaves."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.03, device=device), target_elements=1500, device=device)
    points = mesh.points
    size = np.ptp(points[:, 2])
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.45, 1000.0), device=device)
    body.fix(np.flatnonzero(points[:, 2] < points[:, 2].min() + 0.3 * size))
    count = int(seconds / 0.05) + 1
    toward = rng.normal(size=(count, 3))
    toward[:, 2] = np.abs(toward[:, 2]) + 0.3
    toward /= np.linalg.norm(toward, axis=1, keepdims=True)
    far = rng.uniform(0.35, 0.7, (count, 1)) * size
    far[0], far[-1] = 0.9 * size, 2.0 * size
    tool = wc.Tool(wc.Sphere(0.006))
    tool.follow(0.05 * np.arange(count), toward * far)
    contact = wc.Contact(friction=0.5, self_contact=seconds > 1.0)
    integrator = wc.SymplecticEuler(viscosity=2e-3)
    sim = wc.Simulation(body, obstacles=tool, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    felt = 0.0
    while sim.time < seconds - 1e-9:
        sim.advance(0.01)
        pose = sim.contact.obstacles.poses()[0, 0, :3]
        assert np.linalg.norm(surface_of(body) - pose, axis=1).min() > 0.0059
        felt = max(felt, float(np.linalg.norm(tool.wrench.numpy()[0][:3])))
    sim.advance(0.1)
    assert felt > 0.05
    now = body.positions.numpy().astype(float)
    volumes = [
        np.linalg.det(np.stack([x[mesh.tets[:, k]] - x[mesh.tets[:, 0]] for k in (1, 2, 3)], axis=1))
        for x in (now, points)
    ]
    assert (volumes[0] / volumes[1]).min() > 0.0
    assert np.linalg.norm(now - points, axis=1).max() < 0.1 * size


#: Thin and sharp tools along the z axis, of a radius or half a width [m].
SHARP = {
    "capsule": lambda r: wc.Capsule(r, 0.06),
    "box": lambda r: wc.Box((2 * r, 2 * r, 0.06)),
    "cylinder": lambda r: wc.Cylinder(r, 0.06),
    "mesh": lambda r: wc.TriangleMesh(*square_rod(r, 0.03)),
}


def square_rod(r, half):
    points = np.array([[x, y, z] for x in (-r, r) for y in (-r, r) for z in (-half, half)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return points, np.array([(a, b, c) for a, b, c, d in sides] + [(a, c, d) for a, b, c, d in sides])


@pytest.mark.filterwarnings("ignore::warp_corot.StabilityWarning")
@pytest.mark.parametrize(
    ("kind", "radius", "speed", "seed", "itself"),
    [("capsule", 0.003, 10.0, 2, False), ("box", 0.0025, 10.0, 0, True)]
    + [
        pytest.param(kind, radius, speed, seed, itself, marks=pytest.mark.slow)
        for kind, radius in (("capsule", 5e-4), ("capsule", 5e-3), *((kind, 3e-3) for kind in SHARP))
        for seed, speed in enumerate((0.1, 1.0, 10.0, 50.0))
        for itself in (False, True)
    ],
)
def test_a_thin_tool_stabs_an_organ(device, kind, radius, speed, seed, itself):
    """It goes 24 mm deep into a ball of 60 mm, whose elements are larger than the tool, and turns some of them
    inside out. The run continues, nothing is thrown off, and the body is whole once the tool has left, also with
    self-contact."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.03, device=device), target_elements=1500, device=device)
    points = mesh.points
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    body.fix(np.flatnonzero(points[:, 2] < -0.012))
    way = np.random.default_rng(seed).normal(size=3)
    way[2] = abs(way[2]) + 0.3
    way /= np.linalg.norm(way)
    tool = wc.Tool(SHARP[kind](radius))
    begins, ends = 0.083 + radius, 0.036 + radius
    taken = (begins - ends) / speed
    turn = np.append(np.cross((0.0, 0.0, 1.0), way), 1.0 + way[2])
    tool.follow([0.0, taken, taken + 0.01, 2 * taken + 0.02], np.outer((begins, ends, ends, begins), way), turn)
    integrator = wc.SymplecticEuler(viscosity=2e-3)
    contact = wc.Contact(self_contact=itself)
    sim = wc.Simulation(body, obstacles=tool, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    felt = moved = 0.0
    for _ in range(10):
        sim.advance(0.1 * (taken + 0.01))
        felt = max(felt, float(np.linalg.norm(tool.wrench.numpy()[0][:3])))
        moved = max(moved, float(np.linalg.norm(body.displacements.numpy(), axis=1).max()))
        if kind == "capsule":
            assert closest_to_rod(surface_of(body), tool, 0.03) > 0.95 * radius
    # After a blow at 50 m/s the ball is ahead of the tool whenever we look.
    assert felt < 1e3
    assert moved > 0.1 * (begins - ends)
    # A blow at 50 m/s makes the whole ball ring for longer.
    sim.advance(taken + (0.4 if speed > 10.0 else 0.2))
    assert np.linalg.norm(body.positions.numpy() - points, axis=1).max() < 2e-3
    assert volume_ratios(mesh, body).min() > 0.5


#: Where a stab left six nodes of the ball below, at rest and then [mm]: the fourth lies folded over its neighbours.
FOLDED = np.array(
    [
        ((0.0, -27.165, 27.165), (0.073, -27.55, 27.008)),
        ((0.0, -18.11, 27.165), (0.129, -18.503, 26.933)),
        ((-9.055, -18.11, 27.165), (-9.0, -18.287, 27.333)),
        ((0.0, -18.11, 36.22), (-10.551, -19.202, 28.078)),
        ((9.055, -27.165, 27.165), (9.192, -27.439, 27.032)),
        ((9.055, -18.11, 27.165), (9.194, -18.348, 27.06)),
    ]
)


#: A corner of the ball that is hooked behind the node beside it, which lies at the same place.
HOOKED = np.array([((0.0, 18.11, 36.22), (-0.232, 25.667, 28.87)), ((0.0, 27.165, 27.165), (-0.232, 25.667, 28.87))])


@pytest.mark.parametrize("places", [FOLDED, HOOKED], ids=["folded", "hooked"])
def test_a_corner_folded_over_its_neighbours_gets_back(device, places):
    """Contact must not hold a node that is behind the folded triangles next to it, nor elements that are crushed. As a
    general mesh, so that contact acts on the tetrahedra's corners."""
    forest = wc.TetForest.from_domain(wc.Domain.sphere(0.03, device=device), target_elements=1500, device=device)
    mesh = wc.TetMesh(forest.points, forest.tets)
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    body.fix(np.flatnonzero(mesh.points[:, 2] < -0.012))
    moved = mesh.points.copy()
    for rest, now in 1e-3 * places:
        k = int(np.argmin(np.linalg.norm(mesh.points - rest, axis=1)))
        np.testing.assert_allclose(mesh.points[k], rest, atol=2e-6)
        moved[k] = now
    body.positions = moved
    contact, integrator = wc.Contact(self_contact=True), wc.SymplecticEuler(viscosity=2e-3)
    sim = wc.Simulation(body, contact=contact, gravity=(0.0, 0.0, 0.0), integrator=integrator)
    sim.advance(0.03)
    assert np.linalg.norm(body.positions.numpy() - mesh.points, axis=1).max() < 1e-3


def closest_to_rod(points, tool, half):
    """The largest distance of points from the axis of a rod [m]."""
    pose = tool.present_pose[0]
    x, y, z, w = pose[3:]
    axis = np.array([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
    along = np.clip((points - pose[:3]) @ axis, -half, half)
    return np.linalg.norm(points - pose[:3] - along[:, None] * axis, axis=1).min()


def volume_ratios(mesh, body):
    """The volume of each element over its volume at rest."""
    now, rest = (
        np.linalg.det(x[mesh.tets[:, 1:]] - x[mesh.tets[:, :1]])
        for x in (body.positions.numpy().astype(float), mesh.points)
    )
    return now / rest


def test_elements_turned_inside_out_cause_a_warning(device):
    """The warning comes once, and the run continues."""
    body = wc.SoftBody(wc.TetForest.box((2, 2, 1), 0.02, 4), wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    body.fix("z == zmin")
    tool = wc.Tool(wc.Capsule(1e-3, 0.04))
    tool.follow([0.0, 0.016], [(0.0213, 0.0207, 0.0415), (0.0213, 0.0207, 0.0255)])
    sim = wc.Simulation(body, obstacles=tool, gravity=(0.0, 0.0, 0.0), integrator=wc.SymplecticEuler(viscosity=2e-3))
    with pytest.warns(wc.StabilityWarning, match=r"elements are turned inside out at t = .* NeoHookean") as said:
        sim.advance(0.03)
    assert sum("inside out" in str(each.message) for each in said) == 1


@pytest.mark.parametrize(("radius", "is_small"), [(0.02, False), (0.005, True)])
def test_a_tool_smaller_than_the_elements_under_it_causes_a_warning(device, radius, is_small, recwarn):
    """It names the size that would do; a body that is remeshed causes none."""
    for remeshed in (False, True):
        body = wc.SoftBody(
            wc.TetForest.box((3, 3, 2), 0.02, 3, up_axis="Z"), wc.Isotropic(2e4, 0.4, 1000.0), device=device
        )
        body.fix("z == zmin")
        tool = wc.Tool(wc.Sphere(radius))
        tool.follow([0.0, 0.1], [(0.03, 0.03, 0.041 + radius), (0.03, 0.03, 0.03 + radius)])
        remesh = wc.OnlineRemesh(near=tool) if remeshed else None
        sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0), remesh=remesh)
        sim.advance(1e-3)
    said = [str(each.message) for each in recwarn if issubclass(each.category, wc.StabilityWarning)]
    assert len(said) == is_small
    if is_small:
        assert "sphere, 10 mm thick" in said[0]
        assert "edges of 1.25 mm would do" in said[0]


def test_overlaps_at_the_start_cause_a_warning(device):
    """Two bodies overlap, and a needle lies in one of them between its nodes."""
    low, high = (
        wc.SoftBody(
            wc.TetForest.box((2, 2, 1), 0.02, 1, origin=(0, 0, z)), wc.Isotropic(2e4, 0.4, 1000.0), device=device
        )
        for z in (0.0, 0.0195)
    )
    needle = wc.Tool(wc.Capsule(2e-4, 0.005, position=(0.0213, 0.0207, 0.009)))
    sim = wc.Simulation([low, high], obstacles=needle, gravity=(0.0, 0.0, 0.0))
    with pytest.warns(wc.StabilityWarning) as said:
        sim.advance_steps(2)
    assert any("begin inside another soft body, by up to 0.5 mm" in str(each.message) for each in said)
    assert any("a capsule begins inside a soft body" in str(each.message) for each in said)


def test_stiff_bodies_that_overlap_are_not_thrown(device):
    """Waves travel at 146 m/s in two rods that cross; at a fraction of that they would leave at 0.5 m/s, and nodes at
    2.5 m/s."""
    boxes = (((10, 1, 1), (-0.03, -0.003, 0.0)), ((1, 10, 1), (-0.003, -0.03, 0.0055)))
    rods = [
        wc.SoftBody(
            wc.TetForest.box(cells, 0.006, 0, origin=at, up_axis="Z"), wc.Isotropic(1e7, 0.4, 1000.0), device=device
        )
        for cells, at in boxes
    ]
    sim = wc.Simulation(rods, contact=wc.Contact(friction=0.3), gravity=(0.0, 0.0, 0.0))
    with pytest.warns(wc.StabilityWarning, match="pushed out at no more than"):
        sim.advance(0.02)
    low, high = (body.masses @ body.velocities.numpy()[:, 2] / body.masses.sum() for body in rods)
    assert 0.0 < high < 0.3
    assert low == pytest.approx(-high, rel=1e-2)
    assert max(np.linalg.norm(body.velocities.numpy(), axis=1).max() for body in rods) < 0.6
    assert rods[1].positions.numpy()[:, 2].min() > rods[0].positions.numpy()[:, 2].max()


@pytest.mark.filterwarnings("ignore:.* turned inside out")
def test_a_tool_that_presses_on_the_edge_of_a_support_throws_nothing(device):
    """A ball between two held faces, which it touches. If nodes beside these made up for them, they would be thrown off
    at fifty times the tool's speed."""
    mesh = wc.TetForest.box((1, 3, 2), 0.02, level=5)
    body = wc.SoftBody(mesh, wc.Isotropic(8e3, 0.3, 1000.0), device=device)
    body.fix("(x < xmin + 1e-9) | (x > xmax - 1e-9)")
    tool = wc.Tool(wc.Sphere(0.012))
    tool.follow([0.0, 0.1], [(0.0101, 0.0303, 0.053), (0.0101, 0.0303, 0.043)])
    sim = wc.Simulation(body, obstacles=tool, gravity=(0.0, 0.0, 0.0), integrator=wc.SymplecticEuler(damping=20.0))
    for _ in range(12):
        sim.advance(0.01)
        assert np.abs(body.velocities.numpy()).max() < 0.4
    assert 1.0 < tool.wrench.numpy()[0, 2] < 10.0


@pytest.mark.filterwarnings("ignore:.* turned inside out")
def test_a_body_that_is_thrown_faster_than_any_search_reaches_takes_shorter_steps(device):
    """At 20 times the speed of its waves, in 0.3 m a step; nodes inside may go through a surface that is crushed."""
    mesh = wc.TetForest.box((2, 2, 2), 0.05, level=3, origin=(0.0, 0.0, 0.02))
    body = wc.SoftBody(mesh, wc.Isotropic(50.0, 0.3, 1000.0), device=device)
    body.velocities = np.tile([0.0, 0.0, -5.0], (body.node_count, 1))
    sim = wc.Simulation(body, obstacles=wc.Ground(), gravity=(0.0, 0.0, -9.81))
    before = sim.energy().total
    with pytest.warns(wc.StabilityWarning, match="farther than 55 mm in one step"):
        sim.advance(0.3)
    outside = ((mesh.points == mesh.points.min(axis=0)) | (mesh.points == mesh.points.max(axis=0))).any(axis=1)
    assert body.positions.numpy()[outside, 2].min() > -1e-4
    assert sim.energy().total < before


def test_a_given_step_that_no_search_reaches_ends_in_the_last_good_state(device):
    mesh = wc.TetForest.box((2, 2, 2), 0.05, level=3, origin=(0.0, 0.0, 0.02))
    body = wc.SoftBody(mesh, wc.Isotropic(50.0, 0.3, 1000.0), device=device)
    body.velocities = np.tile([0.0, 0.0, -5.0], (body.node_count, 1))
    euler = wc.SymplecticEuler(dt=0.06)
    sim = wc.Simulation(body, obstacles=wc.Ground(), gravity=(0.0, 0.0, -9.81), integrator=euler)
    with pytest.raises(wc.UnstableError, match=r"farther than 55 mm .*; the state is that of t = 0 s"):
        sim.advance(0.3)
    assert sim.time == 0.0
    assert not body.displacements.numpy().any()
