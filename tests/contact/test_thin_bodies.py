"""Contact of plates, vessels and coarse meshes, whose surfaces are finer than their elements."""

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.contact.skin import own_surface
from warp_corot.mesh.surfaces.bound import distances_from

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
PLATE = wc.Domain.box((-0.03, -0.02, -0.001), (0.03, 0.02, 0.001))
DOWN = (0.0, 0.0, -9.81)
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
    an element inside its surface, and the ends of a vessel and a plate up to 0.8 of one. Single points of a vessel's
    rims stay up to a third of one away."""
    mesh = wc.TetForest.from_domain(domain, target_elements=elements)
    whole, thin = mesh.surface(), own_surface(mesh, is_close=False)
    size = (6.0 * mesh.volumes.mean()) ** (1.0 / 3.0)
    far = distances_from(thin.points, thin.triangles, whole.points, 0.1)
    assert far.max() < (0.33 if domain is VESSEL else 0.2) * size
    assert np.sqrt((far**2).mean()) < 0.04 * size
    assert len(thin.points) < len(whole.points)
    assert thin.volume == pytest.approx(whole.volume, rel=0.06)


def test_edges_and_corners_of_a_brick_stay():
    lower, upper = (-0.013, -0.011, -0.007), (0.013, 0.011, 0.007)
    mesh = wc.TetForest.from_domain(wc.Domain.box(lower, upper), target_elements=400)
    thin = own_surface(mesh, is_close=False)
    assert thin.volume == pytest.approx(np.prod(np.subtract(upper, lower)), rel=0.01)
    corners = np.stack(np.meshgrid(*zip(lower, upper, strict=True)), axis=-1).reshape(-1, 3)
    assert np.linalg.norm(thin.points[:, None] - corners, axis=2).min(axis=0).max() < 1e-3


def test_both_sides_of_a_plate_carry_the_same_force(plate, device):
    """A small ball presses a plate on the ground; the same nodes bear the points of both sides. Friction keeps it
    there, or it would glide away.
    """
    body, ground, ball = wc.SoftBody(plate, SOFT, device=device), wc.Ground(offset=-0.001), wc.Tool(wc.Sphere(0.005))
    ball.follow([0.0, 0.1], [(0.0, 0.0, 0.0062), (0.0, 0.0, 0.0057)])
    calm = wc.SymplecticEuler(viscosity=1e-3, damping=20.0)
    given = {"gravity": DOWN, "contact": wc.Contact(friction=0.3), "integrator": calm}
    sim = wc.Simulation(body, obstacles=[ground, ball], **given)
    sim.advance(0.3)
    found = []
    for _ in range(10):
        sim.advance(0.001)
        found.append([each.wrench.numpy()[0, 2] for each in (ground, ball)])
    carried, pressed = np.mean(found, axis=0)
    assert pressed > 0.02
    assert -carried == pytest.approx(pressed + 9.81 * body.masses.sum(), rel=1e-3)
    assert np.ptp(found, axis=0).max() < 1e-4 * pressed
    skin = plate.surface().moved(body.displacements.numpy())
    assert np.linalg.norm(skin - [0.0, 0.0, 0.0057], axis=1).min() > 0.005 - 2e-4
    assert np.abs(body.velocities.numpy()).max() < 1e-3


def pressed_by_a_ball(mesh, device, integrator, *, half, press, friction):
    """Forces of a ball on a plate or a vessel of a height of 2 half that lies on the ground, in the last 0.1 of 0.3 s.

    The ball goes down by ``press`` in 0.1 s; one end is held.
    """
    body, ground, ball = wc.SoftBody(mesh, SOFT, device=device), wc.Ground(offset=-half), wc.Tool(wc.Sphere(0.005))
    body.fix("x < xmin + 0.006")
    ball.follow([0.0, 0.1], [(0.0, 0.0, half + 0.0052), (0.0, 0.0, half + 0.005 - press)])
    given = {"gravity": DOWN, "contact": wc.Contact(friction=friction), "integrator": integrator}
    sim = wc.Simulation(body, obstacles=[ground, ball], **given)
    sim.advance(0.2)
    found = []
    for _ in range(10):
        sim.advance(0.01)
        found.append(ball.wrench.numpy()[0, 2])
    assert min(point.gap for point in sim.contacts()) > -1e-5
    return np.array(found)


THIN = {
    "plate": (PLATE, 300, {"half": 0.001, "press": 0.0003}),
    "plate of 1 mm": (
        wc.Domain.box((-0.03, -0.02, -0.0005), (0.03, 0.02, 0.0005)),
        300,
        {"half": 0.0005, "press": 0.00015},
    ),
    "vessel": (VESSEL, 1000, {"half": 0.006, "press": 0.002}),
}
SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("name", "friction", "steps"),
    [
        ("plate", 0.3, [0.005]),
        ("plate of 1 mm", 0.3, [0.01]),
        pytest.param("plate", 0.0, [0.0025, 0.005, 0.01], marks=SLOW),
        pytest.param("plate", 0.3, [0.0025, 0.01], marks=SLOW),
        pytest.param("plate of 1 mm", 0.0, [0.0025, 0.005, 0.01], marks=SLOW),
        pytest.param("plate of 1 mm", 0.3, [0.0025, 0.005], marks=SLOW),
        pytest.param("vessel", 0.05, [0.0025, 0.005, 0.01], marks=SLOW),
        pytest.param("vessel", 0.3, [0.0025, 0.005, 0.01], marks=SLOW),
    ],
)
def test_implicit_steps_press_thin_bodies_as_explicit_ones_do(device, name, friction, steps):
    """The force of a ball is that of explicit steps to a tenth, and steady to a twentieth, for steps of any length.

    Without friction plates are about to glide from under the ball: damping keeps them there on the CPU, and elsewhere
    rounding may decide. A vessel does glide away.
    """
    domain, elements, case = THIN[name]
    mesh = wc.TetForest.from_domain(domain, target_elements=elements)
    calm = wc.SymplecticEuler(viscosity=1e-3, damping=20.0)
    explicit = pressed_by_a_ball(mesh, device, calm, friction=friction, **case).mean()
    for dt in steps:
        felt = pressed_by_a_ball(mesh, device, wc.BackwardEuler(dt=dt, damping=20.0), friction=friction, **case)
        assert felt.mean() == pytest.approx(explicit, rel=0.1)
        assert np.abs(felt - felt.mean()).max() < 0.05 * felt.mean()


def test_a_soft_coarse_body_is_not_drawn_below_the_ground(device):
    """Elements that its weight presses flat carried the drawn surface between the points that touch through the ground
    by 1.1 % of the ring's size."""
    ring = wc.Domain.from_function(
        lambda x: np.hypot(np.hypot(x[:, 0], x[:, 1]) - 0.05, x[:, 2]) - 0.012,
        [(-0.07, -0.07, -0.02), (0.07, 0.07, 0.02)],
    )
    mesh = wc.TetForest.from_domain(ring, target_elements=3000)
    body = wc.SoftBody(mesh, wc.Isotropic(young=1e3, poisson=0.4, density=1000.0), device=device)
    steps = wc.BackwardEuler(0.02, damping=5.0)
    sim = wc.Simulation(body, obstacles=[wc.Ground(offset=-0.012)], gravity=DOWN, integrator=steps)
    sim.advance(0.4)
    drawn = mesh.surface().moved(body.displacements.numpy())
    assert drawn[:, 2].min() > -0.012 - 0.002 * 0.124
    assert sim.obstacles[0].wrench.numpy()[0][2] == pytest.approx(-9.81 * body.masses.sum(), rel=0.02)
