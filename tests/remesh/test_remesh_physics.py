"""Remeshed bodies give the results of uniform fine meshes with a fraction of the elements."""

import functools

import numpy as np
import pytest
import warp as wp
from remesh_cases import RemeshPass, set_nodes
from studies import study

import warp_corot as wc
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.remesh.criteria import nearness, strain, von_mises_stress

SAVINGS = study("remesh_savings")
CELL, SCENES, TISSUE, run, table = (getattr(SAVINGS, name) for name in ("CELL", "SCENES", "TISSUE", "run", "table"))
SLOW = [pytest.param("bar", each, marks=pytest.mark.slow) for each in ("elongation", "strain")]
CASES = [*SLOW, ("slab", "nearness")]
LEVELS = [9, pytest.param(10, marks=pytest.mark.slow), pytest.param(11, marks=pytest.mark.slow)]


@functools.cache
def uniform(name, level, device, coarse):
    return run(SCENES[name], level, wp.get_device(device), coarse=coarse)


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize(("name", "criterion"), CASES)
def test_remeshed_bodies_resist_and_move_as_finely_meshed_ones(name, criterion, level, device):
    """Within 2 % of the force and of all displacements, with a fifth of the elements; coarse meshes are not."""
    fine, coarse = (uniform(name, level, device, which) for which in (False, True))
    found = run(SCENES[name], level, wp.get_device(device), criterion)
    print(*table(SCENES[name], [fine, coarse, found]), sep="\n")
    assert max(outcome.unrest for outcome in (fine, coarse, found)) < 1e-8
    assert found.most <= fine.elements / 5
    assert max(map(abs, found.errors(fine).values())) < 0.02
    assert max(map(abs, coarse.errors(fine).values())) > 0.02


def test_a_released_bar_is_coarse_again(device):
    """A bar that is stretched and brought back has its initial mesh and masses, and is straight."""
    scene = SCENES["bar"]
    mesh = scene.mesh(5)
    body = wc.SoftBody(mesh, TISSUE, device=device)
    mass = body.masses.copy()
    cubes = mesh.points / CELL
    body.fix(scene.held(cubes))
    body.prescribe(scene.moved(cubes), times=[0.0, 0.3, 0.6], displacements=[[0, 0, 0], scene.travel, [0, 0, 0]])
    sim = wc.Simulation(
        body,
        integrator=wc.SymplecticEuler(damping=60.0),
        gravity=(0, 0, 0),
        remesh=scene.remesh("strain", 9, wp.get_device(device)),
    )
    sim.advance(0.3)
    assert body.element_count > 1.3 * len(mesh.tets)
    pulled = body.reactions.numpy()[scene.moved(body.mesh.points / CELL)].sum(axis=0)
    sim.advance(1.0)
    back = body.mesh
    assert len(back.tets) == len(mesh.tets)
    assert np.array_equal(np.sort(back.lattice[back.tets], axis=1), np.sort(mesh.lattice[mesh.tets], axis=1))
    left = body.reactions.numpy()[scene.moved(back.points / CELL)].sum(axis=0)
    assert pulled[0] > 0.5
    assert np.abs(left).max() < 1e-3 * pulled[0]
    assert np.abs(body.displacements.numpy()).max() < 1e-3 * scene.travel[0]
    assert np.allclose(np.sort(body.masses), np.sort(mass), rtol=1e-12)


# --- the criteria -----------------------------------------------------------------------------------------------------


def marked(forest, gradient, criterion, parameters, threshold, device):
    """The leaves where a criterion is above a threshold, at a uniform deformation gradient."""
    adaptive = DeviceForest(forest, len(forest.tets), device=device)
    set_nodes(adaptive.carriage, displacements=forest.points @ (gradient - np.eye(3)).T)
    numbers = wp.array(parameters, dtype=wp.float32, device=device)
    mark = RemeshPass(adaptive, criterion=criterion, refine_above=threshold, simplify_below=0.0, parameters=numbers)
    mark.run()
    return adaptive.pools.marks.numpy() == 1


@pytest.mark.parametrize("level", [3, 4, 5])
def test_the_strain_criterion_sees_strain_and_no_rotation(level, device, rng):
    forest = wc.TetForest.box((1, 1, 1), 0.1, level)
    gradient = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    green = 0.5 * (gradient.T @ gradient - np.eye(3))
    rotation = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    rotation *= np.linalg.det(rotation)
    edge = 0.1 / 2 ** (level // 3) * np.sqrt(3 - level % 3)
    value = np.linalg.norm(green) * edge / 0.02
    for turned in (gradient, rotation @ gradient):
        assert marked(forest, turned, strain, [0.02], 0.999 * value, device).all()
        assert not marked(forest, turned, strain, [0.02], 1.001 * value, device).any()
    assert not marked(forest, rotation, strain, [0.02], 1e-4, device).any()


def test_the_nearness_criterion_goes_by_the_moved_place(device, rng):
    """Longest edge over the distance of the moved centroid from a rounded box, in float64."""
    forest = wc.TetForest.box((2, 1, 1), 0.1, 4)
    gradient = np.eye(3) + 0.3 * rng.normal(size=(3, 3))
    centre, half, radius, more = np.array([0.05, 0.1, 0.02]), np.array([0.02, 0.0, 0.03]), 0.02, 0.01
    centroids = forest.points[forest.tets].mean(axis=1) @ gradient.T
    outside = np.linalg.norm(np.maximum(np.abs(centroids - centre) - half, 0.0), axis=1)
    value = 0.05 * np.sqrt(2.0) / (np.maximum(outside - radius, 0.0) + more)
    threshold = np.quantile(value, 0.4)
    clear = np.abs(value / threshold - 1.0) > 1e-5
    found = marked(forest, gradient, nearness, [*centre, *half, radius, more], threshold, device)
    assert np.array_equal(found[clear], (value > threshold)[clear])
    assert clear.mean() > 0.9


@pytest.mark.parametrize("varied", [False, True], ids=["uniform", "varied"])
def test_the_stress_criterion_goes_by_the_bodys_stress(varied, device, rng):
    forest = wc.TetForest.box((2, 1, 1), 0.1, 5)
    young = rng.uniform(1e3, 1e5, len(forest.tets)) if varied else 1e4
    body = wc.SoftBody(forest, wc.Isotropic(young, 0.4, 1000.0), device=device)
    body.displacements = 2e-3 * rng.normal(size=(body.node_count, 3))
    sim = wc.Simulation(body)
    value = sim.von_mises() * 0.05 / 0.02  # longest edges of level 5 are 0.05 m
    threshold = float(np.quantile(value, 0.4))
    clear = np.abs(value / threshold - 1.0) > 1e-3
    numbers = wp.array([0.02], dtype=wp.float32, device=device)
    other = wc.SoftBody(forest, body.material, device=device)
    other.displacements = body.displacements
    options = {"refine_above": threshold, "simplify_below": 0.0, "min_level": 0, "max_level": 12, "parameters": numbers}
    remesh = wc.OnlineRemesh(criterion=von_mises_stress, capacity=len(forest.tets), every=1, **options)
    changing = wc.Simulation(other, remesh=remesh).remeshing.changing[0]
    changing.run()
    found = changing.forest.pools.marks.numpy()[: len(value)] == 1
    assert np.array_equal(found[clear], (value > threshold)[clear])
    assert clear.mean() > 0.9


def test_elements_under_a_tool_are_as_fine_as_its_radius_asks(device, tmp_path):
    """A capsule lies across the grid and moves along; its force comes near that of a finer mesh. A run that is loaded
    follows it, too."""
    along = np.array([0.0, np.sin(np.pi / 4), 0.0, np.cos(np.pi / 4)])
    turn = np.array([0.0, 0.0, np.sin(0.3), np.cos(0.3)])
    way = wp.quat(*turn) * wp.quat(*along)

    def pressed(level, remeshed):
        mesh = wc.TetForest.box((4, 4, 2), 0.01, level, up_axis="Z")
        body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1000.0), device=device)
        body.fix("z == zmin")
        tool = wc.Tool(wc.Capsule(0.008, 0.01))
        tool.follow([0.0, 0.05], [(0.021, 0.019, 0.028), (0.021, 0.019, 0.0255)], list(way))
        remesh = wc.OnlineRemesh(near=tool, every=20) if remeshed else None
        options = {"gravity": (0.0, 0.0, 0.0), "integrator": wc.SymplecticEuler(viscosity=5e-4, damping=20.0)}
        sim = wc.Simulation(body, obstacles=[tool], contact=wc.Contact(friction=0.0), remesh=remesh, **options)
        sim.advance(0.08)
        return sim, float(tool.wrench.numpy()[0, 2])

    (_, coarse), (_, fine), (sim, found) = pressed(0, False), pressed(6, False), pressed(0, True)
    assert abs(coarse - fine) > 0.3 * fine
    assert found == pytest.approx(fine, rel=0.1)
    x = sim.bodies[0].mesh.points
    axis = np.array(wp.quat_rotate(way, wp.vec3(0.0, 0.0, 1.0)))
    middle = x[sim.bodies[0].mesh.tets].mean(axis=1) - (0.021, 0.019, 0.02)
    off = np.linalg.norm(middle - np.clip(middle @ axis, -0.005, 0.005)[:, None] * axis, axis=1)
    size = np.cbrt(6.0 * sim.bodies[0].mesh.volumes)
    assert size[off < 0.002].max() < 0.3 * size[off > 0.02].max()
    sim.save(tmp_path / "state.npz")
    loaded = wc.Simulation.load(tmp_path / "state.npz")
    assert loaded.remeshing.changing[0].options.near is loaded.obstacles[0]


@pytest.mark.parametrize(("near", "says"), [(wc.Sphere(0.01), "near is"), (wc.Tool(wc.Ground()), "near is")])
def test_only_tools_of_simple_shapes_can_be_near(near, says):
    with pytest.raises(wc.InputError, match=says):
        wc.OnlineRemesh(near=near)
    with pytest.raises(wc.InputError, match="one of them must be None"):
        wc.OnlineRemesh(near=wc.Tool(wc.Sphere(0.01)), criterion=strain, parameters=wp.ones(1))
