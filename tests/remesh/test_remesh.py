"""Remeshing on the device: conforming, consistent, and equal to a sequential reference."""

import numpy as np
import pytest
import warp as wp
from remesh_cases import (
    CUBE,
    RemeshPass,
    assert_sound,
    free_leaves,
    free_nodes,
    is_full,
    leaf_list,
    momentum,
    moving,
    random_marks,
    set_nodes,
    support_impulse,
)
from sequential_remesh import SequentialRemesh

import warp_corot as wc
from warp_corot.discretization.changing.pools import DeviceForest


def run_against_reference(cells, level, device, rng, passes, *, most, limits=(0, 12)):
    """Random marks that alternate between growth and shrinkage; everything is checked after each pass."""
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
    assert not is_full(adaptive)
    return adaptive, remesh


@pytest.mark.parametrize(("cells", "level"), [((1, 1, 1), 0), ((2, 1, 1), 2), ((1, 2, 2), 3)])
def test_random_passes_are_those_of_the_sequential_reference(cells, level, device, rng):
    run_against_reference(cells, level, device, rng, 80, most=500)


def test_levels_limit_what_is_refined_and_simplified(device, rng):
    """Except where conformity requires more."""
    adaptive, _ = run_against_reference((2, 1, 1), 3, device, rng, 80, most=400, limits=(3, 5))
    assert adaptive.to_forest().levels.min() == 3


@pytest.mark.parametrize("where", ["scattered", "both ends far", "one end far"])
def test_many_leaves_are_refined_as_the_forest_does_it(where, device, rng):
    """Edges whose ends are named all over the list of leaves, like in the middle of the cube, are included."""
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
    assert free_leaves(adaptive) == adaptive.capacity - len(forest.tets)
    assert adaptive.node_count == len(forest.points)
    assert np.allclose(adaptive.carriage.arrays.mass.numpy(), mass, rtol=1e-12)


def test_without_a_least_level_simplification_leads_back_to_the_first_mesh(device, rng):
    """Also where that was refined."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 2)
    forest = forest.refine(rng.random(len(forest.tets)) < 0.2)
    adaptive = moving(forest, device, rng)
    remesh = RemeshPass(adaptive, min_level=None)
    for _ in range(3):
        for _ in range(4):
            remesh.apply(random_marks(adaptive, rng, 0.3, 0.1))
        assert adaptive.leaf_count > 2 * len(forest.tets)
        for _ in range(30):
            remesh.apply(np.full(adaptive.leaf_count, -1))
        assert leaf_list(assert_sound(adaptive)) == leaf_list(forest)


@pytest.mark.parametrize("threads", [2, 7, 5000])
def test_any_number_of_threads_makes_the_same_leaves(threads, device, rng):
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
    set_nodes(adaptive.carriage, velocities=rng.normal(size=forest.points.shape))
    remesh = RemeshPass(adaptive)
    p, size = momentum(adaptive)
    for _ in range(8):
        remesh.apply(np.ones(adaptive.leaf_count, int))
        grown = assert_sound(adaptive)
    assert is_full(adaptive)
    assert len(grown.tets) > 2 * len(forest.tets)
    # Nearly all the room is used: an edge is shared by eight leaves at most.
    assert min(free_leaves(adaptive) // 8, free_nodes(adaptive)) == 0
    assert np.allclose(momentum(adaptive)[0], p, atol=1e-5 * size)
    # Returned room is used again.
    remesh.apply(np.full(adaptive.leaf_count, -1))
    fewer = len(assert_sound(adaptive).tets)
    assert fewer < len(grown.tets)
    remesh.apply(np.ones(adaptive.leaf_count, int))
    assert len(assert_sound(adaptive).tets) > fewer


@pytest.mark.parametrize("passes", [40, pytest.param(1000, marks=pytest.mark.slow)])
def test_random_passes_in_pools_that_are_often_full(passes, device, rng):
    """Mass and the momentum that supports account for are conserved, and everything is sound."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 2)
    held = rng.random(len(forest.points)) < 0.2
    adaptive = moving(forest, device, rng, capacity=700, held=held)
    remesh = RemeshPass(adaptive, max_level=15)
    mass = adaptive.carriage.arrays.mass.numpy().sum()
    full = 0
    for n in range(passes):
        before, size = momentum(adaptive)
        impulse = support_impulse(adaptive).copy()
        remesh.apply(random_marks(adaptive, rng, 0.3, 0.95 if n % 10 == 9 else 0.2))
        mesh = assert_sound(adaptive)
        given = support_impulse(adaptive) - impulse
        assert np.allclose(momentum(adaptive)[0] - before, given, atol=2e-6 * size)
        full += free_leaves(adaptive) < 12
    assert adaptive.carriage.arrays.mass.numpy().sum() == pytest.approx(mass, rel=1e-12)
    assert is_full(adaptive)
    assert full >= passes / 20  # how often depends on the numbering, which CUDA's threads give in any order
    assert mesh.levels.max() > 6


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
    with pytest.raises(wc.InputError, match=r"simplify_below is 1\.2; it must be below refine_above, which is 1\.1"):
        RemeshPass(adaptive, refine_above=1.1, simplify_below=1.2)
    for levels, said in (
        ((5, 4), "min_level is 5; it must be at most max_level, which is 4"),
        ((-1, 4), "min_level is -1; it must be a whole number from 0 to 48"),
        ((0, 49), "max_level is 49; it must be a whole number from 0 to 48"),
        ((0.5, 3), "min_level is 0.5; it must be a whole number from 0 to 48"),
    ):
        with pytest.raises(wc.InputError, match=said):
            RemeshPass(adaptive, min_level=levels[0], max_level=levels[1])
    with pytest.raises(wc.InputError, match="Warp function"):
        RemeshPass(adaptive, criterion=lambda element: 1.0)
