"""Contact of bodies whose meshes change, and of meshes of any shape."""

import numpy as np
import pytest
import warp as wp

import warp_corot as wc
from warp_corot.mesh.surfaces.bound import distances_from

SOFT = wc.Isotropic(young=5e3, poisson=0.4, density=1000.0)
CALM = wc.SymplecticEuler(viscosity=1e-3)
DOWN = (0.0, 0.0, -9.81)


def block(device, z, mesh=None):
    mesh = mesh or wc.TetForest.box(cells=(2, 2, 1), cell_size=0.02, level=3, origin=(0.0, 0.0, z))
    return wc.SoftBody(mesh, SOFT, device=device)


def weight(body):
    return 9.81 * body.masses.sum()


def test_contact_follows_two_bodies_that_adapt(device):
    """A ball pressed on two blocks refines one of them; the ground still carries the whole load."""
    low, high = block(device, 0.0), block(device, 0.0205)
    ground, ball = wc.Ground(), wc.Tool(wc.Sphere(0.012))
    ball.follow([0.0, 0.2], [(0.02, 0.02, 0.0526), (0.02, 0.02, 0.046)])
    sim = wc.Simulation(
        [low, high],
        obstacles=[ground, ball],
        gravity=DOWN,
        integrator=wc.SymplecticEuler(damping=20.0, viscosity=2e-3),
        remesh=wc.OnlineRemesh(every=32, max_level=5, refine_above=1.02, simplify_below=1.005),
    )
    start = len(high.mesh.tets)
    sim.advance(0.3)
    assert len(high.mesh.tets) > start
    mean = np.zeros(3)
    for _ in range(10):
        sim.advance(0.005)
        pressed, carried = ball.wrench.numpy()[0, 2], ground.wrench.numpy()[0, 2]
        mean += np.array([carried, pressed, weight(low) + weight(high)]) / 10
        forces = [each.contact_forces.numpy().astype(float).sum(axis=0) for each in (low, high)]
        felt = sum(each.wrench.numpy()[0].astype(float)[:3] for each in (ground, ball))
        np.testing.assert_allclose(sum(forces) + felt, 0.0, atol=1e-5)
    assert mean[1] > 0.1
    assert -mean[0] == pytest.approx(mean[1] + mean[2], rel=0.02)
    assert len(high.contact_pressure) == len(high.surface_triangles)
    assert low.positions.numpy()[:, 2].min() > -1e-6


def test_a_general_mesh_lies_on_a_forest(device, rng):
    low = block(device, 0.0)
    box = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.015, level=3, origin=(0.01, 0.012, 0.0201))
    points = box.points.copy()
    inner = (points[:, 2] > points[:, 2].min() + 1e-9) & (points[:, 2] < points[:, 2].max() - 1e-9)
    points[inner] += rng.uniform(-5e-4, 5e-4, (inner.sum(), 3))
    high = block(device, 0.0, wc.TetMesh(points, box.tets))
    ground = wc.Ground()
    sim = wc.Simulation([low, high], obstacles=ground, gravity=DOWN, integrator=CALM)
    sim.advance(0.6)
    assert high.contact_forces.numpy()[:, 2].sum() == pytest.approx(weight(high), rel=2e-3)
    assert -ground.wrench.numpy()[0, 2] == pytest.approx(weight(low) + weight(high), rel=2e-3)


def test_runs_repeat(device):
    """Obstacles and soft surfaces, with deterministic=True on every device."""
    found = []
    for _ in range(2):
        low, high, tool = block(device, 0.0), block(device, 0.0202), wc.Tool(wc.Capsule(0.002, 0.02))
        tool.follow([0.0, 0.05], [(0.021, 0.02, 0.053), (0.023, 0.019, 0.05)])
        contact = wc.Contact(self_contact=True)
        sim = wc.Simulation(
            [low, high], obstacles=[wc.Ground(), tool], contact=contact, gravity=DOWN, deterministic=True
        )
        sim.advance(0.05)
        assert sim.contact.search.pairs > 0
        assert high.contact_forces.numpy()[:, 2].max() > 0.0
        found.append((low.positions.numpy(), high.positions.numpy(), tool.wrench.numpy()))
    for first, second in zip(*found, strict=True):
        np.testing.assert_array_equal(first, second)


@wp.func
def closeness(element: wc.remesh.ElementState, parameters: wp.array[wp.float32]):
    """How near an element is to a plane x = const, below a distance [m]."""
    return parameters[0] - wp.abs(element.corner[0] - parameters[1])


def force_on_places(sim):
    return sim.contact.rigid.forces.numpy().astype(float).sum(axis=(0, 1))


def test_contact_goes_on_through_passes(device):
    """A brick on a slope, at 0.9 of the angle of friction; each pass refines one half of its bottom and simplifies the
    other. Its surface between the former contact points hangs through below the slope, and is pushed out gently."""
    mesh = wc.TetForest.from_domain(wc.Domain.box((-0.013, -0.011, -0.007), (0.013, 0.011, 0.007)), target_elements=400)
    body, ground = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device), wc.Ground(offset=-0.007)
    near, every = wp.array([0.006, -0.01], dtype=wp.float32, device=device), 500
    options = {"max_level": int(mesh.levels.max()) + 1, "refine_above": 0.0, "simplify_below": -0.002}
    remesh = wc.OnlineRemesh(capacity=2000, every=every, criterion=closeness, parameters=near, **options)
    angle = 0.9 * np.arctan(0.5)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    contact = wc.Contact(friction=0.5)
    sim = wc.Simulation(body, obstacles=ground, contact=contact, gravity=gravity, integrator=CALM, remesh=remesh)
    sim.advance_steps(2 * every - 1)
    carried = []
    for number in range(4):
        near.assign(np.float32([0.006, 0.01 if number % 2 == 0 else -0.01]))
        version = body.version
        sim.advance_steps(1)
        assert body.version > version
        before = force_on_places(sim)
        sim.contact.prepare()
        np.testing.assert_allclose(force_on_places(sim), before, rtol=1e-5, atol=1e-5 * weight(body))
        sim.advance_steps(1)
        carried.append(-ground.wrench.numpy()[0, 2] / (weight(body) * np.cos(angle)))
        sim.advance_steps(every - 2)
    assert min(carried) > 0.2
    assert max(carried) < 2.0


@pytest.fixture
def coarser(device):
    """A ball of 20 mm, and a simulation in which each second step merges all its elements that may be merged."""
    box = wc.TetForest.box((1, 1, 1), 0.045, level=6, origin=(-0.0225, -0.0225, -0.0225))
    place = (box.cells, box.cell_size, box.origin, box.lattice, box.node_ends, box.tree, box.up_axis)
    mesh = wc.TetForest(*place, phi=np.linalg.norm(box.points, axis=1) - 0.02)
    body, low = wc.SoftBody(mesh, SOFT, device=device), wp.array([-1.0, 0.0], dtype=wp.float32, device=device)
    given = {"min_level": 3, "refine_above": 1.0, "simplify_below": 0.5, "criterion": closeness, "parameters": low}
    remesh = wc.OnlineRemesh(every=2, **given)
    still = {"gravity": (0.0, 0.0, 0.0), "integrator": CALM}
    return body, wc.Simulation(body, obstacles=wc.Ground(offset=-0.03), remesh=remesh, **still)


def test_contacts_are_listed_after_a_mesh_has_coarsened(device):
    """Without a surface of its own, the places of a body are its nodes, whose number falls."""
    mesh = wc.TetForest.box((2, 2, 1), 0.02, level=6, origin=(0.0, 0.0, 0.0))
    body, far = wc.SoftBody(mesh, SOFT, device=device), wp.array([-1.0, 0.0], dtype=wp.float32, device=device)
    given = {"min_level": 3, "refine_above": 1.0, "simplify_below": 0.5, "criterion": closeness, "parameters": far}
    ground = wc.Ground()
    remesh = wc.OnlineRemesh(every=5, **given)
    sim = wc.Simulation(body, obstacles=ground, gravity=DOWN, integrator=wc.BackwardEuler(dt=0.01), remesh=remesh)
    sim.advance_steps(4)
    assert len(sim.contacts()) > 30
    sim.advance_steps(20)
    assert body.node_count < mesh.node_count // 3
    found = sim.contacts()
    forces = body.contact_forces.numpy().astype(float).sum(axis=0)
    assert {each.body for each in found} == {body}
    assert max(max(each.nodes) for each in found) < body.node_count
    assert sum(each.normal_force for each in found) == pytest.approx(forces[2], rel=1e-5)
    np.testing.assert_allclose(ground.wrench.numpy()[0, :3], -forces, rtol=1e-5, atol=1e-6)


def test_the_surface_of_a_mesh_that_coarsens_keeps_its_shape(coarser):
    """Its points are about as near the drawn surface as those of the first mesh; without this they are 9 mm off."""
    body, sim = coarser
    drawn = body.mesh.surface()
    sim.advance_steps(21)
    assert body.element_count == 48
    found = body.contact_surface
    assert distances_from(found.points, found.triangles, drawn.points, 1.0).max() < 0.15 * 0.045 / 4.0
    assert found.volume == pytest.approx(drawn.volume, rel=0.03)


def test_the_contact_surface_can_be_read_after_a_pass(coarser):
    """It has the points and triangles to which the pressures of the last step belong, on the nodes of the new mesh."""
    body, sim = coarser
    sim.advance_steps(1)
    before, nodes = body.contact_surface, body.node_count
    sim.advance_steps(1)
    assert body.node_count < nodes
    after = body.contact_surface
    assert len(after.triangles) == len(body.contact_pressure)
    np.testing.assert_array_equal(after.points, before.points)
    np.testing.assert_array_equal(after.triangles, before.triangles)
    displaced = body.positions.numpy() * [0.1, -0.2, 0.3] + [0.0, 0.0, 1e-3]
    expected = after.points * [1.1, 0.8, 1.3] + [0.0, 0.0, 1e-3]
    np.testing.assert_allclose(after.moved(displaced), expected, rtol=0.0, atol=1e-6)
