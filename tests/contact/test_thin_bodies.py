"""Contact of plates, vessels and coarse meshes, whose surfaces are finer than their elements."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.contact.skin import own_surface
from warp_corot.mesh.surfaces.locating import distances_from

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
PLATE = wc.Domain.box((-0.03, -0.02, -0.001), (0.03, 0.02, 0.001))
VESSEL = wc.Domain.capsule((-0.02, 0, 0), (0.02, 0, 0), 0.006) - wc.Domain.capsule((-0.08, 0, 0), (0.08, 0, 0), 0.0045)


@pytest.fixture(scope="module")
def plate():
    """A plate of 2 mm in elements of 4 mm and more."""
    return wc.TetForest.from_domain(PLATE, target_elements=300)


@pytest.mark.parametrize(
    ("domain", "elements"), [(wc.Domain.sphere(0.02), 60), (PLATE, 300), (PLATE, 700), (VESSEL, 1000)]
)
def test_contact_surfaces_keep_their_shape(domain, elements):
    """Without smaller distances between points where they are needed, a ball of 60 elements touches up to a third of
    an element inside its surface, and the ends of a vessel and a plate up to 0.8 of one."""
    mesh = wc.TetForest.from_domain(domain, target_elements=elements)
    whole, thin = mesh.surface(), own_surface(mesh)
    size = (6.0 * mesh.volumes.mean()) ** (1.0 / 3.0)
    assert distances_from(thin.points, thin.triangles, whole.points, 0.1).max() < 0.2 * size
    assert len(thin.points) < len(whole.points)
    assert thin.volume == pytest.approx(whole.volume, rel=0.06)


def test_edges_and_corners_of_a_brick_stay():
    lower, upper = (-0.013, -0.011, -0.007), (0.013, 0.011, 0.007)
    mesh = wc.TetForest.from_domain(wc.Domain.box(lower, upper), target_elements=400)
    thin = own_surface(mesh)
    assert thin.volume == pytest.approx(np.prod(np.subtract(upper, lower)), rel=0.01)
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
    assert np.linalg.norm(thin.points[:, None] - corners, axis=2).min(axis=0).max() < 1e-3


def test_both_sides_of_a_plate_carry_the_same_force(plate, device):
    """A small ball presses a plate on the ground; the same nodes bear the points of both sides."""
    body, ground, ball = wc.SoftBody(plate, SOFT, device=device), wc.Ground(offset=-0.001), wc.Tool(wc.Sphere(0.005))
    ball.follow([0.0, 0.1], [(0.0, 0.0, 0.0062), (0.0, 0.0, 0.0057)])
    calm = wc.SymplecticEuler(viscosity=1e-3, damping=20.0)
    given = {"gravity": (0.0, 0.0, -9.81), "contact": wc.Contact(friction=0.0), "integrator": calm}
    sim = wc.Simulation(body, obstacles=[ground, ball], **given)
    sim.advance(0.3)
    found = []
    for _ in range(10):
        sim.advance(0.001)
        found.append([each.wrench.numpy()[0, 2] for each in (ground, ball)])
    carried, pressed = np.mean(found, axis=0)
    assert pressed > 0.02
    assert -carried == pytest.approx(pressed + 9.81 * body.masses.sum(), rel=1e-3)
    assert np.ptp(found, axis=0).max() < 2e-3 * pressed
    skin = plate.surface().moved(body.displacements.numpy())
    assert np.linalg.norm(skin - [0.0, 0.0, 0.0057], axis=1).min() > 0.005 - 2e-4
    # Without friction it may glide.
    assert np.abs(body.velocities.numpy()[:, 2]).max() < 1e-3


def test_implicit_steps_feel_a_ball_between_the_points_of_a_plate(plate, device):
    """The ball may not sink in unfelt by a fifth of its radius, which is half of the plate. Explicit steps give 1.8 N;
    in implicit ones the ball sinks in by a hundredth of the smallest element, and the plate is stiff across."""
    found = []
    for integrator in (wc.BackwardEuler(dt=0.005), wc.SymplecticEuler(viscosity=1e-3, damping=20.0)):
        body, ground = wc.SoftBody(plate, SOFT, device=device), wc.Ground(offset=-0.001)
        body.fix("x < xmin + 0.006")
        ball = wc.Tool(wc.Sphere(0.005))
        ball.follow([0.0, 0.1], [(0.0, 0.0, 0.0062), (0.0, 0.0, 0.0057)])
        given = {"gravity": (0.0, 0.0, -9.81), "contact": wc.Contact(friction=0.3), "integrator": integrator}
        sim = wc.Simulation(body, obstacles=[ground, ball], **given)
        sim.advance(0.2)
        found.append(ball.wrench.numpy()[0, 2])
        assert min(point.gap for point in sim.contacts()) > -7e-5
    assert 0.7 * found[1] < found[0] < 1.05 * found[1]
