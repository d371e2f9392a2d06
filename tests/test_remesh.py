"""Remeshing on the device: conforming, in balance, and as a sequential reference has it; mass and momentum stay."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from sequential import Bisection
from sequential_remesh import SequentialRemesh
from warp_corot.kernels.remesh_mark import ElementState

import warp_corot as wc
from warp_corot.mesh.lattice import LATTICE_BITS
from warp_corot.remesh import DeviceForest, RemeshPass

CUBE = 0.064
DENSITY = 1000.0
PAIRS = list(itertools.combinations(range(4), 2))


def leaf_list(forest):
    """Leaves as the sequential reference names them, in the forest's order."""
    corners = (forest.lattice * (Bisection.CUBE >> LATTICE_BITS))[forest.tets].tolist()
    return [(int(n), *map(tuple, points)) for n, points in zip(forest.levels, corners, strict=True)]


def assert_conforming(forest):
    faces = np.concatenate([forest.tets[:, list(face)] for face in itertools.combinations(range(4), 3)])
    faces, count = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    edges = np.unique(np.sort(np.concatenate([forest.tets[:, pair] for pair in PAIRS]), axis=1), axis=0)
    # Midpoints of edges, as keys, are not nodes.
    weights = np.array([1, 1 << 20, 1 << 40])
    nodes = 2 * forest.lattice[: len(forest.points)].astype(np.int64) @ weights
    assert not np.isin(forest.lattice[edges].astype(np.int64).sum(axis=1) @ weights, nodes).any()


def assert_tree(forest):
    """Children are the halves of their parent: by position, not by the rule that made them."""
    tree = forest.tree
    inner = np.flatnonzero(tree.first_child >= 0)
    assert len(tree.level) == np.count_nonzero(tree.parent < 0) + 2 * len(inner)
    for half in range(2):
        child = tree.first_child[inner] + half
        assert (tree.parent[child] == inner).all()
        assert (tree.level[child] == tree.level[inner] + 1).all()
    x = forest.lattice.astype(float)
    centre = x[tree.tets].mean(axis=1)
    both = centre[tree.first_child[inner]] + centre[tree.first_child[inner] + 1]
    assert np.allclose(both, 2 * centre[inner])
    made = forest.node_ends[:, 0] >= 0
    assert np.array_equal(2 * forest.lattice[made], forest.lattice[forest.node_ends[made]].sum(axis=1))


def assert_sound(device):
    """What must hold after every pass, whatever happened; returns the mesh."""
    forest = device.to_forest()
    source = device.source
    assert_conforming(forest)
    assert_tree(forest)
    assert forest.volumes.sum() == pytest.approx(source.volumes.sum(), rel=1e-12)
    assert np.array_equal(device.leaf_tets, device.pools.tets.numpy()[device.leaf_elements])
    # Leaves are in tree order, and export keeps them so.
    order = device.nodes_in_use
    assert np.array_equal(order[forest.tets], device.leaf_tets)
    # Nobody is an orphan, and nothing is lost from the pools.
    tree, used = device.tree()
    names = np.bincount(tree.tets[tree.first_child < 0].ravel(), minlength=device.node_capacity)
    valence = device.pools.valence.numpy()
    assert np.array_equal(names, valence)
    free = device.pools.free_nodes.numpy()[: device.free_nodes]
    assert np.array_equal(np.sort(free), np.flatnonzero(valence == 0))
    pairs = device.pools.free_pairs.numpy()[: device.free_leaves]
    unused = np.setdiff1d(np.arange(device.pools.roots, device.tree_capacity), used)
    assert np.array_equal(np.sort(np.concatenate([pairs, pairs + 1])), unused)
    # Lumped masses are those of the leaves' densities.
    arrays = device.carriage.arrays
    quarter = 0.25 * arrays.density.numpy()[device.leaf_elements] * forest.volumes
    masses = np.zeros(device.node_capacity)
    np.add.at(masses, device.leaf_tets, quarter[:, None])
    assert np.allclose(arrays.mass.numpy(), masses, rtol=1e-9, atol=1e-12 * masses.max())
    free_to_move = (masses > 0) & (arrays.held.numpy() == 0)
    expected = np.divide(1.0, masses, where=free_to_move, out=np.zeros_like(masses))
    assert np.allclose(arrays.inverse_mass.numpy(), expected, rtol=1e-6)
    return forest


def momentum(device):
    """Linear momentum, and the sum of its terms' sizes."""
    arrays = device.carriage.arrays
    p = arrays.mass.numpy()[:, None] * arrays.v.numpy()[:, :3].astype(float)
    return p.sum(axis=0), np.abs(p).sum()


def moving(forest, device, rng, **options):
    """A forest on the device with random displacements and velocities."""
    made = DeviceForest(forest, options.pop("capacity", 20000), density=options.pop("density", DENSITY), device=device)
    n = len(forest.points)
    shape = (n, 3)
    made.carriage.set_nodes(displacements=1e-3 * rng.normal(size=shape), velocities=rng.normal(size=shape), **options)
    return made


def random_marks(device, rng, refine, simplify):
    """That share of the leaves, those nearest to a random point, to be given up, and scattered ones to be bisected.

    All leaves around a node must agree on giving it up, which scattered ones hardly ever do.
    """
    mesh = device.to_forest()
    centre = mesh.points[mesh.tets].mean(axis=1)
    distance = np.linalg.norm(centre - rng.choice(centre), axis=1)
    marks = np.where(rng.random(len(centre)) < refine, 1, 0)
    marks[distance <= np.quantile(distance, simplify)] = -1
    return np.where(rng.random(len(centre)) < 0.01, 0, marks)


def run_against_reference(cells, level, device, rng, passes, *, most, limits=(0, 12)):
    """Random marks, with swings between growing and shrinking; everything is checked after each pass."""
    forest = wc.TetForest.box(cells, CUBE, level)
    adaptive = moving(forest, device, rng, capacity=8 * most)
    remesh = RemeshPass(adaptive, min_level=limits[0], max_level=limits[1])
    sequential = SequentialRemesh(cells, level)
    total_mass = adaptive.carriage.arrays.mass.numpy().sum()
    grows, seen = True, set()
    for _ in range(passes):
        count = adaptive.leaf_count
        grows = (grows and count < most) or count < 60
        chances = (0.15, 0.3) if grows else (0.01, 0.9)
        marks = random_marks(adaptive, rng, *chances)
        before = adaptive.to_forest()
        p = momentum(adaptive)
        sequential.remesh(dict(zip(leaf_list(before), marks, strict=True)), *limits)
        remesh.apply(marks)
        after = assert_sound(adaptive)
        assert set(leaf_list(after)) == sequential.leaves
        assert np.allclose(momentum(adaptive)[0], p[0], atol=1e-6 * p[1])
        assert adaptive.carriage.arrays.mass.numpy().sum() == pytest.approx(total_mass, rel=1e-12)
        seen.add(np.sign(len(after.tets) - count))
    assert seen >= {-1, 1}
    assert not adaptive.is_full
    return adaptive, remesh


@pytest.mark.parametrize(("cells", "level"), [((1, 1, 1), 0), ((2, 1, 1), 2), ((1, 2, 2), 3)])
def test_random_passes_are_those_of_the_sequential_reference(cells, level, device, rng):
    run_against_reference(cells, level, device, rng, 80, most=500)


def test_levels_limit_what_is_refined_and_simplified(device, rng):
    """But what conformity asks for."""
    adaptive, _ = run_against_reference((2, 1, 1), 3, device, rng, 80, most=400, limits=(3, 5))
    assert adaptive.to_forest().levels.min() == 3


@pytest.mark.parametrize("where", ["scattered", "both ends far", "one end far"])
def test_many_leaves_are_refined_as_the_forest_does_it(where, device, rng):
    """Also at edges whose ends are named all over the list of leaves, as in the middle of the cube."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, 14)
    count = len(forest.tets)
    if where == "scattered":
        marked = rng.random(count) < 0.01
    else:
        stretch = np.repeat(np.arange(count) // 512, 4)
        named = np.unique(np.column_stack([forest.tets.ravel(), stretch]), axis=0)[:, 0]
        far = (np.bincount(named) > 7)[forest.tets[:, [0, 1]]]
        candidates = np.flatnonzero(far.all(axis=1) if where == "both ends far" else far[:, 0] ^ far[:, 1])
        marked = np.isin(np.arange(count), rng.choice(candidates, 3))
    adaptive = DeviceForest(forest, 2 * count, device=device)
    RemeshPass(adaptive).apply(marked)
    found, expected = adaptive.to_forest(), forest.refine(marked)
    assert np.array_equal(found.lattice[found.tets], expected.lattice[expected.tets])
    assert np.array_equal(found.levels, expected.levels)
    assert len(found.tets) > count


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(4))
def test_a_thousand_random_passes(seed, device):
    rng = np.random.default_rng(seed)
    run_against_reference([(1, 1, 1), (2, 1, 1), (1, 2, 2), (3, 1, 1)][seed], seed, device, rng, 1000, most=1500)


def test_simplification_leads_back_to_the_coarsest_mesh(device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 0)
    adaptive = moving(forest, device, rng)
    mass = adaptive.carriage.arrays.mass.numpy()
    remesh = RemeshPass(adaptive)
    for _ in range(8):
        remesh.apply(random_marks(adaptive, rng, 0.3, 0.1))
    assert adaptive.leaf_count > 1000
    for _ in range(60):
        remesh.apply(np.full(adaptive.leaf_count, -1))
    back = assert_sound(adaptive)
    assert np.array_equal(back.tets, forest.tets)
    assert np.array_equal(back.lattice, forest.lattice)
    assert np.array_equal(back.tree.first_child, forest.tree.first_child)
    assert adaptive.free_leaves == adaptive.capacity - len(forest.tets)
    assert adaptive.node_count == len(forest.points)
    assert np.allclose(adaptive.carriage.arrays.mass.numpy(), mass, rtol=1e-12)


def state_by_point(device):
    """Of each node its lattice point, ends' points and all it carries, in the order of the points."""
    places = device.nodes_in_use
    arrays, lattice = device.carriage.arrays, device.pools.lattice.numpy()
    ends = device.pools.ends.numpy()[places]
    at_ends = np.where(ends[..., None] < 0, -1, lattice[ends]).reshape(len(places), -1)
    carried = [getattr(arrays, n).numpy()[places].reshape(len(places), -1) for n in ("u", "v", "load", "mass", "held")]
    rows = np.column_stack([lattice[places], np.sort(at_ends, axis=1), *carried])
    return rows[np.lexsort(rows[:, :3].T)]


def test_compaction_changes_numbers_alone(device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 3)
    adaptive = moving(forest, device, rng, held=rng.random(len(forest.points)) < 0.3)
    twin = DeviceForest(forest, 20000, density=DENSITY, device=device)
    remesh, twin_remesh = RemeshPass(adaptive), RemeshPass(twin)
    for n in range(12):
        if n in (4, 8):
            leaves, state = leaf_list(assert_sound(adaptive)), state_by_point(adaptive)
            adaptive.compact()
            mesh = assert_sound(adaptive)
            assert leaf_list(mesh) == leaves
            assert np.array_equal(state_by_point(adaptive), state)
            assert np.array_equal(adaptive.nodes_in_use, np.arange(adaptive.node_count))
            first = np.unique(mesh.tets.ravel(), return_index=True)[1]
            assert np.array_equal(first, np.sort(first))
        marks = random_marks(adaptive, rng, 0.1, 0.5)
        remesh.apply(marks)
        twin_remesh.apply(marks)
        assert leaf_list(assert_sound(adaptive)) == leaf_list(twin.to_forest())


@pytest.mark.parametrize("threads", [2, 7, 5000])
def test_any_number_of_threads_comes_to_the_same_leaves(threads, device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 2)
    found = [DeviceForest(forest, 20000, device=device) for _ in range(2)]
    found[1].threads = threads
    passes = [RemeshPass(adaptive) for adaptive in found]
    for _ in range(10):
        marks = random_marks(found[0], rng, 0.15, 0.4)
        for remesh in passes:
            remesh.apply(marks)
        one, other = (leaf_list(assert_sound(adaptive)) for adaptive in found)
        assert one == other


def test_a_pass_can_be_recorded_within_other_launches(device, rng):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 2)
    marks = rng.choice([-1, 0, 1], len(forest.tets))
    found = []
    for recorded in (False, True):
        adaptive = DeviceForest(forest, 1000, device=device)
        remesh = RemeshPass(adaptive)
        adaptive.pools.marks.assign(np.concatenate([marks, np.zeros(1000 - len(marks))]).astype(np.int8))
        if recorded:
            with wp.ScopedCapture(device=device) as capture:
                remesh.launch(marked=True)
            wp.capture_launch(capture.graph)
        else:
            remesh.launch(marked=True)
        found.append(leaf_list(assert_sound(adaptive)))
    assert found[0] == found[1]
    assert found[0] != leaf_list(forest)


# --- room -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("short_of", ["leaves", "nodes"])
def test_refinement_stops_cleanly_where_there_is_no_room(short_of, device, rng):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 3)
    room = {"capacity": 300} if short_of == "leaves" else {"capacity": 5000, "node_capacity": 70}
    adaptive = DeviceForest(forest, device=device, **room)
    adaptive.carriage.set_nodes(velocities=rng.normal(size=forest.points.shape))
    remesh = RemeshPass(adaptive)
    p, size = momentum(adaptive)
    for _ in range(8):
        remesh.apply(np.ones(adaptive.leaf_count, int))
        grown = assert_sound(adaptive)
    assert adaptive.is_full
    assert len(grown.tets) > 2 * len(forest.tets)
    # Nearly all the room is used: an edge is shared by eight leaves at most.
    assert min(adaptive.free_leaves // 8, adaptive.free_nodes) == 0
    assert np.allclose(momentum(adaptive)[0], p, atol=1e-5 * size)
    # Room that is given back is used again.
    remesh.apply(np.full(adaptive.leaf_count, -1))
    fewer = len(assert_sound(adaptive).tets)
    assert fewer < len(grown.tets)
    remesh.apply(np.ones(adaptive.leaf_count, int))
    assert len(assert_sound(adaptive).tets) > fewer


@pytest.mark.parametrize("passes", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_passes_in_pools_that_are_often_full(passes, device, rng):
    """Mass and the momentum that supports account for stay, and all else is sound; compacted now and then."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 2)
    held = rng.random(len(forest.points)) < 0.2
    adaptive = moving(forest, device, rng, capacity=700, held=held)
    remesh = RemeshPass(adaptive, max_level=15)
    mass = adaptive.carriage.arrays.mass.numpy().sum()
    full = 0
    for n in range(passes):
        before, size = momentum(adaptive)
        impulse = adaptive.carriage.support_impulse.copy()
        remesh.apply(random_marks(adaptive, rng, 0.3, 0.95 if n % 10 == 9 else 0.2))
        mesh = assert_sound(adaptive)
        given = adaptive.carriage.support_impulse - impulse
        assert np.allclose(momentum(adaptive)[0] - before, given, atol=2e-6 * size)
        full += adaptive.free_leaves < 12
        if n % 13 == 12:
            adaptive.compact()
    assert adaptive.carriage.arrays.mass.numpy().sum() == pytest.approx(mass, rel=1e-12)
    assert adaptive.is_full
    assert full > passes / 8
    assert mesh.levels.max() > 6


# --- state ------------------------------------------------------------------------------------------------------------


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
    """If nothing moved between the two, velocities and displacements are what they were."""
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
    assert np.abs(adaptive.carriage.support_impulse).max() < 1e-7 * momentum(adaptive)[1]


def test_supports_account_for_the_momentum_that_held_nodes_cannot_take(device, rng):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 2)
    n = len(forest.points)
    held = np.isin(np.arange(n), rng.choice(n, n // 2, replace=False))
    adaptive = moving(forest, device, rng, held=held)
    arrays = adaptive.carriage.arrays
    remesh = RemeshPass(adaptive)
    for _ in range(10):
        # New velocities, as steps in between would give: those that are held keep theirs.
        v = arrays.v.numpy().copy()
        free = (arrays.held.numpy() == 0) & (arrays.mass.numpy() > 0)
        v[free, :3] = rng.normal(size=(free.sum(), 3))
        arrays.v.assign(v)
        before, size = momentum(adaptive)
        impulse = adaptive.carriage.support_impulse.copy()
        in_use = adaptive.pools.valence.numpy() > 0
        remesh.apply(random_marks(adaptive, rng, 0.2, 0.6))
        given = adaptive.carriage.support_impulse - impulse
        assert np.allclose(momentum(adaptive)[0] - before, given, atol=2e-6 * size)
        still = np.flatnonzero((arrays.held.numpy() != 0) & in_use & (adaptive.pools.valence.numpy() > 0))
        assert np.array_equal(arrays.v.numpy()[still], v[still])
    assert np.abs(adaptive.carriage.support_impulse).max() > 1e-3 * size
    assert_sound(adaptive)


def test_nodes_between_held_ones_are_held(device):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 3)
    adaptive = DeviceForest(forest, 5000, device=device)
    adaptive.carriage.set_nodes(held=forest.points[:, 0] == 0)
    remesh = RemeshPass(adaptive)
    for _ in range(3):
        remesh.apply(np.ones(adaptive.leaf_count, int))
    places = adaptive.nodes_in_use
    mesh = assert_sound(adaptive)
    assert np.array_equal(adaptive.carriage.arrays.held.numpy()[places] != 0, mesh.points[:, 0] == 0)


def test_different_densities_become_one_and_keep_mass_and_momentum(device, rng):
    """Each leaf's density another one; two that are merged have their mean, and their mass goes where it belongs."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 4)
    density = rng.uniform(100.0, 3000.0, len(forest.tets))
    stiffness = rng.uniform(1.0, 2.0, len(forest.tets))
    adaptive = DeviceForest(forest, 20000, density=density, values={"mu": stiffness}, device=device)
    adaptive.carriage.set_nodes(velocities=rng.normal(size=forest.points.shape))
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


# --- criteria ---------------------------------------------------------------------------------------------------------


def longest_edges(forest, moved):
    """Longest rest edge of each leaf, deformed over rest, by the nodes' positions alone."""
    x = forest.points[forest.tets]
    y = moved[forest.tets]
    rest = np.stack([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in PAIRS])
    now = np.stack([np.linalg.norm(y[:, i] - y[:, j], axis=1) for i, j in PAIRS])
    longest = rest.argmax(axis=0), np.arange(len(x))
    return now[longest] / rest[longest]


def test_elongation_of_the_longest_edge_decides(device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 8, origin=(1.0, -2.0, 0.5))
    x = forest.points[:, 0] - 1.0
    u = np.column_stack([2.0 * x**2 / CUBE, 0 * x, 0 * x]) * 0.3 + 1e-3 * rng.normal(size=(len(x), 3))
    ratio = longest_edges(forest, forest.points + u)
    assert np.abs(ratio[:, None] - (1.3, 1.1)).min() > 1e-6
    adaptive = DeviceForest(forest, 50000, device=device)
    adaptive.carriage.set_nodes(displacements=u)
    RemeshPass(adaptive, refine_above=1.3, simplify_below=1.1).run()
    expected = np.where(ratio > 1.3, 1, np.where(ratio < 1.1, -1, 0))
    assert np.array_equal(adaptive.pools.marks.numpy()[: len(ratio)], expected)
    assert {-1, 0, 1} == set(expected)
    twin = DeviceForest(forest, 50000, device=device)
    RemeshPass(twin).apply(expected)
    assert leaf_list(assert_sound(adaptive)) == leaf_list(twin.to_forest())


@wp.func
def nearness(element: ElementState, parameters: wp.array[wp.float32]):
    """Longest edge over the distance of the element's centroid from a tool."""
    tool = wp.vec3(parameters[0], parameters[1], parameters[2])
    centre = element.corner
    for n in range(4):
        centre += 0.25 * (element.rest[n] + element.moved[n])
    longest = wp.length(element.rest[3 - element.level % 3])
    return longest / wp.length(centre - tool)


def test_a_users_criterion_follows_a_tool(device):
    """The mesh gathers where the tool is and relaxes behind it."""
    forest = wc.TetForest.box((3, 1, 1), CUBE, 3, origin=(-0.1, 0.0, 0.0))
    adaptive = DeviceForest(forest, 20000, device=device)
    tool = wp.zeros(3, dtype=wp.float32, device=device)
    remesh = RemeshPass(
        adaptive, criterion=nearness, refine_above=0.7, simplify_below=0.3, min_level=3, max_level=12, parameters=tool
    )
    counts = []
    for x in (-0.09, 0.09 - 0.008):
        at = np.array([x, 0.5 * CUBE, 0.5 * CUBE])
        tool.assign(at)
        for _ in range(12):
            remesh.run()
        mesh = assert_sound(adaptive)
        distance = np.linalg.norm(mesh.points[mesh.tets].mean(axis=1) - at, axis=1)
        assert mesh.levels[distance < 0.1 * CUBE].min() >= 10
        assert mesh.levels[distance > 2.0 * CUBE].max() <= 5
        counts.append(len(mesh.tets))
    assert counts[1] == pytest.approx(counts[0], rel=0.2)
    # Once it follows, nothing changes any more.
    remesh.run()
    assert adaptive.leaf_count == counts[1]


# --- bodies with a void around them -----------------------------------------------------------------------------------


def test_forests_of_domains_refine_and_simplify(device, rng):
    forest = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3)
    adaptive = DeviceForest(forest, 20000, density=DENSITY, device=device)
    adaptive.carriage.set_nodes(velocities=rng.normal(size=forest.points.shape))
    remesh = RemeshPass(adaptive)
    p, size = momentum(adaptive)
    for chances in [(0.2, 0.1), (0.2, 0.1), (0.02, 0.95), (0.0, 1.0), (0.0, 1.0), (0.1, 0.5)]:
        count = adaptive.leaf_count
        remesh.apply(random_marks(adaptive, rng, *chances))
        mesh = assert_sound(adaptive)
        assert len(mesh.tets) != count
        assert (mesh.fill * mesh.volumes).sum() == pytest.approx((forest.fill * forest.volumes).sum(), rel=1e-5)
        assert np.allclose(momentum(adaptive)[0], p, atol=1e-6 * size)
        assert len(np.unique(mesh.lattice, axis=0)) == len(mesh.lattice)
    body = wc.SoftBody(mesh, wc.Isotropic(1e3, 0.3, DENSITY), device=device)
    assert body.masses.sum() == pytest.approx(adaptive.carriage.arrays.mass.numpy().sum(), rel=1e-5)
    assert len(mesh.refine([0]).tets) > len(mesh.tets)


# --- what users get wrong ---------------------------------------------------------------------------------------------


def test_wrong_input_is_named(device):
    forest = wc.TetForest.box((1, 1, 1), CUBE, 2)
    general = wc.TetMesh(forest.points, forest.tets)
    with pytest.raises(wc.InputError, match="only a TetForest"):
        DeviceForest(general, 100, device=device)
    with pytest.raises(wc.InputError, match="capacity is 3"):
        DeviceForest(forest, 3, device=device)
    with pytest.raises(wc.InputError, match="density has shape"):
        DeviceForest(forest, 100, density=[1.0, 2.0], device=device)
    adaptive = DeviceForest(forest, 100, device=device)
    with pytest.raises(wc.InputError, match="must be smaller"):
        RemeshPass(adaptive, refine_above=1.1, simplify_below=1.2)
    for levels in ((5, 4), (-1, 4), (0, 49), (0.5, 3)):
        with pytest.raises(wc.InputError, match="from 0 to 48"):
            RemeshPass(adaptive, min_level=levels[0], max_level=levels[1])
    with pytest.raises(wc.InputError, match="Warp function"):
        RemeshPass(adaptive, criterion=lambda element: 1.0)
    with pytest.raises(wc.InputError, match="marks must be"):
        RemeshPass(adaptive).apply([1, 0])
    with pytest.raises(wc.InputError, match="must be"):
        adaptive.carriage.set_nodes(displacements=np.zeros((2, 3)))
