"""Planes that cut bodies at once: topology, what is carried along, and the motion afterwards."""

import numpy as np
import pytest
import warp as wp
from cut_cases import assert_cut_sound
from remesh_cases import RemeshPass, counts_of, is_full, momentum, moving, random_marks
from remeshed import bar, near, twin

import warp_corot as wc
from warp_corot.discretization.changing.passes import CutPass, plane_surface
from warp_corot.kernels.remesh.cut_surface import Surface

STEPS = wc.SymplecticEuler(dt=2e-4, damping=1.0)


def random_plane(rng, mesh):
    normal = rng.normal(size=3)
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ rng.choice(mesh.points[mesh.tets].mean(axis=1)))


def adaptive(rng):
    mesh = wc.TetForest.box((2, 1, 1), 0.05, 4)
    for _ in range(2):
        mesh = mesh.refine(np.flatnonzero(rng.random(len(mesh.tets)) < 0.15))
    return mesh


def test_cuts_of_an_adaptive_forest_are_sound(device, rng):
    forest = moving(adaptive(rng), device, rng)
    cuts = CutPass(forest)
    before, size = momentum(forest)
    for k in range(6):
        normal, offset = random_plane(rng, forest.source)
        cuts.launch_cut(plane_surface(normal, offset, is_deformed=k % 2 == 1))
        assert_cut_sound(forest)
        assert counts_of(forest).added > 0
    np.testing.assert_allclose(momentum(forest)[0], before, atol=1e-12 * size)
    assert not is_full(forest)


def test_a_plane_separates_the_elements_on_both_sides(device, rng):
    forest = moving(adaptive(rng), device, rng)
    mesh = forest.source
    normal, offset = np.array([0.8, 0.6, 0.0]), 0.052
    CutPass(forest).launch_cut(plane_surface(normal, offset, is_deformed=False))
    cut = assert_cut_sound(forest)
    front = mesh.points[mesh.tets].mean(axis=1) @ normal >= offset
    piece = cut.pieces()
    assert piece.max() == 1
    # But for lone elements, which stay with the others.
    assert np.count_nonzero((piece == piece[np.argmax(front)]) != front) <= 2
    # The area is that of the plane within the body, but for a rim as rough as the elements.
    assert forest.carriage.arrays.cut_area.numpy()[0] == pytest.approx(0.05**2 / 0.8, rel=0.08)


def test_cut_forests_are_refined_and_simplified(device, rng):
    """No pass heals a cut, and midpoints on cut faces are made for each side."""
    forest = moving(wc.TetForest.box((2, 1, 1), 0.05, 5), device, rng)
    cuts, passes = CutPass(forest), RemeshPass(forest, max_level=9)
    normal, offset = np.array([0.6, 0.8, 0.0]), 0.07
    cuts.launch_cut(plane_surface(normal, offset, is_deformed=False))
    before, size = momentum(forest)
    for _ in range(6):
        passes.apply(random_marks(forest, rng, 0.1, 0.5))
        cuts.launch_after_pass()
        mesh = assert_cut_sound(forest)
        assert mesh.pieces().max() == 1
    np.testing.assert_allclose(momentum(forest)[0], before, atol=1e-6 * size)
    passes.apply(np.full(forest.leaf_count, -1))
    for _ in range(12):
        passes.apply(np.full(forest.leaf_count, -1))
        cuts.launch_after_pass()
    mesh = assert_cut_sound(forest)
    assert mesh.pieces().max() == 1
    assert len(mesh.tets) < len(forest.source.tets)


@pytest.mark.parametrize("model", [wc.Corotated(), wc.Corotated(rotation_level=3), wc.NeoHookean()])
def test_a_cut_body_moves_as_one_that_was_cut_before(model, device):
    body = bar(device)
    sim = wc.Simulation(body, model=model, integrator=STEPS, cuts=[])
    sim.advance(0.04)
    sim.cut(wc.Plane((1.0, 0.2, 0.1), 0.12))
    sim.cut(wc.Plane((0.1, 1.0, 0.0), 0.03))
    assert body.pieces == 4
    other = twin(body, model, sim)
    sim.advance(0.02)
    other.advance(0.02)
    np.testing.assert_allclose(body.positions.numpy(), other.body.positions.numpy(), atol=1e-6)


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_cut_body_rests_as_one_that_was_cut_before(precision, device):
    body = bar(device, poisson=0.48)
    sim = wc.Simulation(body, integrator=STEPS, cuts=[])
    sim.cut(wc.Plane((0.1, 1.0, 0.0), 0.03))
    sim.advance(0.01)
    other = twin(body, wc.Corotated(), sim).body
    for each in (body, other):
        each.displacements = np.zeros((each.node_count, 3))
        report = wc.solve_static(each, gravity=(0, -9.81, 0), precision=precision)
        assert report.converged, report.message
    assert body.pieces == 2
    np.testing.assert_allclose(body.positions.numpy(), other.positions.numpy(), atol=2e-6)
    sim.advance(0.01)


def test_a_shared_dilatation_does_not_reach_across_a_cut(device):
    """Elements on one side do not feel how those on the other are squeezed."""
    body = bar(device, poisson=0.48)
    sim = wc.Simulation(body, integrator=STEPS, gravity=(0, 0, 0), cuts=[])
    sim.cut(wc.Plane((1.0, 0.3, 0.1), 0.1))
    piece = body.mesh.pieces()
    side = np.zeros(body.node_count, int)
    side[body.mesh.tets] = piece[:, None]
    body.displacements = np.where(side[:, None] == 0, 0.2 * body.mesh.points, 0.0)
    forces = sim.forces().numpy()
    assert np.abs(forces[side == 0]).max() > 1e-3
    assert np.abs(forces[side == 1]).max() < 1e-6


def test_a_bar_that_is_cut_through_falls_apart(device):
    body = bar(device)
    sim = wc.Simulation(body, integrator=STEPS, gravity=(0, -9.81, 0))
    sim.advance(0.02)
    momenta = body.masses @ body.velocities.numpy().astype(float)
    assert sim.cut(wc.Plane(normal=(1, 0, 0), point=(0.1, 0, 0))) == pytest.approx(0.05**2, rel=0.02)
    np.testing.assert_allclose(body.masses @ body.velocities.numpy().astype(float), momenta, rtol=1e-6)
    assert body.pieces == 2
    assert body.cut_area == pytest.approx(0.05**2, rel=0.02)
    side = np.zeros(body.node_count, int)
    side[body.mesh.tets] = body.mesh.pieces()[:, None]
    loose = side != side[np.argmax(body.constrained)]
    v = (body.masses @ body.velocities.numpy())[1] * 0.0 + np.average(
        body.velocities.numpy()[loose, 1], weights=body.masses[loose]
    )
    sim.advance(0.1)
    after = np.average(body.velocities.numpy()[loose, 1], weights=body.masses[loose])
    expected = v * np.exp(-0.1) - 9.81 * (1 - np.exp(-0.1))
    assert after == pytest.approx(expected, rel=0.01)


def test_supports_motions_and_loads_are_carried(device):
    body = bar(device)
    end = body.mesh.points[:, 0] > 0.2 - 1e-9
    body.prescribe(end, times=[0.0, 0.05], displacements=[[0, 0, 0], [0.01, 0, 0]])
    body.load(~end, [0.0, 1.0, 0.0])
    total = body.loads.numpy().sum(axis=0)
    sim = wc.Simulation(body, integrator=STEPS, gravity=(0, 0, 0))
    sim.cut(wc.Plane((0, 0.2, 1.0), 0.03))
    assert body.pieces == 2
    points = body.mesh.points
    np.testing.assert_array_equal(body.constrained, (points[:, 0] < 1e-9) | (points[:, 0] > 0.2 - 1e-9))
    np.testing.assert_allclose(body.loads.numpy().sum(axis=0), total, rtol=1e-6)
    sim.advance(0.06)
    end = points[:, 0] > 0.2 - 1e-9
    np.testing.assert_allclose(body.displacements.numpy()[end], np.tile([0.01, 0, 0], (end.sum(), 1)), atol=1e-6)
    np.testing.assert_array_equal(body.displacements.numpy()[points[:, 0] < 1e-9], 0.0)


def slit(corners, device):
    """A triangle in the body at rest, [3, 3] [m]."""
    surface = Surface()
    surface.count = 1
    surface.points = wp.array(corners, dtype=wp.vec3d, device=device)
    surface.triangles = wp.array([[0, 1, 2]], dtype=wp.vec3i, device=device)
    box = np.stack([corners.min(axis=0), corners.max(axis=0)])
    surface.bounds = wp.array(np.tile(box, (2, 1)), dtype=wp.vec3d, device=device)
    surface.levels = wp.array([-1], dtype=wp.int32, device=device)
    surface.debt = wp.zeros(1, dtype=wp.float64, device=device)
    return surface


def test_a_hundred_slits_hardly_slow_implicit_steps(device, rng):
    found = []
    for count in (0, 100):
        body = bar(device, level=5)
        sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.01), gravity=(0, -9.81, 0), cuts=[])
        for _ in range(count):
            centre = rng.uniform([0.02, 0.0, 0.0], [0.2, 0.05, 0.05])
            body.changing.cut(slit(centre + 0.015 * rng.normal(size=(3, 3)), device))
        assert body.cut_area > 0.0 or not count
        sim.advance_steps(8)
        assert sim.solves.unfinished == 0
        found.append(sim.solves.linear_iterations)
    assert found[1] < 1.5 * found[0]


def test_reset_heals(device):
    body = bar(device)
    sim = wc.Simulation(body, integrator=STEPS, cuts=[])
    first = body.mesh
    sim.cut(wc.Plane((1, 0, 0), 0.1))
    sim.advance(0.01)
    sim.reset()
    np.testing.assert_array_equal(body.mesh.tets, first.tets)
    assert body.pieces == 1
    assert body.cut_area == 0.0


def test_remeshing_goes_on_after_a_cut(device):
    body = bar(device)
    sim = wc.Simulation(body, integrator=STEPS, remesh=near(0.1, device), cuts=[])
    sim.advance_steps(10)
    sim.cut(wc.Plane((1, 0.2, 0), 0.1))
    assert body.pieces == 2
    sim.advance_steps(20)
    assert body.pieces == 2
    assert np.isfinite(body.positions.numpy()).all()
    assert_cut_sound(body.changing.forest)


def test_a_bar_tears_where_it_is_pulled_too_hard(device):
    """Beyond a stress, but not below it; from a notch, and at once only where it is pulled most."""
    areas, pieces = [], []
    for bound in (1e5, 6e3):
        body = bar(device)
        # The slit cuts a fifth of the height.
        blade = wc.Blade([(0, 0, -0.01), (0, 0, 0.06)], position=(0.101, 0.055, 0))
        blade.follow([0.0, 0.015, 0.03], [(0.101, 0.055, 0), (0.101, 0.042, 0), (0.101, 0.07, 0)])
        body.prescribe("x == xmax", times=[0.03, 0.23], displacements=[[0, 0, 0], [0.03, 0, 0]])
        sim = wc.Simulation(body, gravity=(0, 0, 0), cuts=[blade], integrator=wc.SymplecticEuler(damping=30.0))
        sim.advance(0.03)
        slit = body.cut_area
        assert 0.0 < slit < 0.001
        sim.on_step(lambda sim, bound=bound: sim.tear(bound), every=5)
        sim.advance(0.25)
        assert_cut_sound(body.changing.forest)
        areas.append(body.cut_area - slit)
        pieces.append(body.pieces)
    assert areas[0] == 0.0
    assert 0.5 * 0.05**2 < areas[1] < 3.0 * 0.05**2  # faces that tear are not in one plane
    assert pieces[0] == 1 < pieces[1]


def test_what_cannot_be_cut_is_said_in_one_line(device):
    mesh = wc.TetForest.box((1, 1, 1), 0.05, 3)
    material = wc.Isotropic(3e4, 0.4, 1000.0)
    sim = wc.Simulation(wc.SoftBody(mesh, material, device=device))
    for given in (None, (1, 0, 0), wc.Ground()):
        with pytest.raises(wc.InputError, match="must be a Plane"):
            sim.cut(given)
    for bad in ({"normal": (0, 0, 0)}, {"normal": (np.nan, 0, 0)}, {"normal": (1, 0, 0), "offset": np.inf}):
        with pytest.raises(wc.InputError, match=r"normal|offset"):
            wc.Plane(**bad)
    general = wc.Simulation(wc.SoftBody(wc.TetMesh(mesh.points, mesh.tets), material, device=device))
    with pytest.raises(wc.InputError, match="only a TetForest can be remeshed or cut"):
        general.cut(wc.Plane((1, 0, 0), 0.02))
    general.advance_steps(2)
    worlds = wc.Simulation(wc.SoftBody(mesh, material, worlds=2, device=device))
    with pytest.raises(wc.InputError, match="only a body in one world"):
        worlds.cut(wc.Plane((1, 0, 0), 0.02))
    assert sim.cut(wc.Plane((1, 0, 0), 7.0)) == 0.0
    for stress in (0.0, -1.0, np.nan, "a"):
        with pytest.raises(wc.InputError, match="stress is"):
            sim.tear(stress)
    assert sim.tear(1e3) == 0.0
