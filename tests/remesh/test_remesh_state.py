"""Data of nodes and elements while a mesh changes: deformation, mass, momentum, loads, labels."""

from dataclasses import replace

import numpy as np
import pytest
from remesh_cases import (
    CUBE,
    DENSITY,
    RemeshPass,
    assert_sound,
    counts_of,
    momentum,
    moving,
    random_marks,
    set_nodes,
    support_impulse,
)

import warp_corot as wc
from warp_corot.discretization.changing.pools import DeviceForest


def test_children_keep_the_deformation_and_the_energy(device, rng):
    """A new node is the midpoint of its deformed edge."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 3)
    adaptive = moving(forest, device, rng)
    remesh = RemeshPass(adaptive)
    energies = []
    for _ in range(4):
        mesh = adaptive.to_forest()
        body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.4, DENSITY), device=device)
        body.displacements = adaptive.carriage.arrays.u.numpy()[adaptive.nodes_in_use[: mesh.node_count], :3]
        energies.append(wc.Simulation(body).energy().elastic)
        remesh.apply(random_marks(adaptive, rng, 0.3, 0.0))
    assert len(mesh.tets) > 3 * len(forest.tets)
    assert energies == pytest.approx([energies[0]] * 4, rel=1e-5)
    assert energies[0] > 0


def test_removal_undoes_bisection(device, rng):
    """If nothing moved in between, velocities and displacements are restored."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, 3)
    n = len(forest.points)
    held = rng.random(n) < 0.2
    adaptive = moving(forest, device, rng, held=held)
    arrays = adaptive.carriage.arrays
    u, v = arrays.u.numpy().copy(), arrays.v.numpy().copy()
    remesh = RemeshPass(adaptive, min_level=3)
    remesh.apply(np.ones(len(forest.tets), int))
    assert adaptive.node_count > n
    remesh.apply(np.full(adaptive.leaf_count, -1))
    assert adaptive.node_count == n
    assert np.array_equal(arrays.u.numpy(), u)
    assert np.allclose(arrays.v.numpy(), v, atol=1e-6)
    assert np.allclose(arrays.v.numpy()[:n][held], v[:n][held], atol=0)
    assert np.abs(support_impulse(adaptive)).max() < 1e-7 * momentum(adaptive)[1]


def held_velocities(device):
    """Velocities of held nodes by lattice point: their numbers may change in a pass."""
    count, arrays = device.node_count, device.carriage.arrays
    points = map(tuple, device.pools.lattice.numpy()[:count].tolist())
    known = zip(points, arrays.v.numpy()[:count], arrays.held.numpy()[:count], strict=True)
    return {point: v for point, v, held in known if held}


def test_supports_account_for_the_momentum_that_held_nodes_cannot_take(device, rng):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 2)
    n = len(forest.points)
    held = np.isin(np.arange(n), rng.choice(n, n // 2, replace=False))
    adaptive = moving(forest, device, rng, held=held)
    arrays = adaptive.carriage.arrays
    remesh = RemeshPass(adaptive)
    for _ in range(10):
        # New velocities, as after steps: held nodes keep theirs.
        v = arrays.v.numpy().copy()
        free = (arrays.held.numpy() == 0) & (arrays.mass.numpy() > 0)
        v[free, :3] = rng.normal(size=(free.sum(), 3))
        arrays.v.assign(v)
        before, size = momentum(adaptive)
        impulse = support_impulse(adaptive).copy()
        still = held_velocities(adaptive)
        remesh.apply(random_marks(adaptive, rng, 0.2, 0.6))
        given = support_impulse(adaptive) - impulse
        assert np.allclose(momentum(adaptive)[0] - before, given, atol=2e-6 * size)
        now = held_velocities(adaptive)
        assert all(np.array_equal(now[point], still[point]) for point in now.keys() & still.keys())
    assert np.abs(support_impulse(adaptive)).max() > 1e-3 * size
    assert_sound(adaptive)


def test_nodes_between_held_ones_are_held(device):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 3)
    adaptive = DeviceForest(forest, 5000, device=device)
    set_nodes(adaptive.carriage, held=forest.points[:, 0] == 0)
    remesh = RemeshPass(adaptive)
    for _ in range(3):
        remesh.apply(np.ones(adaptive.leaf_count, int))
    places = adaptive.nodes_in_use
    mesh = assert_sound(adaptive)
    assert np.array_equal(adaptive.carriage.arrays.held.numpy()[places] != 0, mesh.points[:, 0] == 0)


def test_different_densities_become_one_and_keep_mass_and_momentum(device, rng):
    """Each leaf has another density; merged leaves have the mean, and their mass goes to the right nodes."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 4)
    density = rng.uniform(100.0, 3000.0, len(forest.tets))
    stiffness = rng.uniform(1.0, 2.0, len(forest.tets))
    adaptive = DeviceForest(forest, 20000, density=density, values={"mu": stiffness}, device=device)
    set_nodes(adaptive.carriage, velocities=rng.normal(size=forest.points.shape))
    remesh = RemeshPass(adaptive)
    total, (p, size) = adaptive.carriage.arrays.mass.numpy().sum(), momentum(adaptive)
    for marks in (0.0, 0.3, 0.0, 0.0, 0.3):
        remesh.apply(random_marks(adaptive, rng, marks, 0.7 if marks else 1.0))
        mesh = assert_sound(adaptive)
        assert adaptive.carriage.arrays.mass.numpy().sum() == pytest.approx(total, rel=1e-12)
        assert np.allclose(momentum(adaptive)[0], p, atol=1e-6 * size)
        held = adaptive.carriage.values("mu")[adaptive.leaf_elements] @ mesh.volumes
        assert held == pytest.approx(stiffness @ forest.volumes, rel=1e-5)


def test_leaves_of_different_labels_are_not_merged(device):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 6)
    labels = (forest.points[forest.tets].mean(axis=1)[:, 0] > 0.7 * CUBE).astype(np.int32) + 1
    labelled = replace(forest, labels=labels, label_names=("left", "right"))
    volumes = [labelled.volumes[labels == n].sum() for n in (1, 2)]
    adaptive = DeviceForest(labelled, 1000, device=device)
    remesh = RemeshPass(adaptive)
    for _ in range(30):
        remesh.apply(np.full(adaptive.leaf_count, -1))
    mesh = assert_sound(adaptive)
    assert 6 < len(mesh.tets) < len(forest.tets)
    assert [mesh.volumes[mesh.labels == n].sum() for n in (1, 2)] == pytest.approx(volumes, rel=1e-12)


def test_loads_stay_in_sum(device, rng):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 4)
    loads = rng.normal(size=forest.points.shape)
    adaptive = moving(forest, device, rng, loads=loads)
    remesh = RemeshPass(adaptive)
    for _ in range(6):
        remesh.apply(random_marks(adaptive, rng, 0.05, 0.8))
        found = adaptive.carriage.arrays.load.numpy()
        assert np.allclose(found.sum(axis=0)[:3], loads.sum(axis=0), atol=1e-5 * np.abs(loads).sum())
    assert np.abs(found[: len(forest.points), :3] - loads).max() > 0.1


def test_a_new_node_takes_what_leaves_of_any_density_lose(device, rng):
    """Densities around one edge span six decades. A leaf of mass M becomes two of M / 2, each with a quarter at each of
    its nodes: both ends lose M / 8, and the new node, which belongs to both, gets M / 4."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, 6)
    density = 10.0 ** rng.uniform(-2, 4, len(forest.tets))
    edge = forest.tets[17, [0, 3]]
    ring = np.isin(forest.tets, edge).sum(axis=1) == 2
    assert ring.sum() > 3
    adaptive = DeviceForest(forest, 1000, density=density, device=device)
    velocities = rng.normal(size=forest.points.shape)
    set_nodes(adaptive.carriage, velocities=velocities)
    before = adaptive.carriage.arrays.mass.numpy().copy()
    (p, size), total = momentum(adaptive), before.sum()
    RemeshPass(adaptive).apply(np.arange(len(forest.tets)) == 17)
    assert_sound(adaptive)
    after, new = adaptive.carriage.arrays.mass.numpy(), len(forest.points)
    weight = (density * forest.volumes)[ring].sum()
    assert counts_of(adaptive)[:4] == (len(forest.tets) + ring.sum(), new + 1, 1, 0)
    assert after[new] == pytest.approx(weight / 4, rel=1e-12)
    assert before[edge] - after[edge] == pytest.approx(np.full(2, weight / 8), rel=1e-9)
    assert after.sum() == pytest.approx(total, rel=1e-14)
    v = adaptive.carriage.arrays.v.numpy()[new, :3]
    assert np.allclose(v, velocities[edge].mean(axis=0), atol=1e-6)
    assert np.allclose(momentum(adaptive)[0], p, atol=1e-7 * size)
