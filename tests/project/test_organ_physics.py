"""Bodies from domains under load: adaptive, cut meshes carry the loads of fine uniform ones."""

import numpy as np
import pytest

import warp_corot as wc

DENSITY = 1000.0
RADIUS = 0.05
LENGTH, SIDE, LAYER = 0.12, 0.03, 0.01
STIFF, SOFT = 2e4, 4e3


def moved(mesh, body, points):
    """Displacements at points of the rest shape [m], [n, 3]."""
    elements, weights = mesh.embed(points)
    return np.einsum("nk,nkc->nc", weights, body.displacements.numpy()[mesh.tets[elements]])


def settled(body, gravity, damping, seconds, held):
    body.fix(held)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=damping), gravity=gravity)
    sim.advance(seconds)
    # Its further motion in a tenth of the time is far below any tolerance here.
    assert np.abs(body.velocities.numpy()).max() * 0.1 * seconds < 1e-4
    return sim


def dome(device, **size):
    """The upper half of a ball leans over; the lower half is fixed, so that the support is the same on every mesh."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(RADIUS, device=device), 0.04, **size)
    body = wc.SoftBody(mesh, wc.Isotropic(3e3, 0.3, DENSITY), device=device)
    gravity = 9.81 * np.array([0.6, -0.8, 0.0])
    settled(body, gravity, 40.0, 1.0, mesh.points[:, 1] < 1e-9)
    weight = body.masses.sum() * gravity
    np.testing.assert_allclose(body.reactions.numpy().sum(axis=0), -weight, atol=1e-3 * np.abs(weight).max())
    at = [[0.0, 0.045, 0.0], [0.0, 0.025, 0.0], [0.025, 0.02, 0.01], [-0.02, 0.03, -0.01]]
    return len(mesh.tets), moved(mesh, body, np.array(at))


def layered_domain(device):
    """A beam with a stiff layer below a soft one; their border runs through elements."""
    layer = wc.Domain.box((0, 0, 0), (LENGTH, LAYER, SIDE), device=device).named("stiff")
    return layer | wc.Domain.box((0, 0, 0), (LENGTH, SIDE, SIDE), device=device).named("soft")


def beam(device, gravity=1.0, poisson=0.3, damping=8.0, seconds=2.5, **size):
    mesh = wc.TetForest.from_domain(layered_domain(device), 0.03, **size)
    young = np.where(mesh.elements_of("stiff"), STIFF, SOFT)
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, DENSITY), device=device)
    settled(body, (0.0, -gravity, 0.0), damping, seconds, mesh.points[:, 0] < 1e-9)
    at = [[LENGTH, SIDE / 2, SIDE / 2], [LENGTH / 2, SIDE / 2, SIDE / 2], [LENGTH, 0.0, 0.0]]
    return len(mesh.tets), moved(mesh, body, np.array(at))


def apart(one, other):
    """The largest difference of displacements over the largest displacement."""
    return np.abs(one - other).max() / np.abs(other).max()


# Both meshes have linear tetrahedra. Displacement errors scale with the square of the edge length inside and, in cut
# elements, with that of the surface's height over its chords. So adaptive meshes, fine at surfaces and borders and up
# to twice as coarse within, must be close to the fine uniform mesh, and far closer than one twice as coarse.


def test_dome_on_adaptive_and_uniform_meshes(device):
    fine = dome(device, min_level=9, max_level=9)
    coarse = dome(device, min_level=6, max_level=6)
    adaptive = dome(device, min_level=6, max_level=12, surface_error=2e-4)
    assert adaptive[0] < 0.6 * fine[0]
    assert apart(adaptive[1], fine[1]) < 0.01
    assert apart(adaptive[1], fine[1]) < 0.5 * apart(coarse[1], fine[1])


def test_two_layer_beam_on_adaptive_and_uniform_meshes(device):
    fine = beam(device, min_level=9, max_level=9)
    coarse = beam(device, min_level=6, max_level=6)
    adaptive = beam(device, min_level=6, max_level=9, surface_error=1e-3)
    assert adaptive[0] < 0.5 * fine[0]
    assert apart(adaptive[1], fine[1]) < 0.04
    assert apart(adaptive[1], fine[1]) < 0.5 * apart(coarse[1], fine[1])


@pytest.mark.slow
@pytest.mark.parametrize(("body", "level", "error", "fall"), [(dome, 15, 5e-5, 0.4), (beam, 12, 1e-3, 0.3)])
def test_meshes_twice_as_fine(body, level, error, fall, device):
    """Relative to a uniform mesh of level 12, an adaptive one is as good as the uniform one of its inner level,
    9, or better: refinement at surfaces and borders does no harm. It need not gain much: errors of a beam's bending
    come from the inner edges (3.6 % both), those of a ball's lean also from its surface. From
    level 6 to 9, differences of second order fall to a fifth, and those of first order to a third; where the fixed half
    of the ball begins, at a kink of its surface, they are of first order."""
    coarse = body(device, min_level=6, max_level=6)
    finest = body(device, min_level=12, max_level=12)
    uniform = body(device, min_level=9, max_level=9)
    adaptive = body(device, min_level=9, max_level=level, surface_error=error)
    assert uniform[0] < adaptive[0] < 0.7 * finest[0]
    assert apart(uniform[1], finest[1]) < fall * apart(coarse[1], finest[1])
    assert apart(adaptive[1], finest[1]) < 1.05 * apart(uniform[1], finest[1])


def test_two_layer_beam_bends_as_theory_says(device):
    """Euler and Bernoulli's sag of a clamped beam under its weight, q L^4 / (8 EI), about the layers' common neutral
    axis; shear adds 2 % for a beam four times as long as high, and linear tetrahedra are a few per cent too stiff."""
    areas = SIDE * np.array([LAYER, SIDE - LAYER])
    middles, heights = np.array([LAYER / 2, (SIDE + LAYER) / 2]), np.array([LAYER, SIDE - LAYER])
    young = np.array([STIFF, SOFT])
    neutral = (young * areas * middles).sum() / (young * areas).sum()
    rigidity = (young * (SIDE * heights**3 / 12 + areas * (middles - neutral) ** 2)).sum()
    gravity = 0.02  # small: a sag of 1 mm
    sag = DENSITY * SIDE**2 * gravity * LENGTH**4 / (8 * rigidity)
    _, found = beam(device, gravity, poisson=0.0, damping=15.0, seconds=1.5, min_level=9, max_level=9)
    assert -found[0, 1] == pytest.approx(sag, rel=0.04)


# --- mass and stiffness ----------------------------------------------------------------------------------------------


def test_mass_is_the_domains(device):
    """It is less than the ball's by the surface's height over its chords: a quarter when edges are halved."""
    exact = DENSITY * 4 / 3 * np.pi * RADIUS**3
    missing = []
    for level in (6, 9):
        mesh = wc.TetForest.from_domain(wc.Domain.sphere(RADIUS, device=device), 0.04, max_level=level)
        body = wc.SoftBody(mesh, wc.Isotropic(3e3, 0.3, DENSITY), device=device)
        missing.append(1 - body.masses.sum() / exact)
    assert 0 < missing[1] < 0.01
    assert missing[0] / missing[1] == pytest.approx(4.0, rel=0.15)


def test_mass_of_two_densities_is_that_of_their_layers(device):
    domain = layered_domain(device)
    mesh = wc.TetForest.from_domain(domain, 0.03, min_level=9, max_level=9)
    density = np.where(mesh.elements_of("stiff"), 2000.0, 500.0)
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.3, density), device=device)
    exact = LENGTH * SIDE * (2000.0 * LAYER + 500.0 * (SIDE - LAYER))
    # An element has only the label of its larger part: the error is a fraction of the elements on the border.
    assert body.masses.sum() == pytest.approx(exact, rel=0.04)


@pytest.mark.parametrize("sliver", [0.02, 0.0])
@pytest.mark.parametrize("seed", range(2))
def test_no_node_is_left_without_stiffness(seed, sliver, device):
    """For any cut: the stable step is that of whole elements within 10 %, and the lightest nodes
    vibrate as fast as in whole elements: stiffness scales with mass."""
    rng = np.random.default_rng(seed)
    ball = wc.Domain.sphere(RADIUS * rng.uniform(0.8, 1.2), rng.uniform(-0.02, 0.02, 3), device=device)
    mesh = wc.TetForest.from_domain(ball, 0.04, max_level=9, surface_error=5e-4, sliver=sliver)
    assert mesh.fill.min() < 0.1
    bodies = [
        wc.SoftBody(m, wc.Isotropic(3e3, 0.45, DENSITY), device=device)
        for m in (mesh, wc.TetMesh(mesh.points, mesh.tets))
    ]
    sims = [wc.Simulation(body) for body in bodies]
    assert sims[0].stable_dt > 0.9 * sims[1].stable_dt
    masses, whole = (body.masses for body in bodies)
    assert (masses > 0).all()
    lightest = np.argsort(masses / whole)[:3]
    assert (masses[lightest] < 0.3 * whole[lightest]).all()
    for node in lightest:
        rates = [swing(sim, body, node) for sim, body in zip(sims, bodies, strict=True)]
        assert rates[0] == pytest.approx(rates[1], rel=0.5)


def swing(sim, body, node):
    """Sum of the node's squared frequencies along the axes, its neighbours held [1/s^2]."""
    total, step = 0.0, 1e-6
    for axis in range(3):
        u = np.zeros((body.node_count, 3))
        u[node, axis] = step
        body.displacements = u
        total -= sim.forces().numpy()[node, axis] / (step * body.masses[node])
    return total


def test_a_cut_body_stays_stable_at_the_step_that_is_found(device):
    """Its lightest nodes are kicked, undamped: the energy oscillates, as with symplectic steps, but does not
    grow."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(RADIUS, (0.003, 0.007, -0.005), device=device), 0.04, max_level=9)
    body = wc.SoftBody(mesh, wc.Isotropic(3e3, 0.45, DENSITY), device=device)
    velocities = np.zeros((body.node_count, 3))
    velocities[np.argsort(body.masses)[:50]] = [0.05, -0.1, 0.08]
    body.velocities = velocities
    sim = wc.Simulation(body, gravity=(0.0, 0.0, 0.0))

    def highest(steps):
        found = []
        for _ in range(20):
            sim.advance_steps(steps // 20)
            found.append(sim.energy().total)
        return max(found)

    assert highest(400) < 3.0 * 0.5 * body.masses @ (velocities**2).sum(axis=1)
    early = highest(400)
    sim.advance_steps(2000)
    assert highest(400) < 1.2 * early
