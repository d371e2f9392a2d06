"""Numbering of nodes of a changing mesh, padding beyond them, and the way back to an earlier state."""

import numpy as np
import pytest
from remesh_cases import (
    CUBE,
    DENSITY,
    RemeshPass,
    assert_sound,
    counts_of,
    is_full,
    leaf_list,
    moving,
    random_marks,
    set_nodes,
    support_impulse,
)

import warp_corot as wc
from warp_corot.discretization.changing.pools import (
    CARRIED_BY_NODES,
    CARRIED_BY_TETRAHEDRA,
    OF_NODES,
    OF_TETRAHEDRA,
    DeviceForest,
)


def points_of(device):
    """Lattice points of the nodes of leaves, by number."""
    return [tuple(p) for p in device.pools.lattice.numpy()[: device.node_count].tolist()]


def gaps_and_movers(before, after):
    """Numbers that removed nodes leave below the new number of nodes, and the nodes beyond it, both in order."""
    kept = [p if p in after else None for p in before]
    count = sum(p is not None for p in kept)
    return [n for n, p in enumerate(kept[:count]) if p is None], [p for p in kept[count:] if p is not None]


@pytest.mark.parametrize("threads", [1, 7, 5000])
def test_the_last_nodes_move_into_the_gaps(threads, device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 2)
    for _ in range(3):
        forest = forest.refine(rng.random(len(forest.tets)) < 0.3)
    adaptive = DeviceForest(forest, 5000, device=device)
    adaptive.threads = threads
    remesh, moved = RemeshPass(adaptive), 0
    for _ in range(4):
        before = points_of(adaptive)
        remesh.apply(random_marks(adaptive, rng, 0.0, 0.6))
        after = points_of(adaptive)
        gaps, movers = gaps_and_movers(before, set(after))
        moved_to = [after[n] for n in gaps]
        assert sorted(moved_to) == sorted(movers)
        if threads == 1 and adaptive.device.is_cpu:
            assert moved_to == movers
        assert [p for n, p in enumerate(after) if n not in gaps] == [
            p for n, p in enumerate(before[: len(after)]) if n not in gaps
        ]
        assert_sound(adaptive)
        moved += len(movers)
    assert moved > 10


def test_new_nodes_come_after_all_others(device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 3, origin=(100.0, -0.3, 1e-3))
    adaptive = DeviceForest(forest, 20000, device=device)
    remesh = RemeshPass(adaptive)
    for _ in range(4):
        before = points_of(adaptive)
        remesh.apply(random_marks(adaptive, rng, 0.2, 0.0))
        assert points_of(adaptive)[: len(before)] == before
        mesh = assert_sound(adaptive)
    assert len(mesh.points) > 3 * len(forest.points)
    # Their rest positions equal those of a body made on this mesh.
    body = wc.SoftBody(mesh, wc.Isotropic(1e3, 0.3, DENSITY), device=device)
    rest = adaptive.carriage.arrays.rest.numpy()[: adaptive.node_count]
    assert np.allclose(rest, body.state.rest.numpy(), rtol=2e-7, atol=0)


def test_nodes_that_move_keep_what_they_carry(device, rng):
    """All data except mass, load and velocity, which they may get from removed nodes."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 6)
    n = len(forest.points)
    held = rng.random(n) < 0.5
    adaptive = moving(forest, device, rng, held=held, rows=np.where(held, rng.integers(-2, 9, n), -1))
    arrays = adaptive.carriage.arrays
    reactions = np.zeros((*arrays.reaction.shape, 4), np.float32)
    reactions[:n][held, :3] = rng.normal(size=(held.sum(), 3))
    arrays.reaction.assign(reactions)
    names = ("rest", "u", "reaction", "held", "row")

    def carried():
        return [getattr(arrays, name).numpy()[: adaptive.node_count].tolist() for name in names]

    remesh, number, before = RemeshPass(adaptive), {p: k for k, p in enumerate(points_of(adaptive))}, carried()
    for _ in range(3):
        remesh.apply(random_marks(adaptive, rng, 0.0, 0.6))
    places = [number[p] for p in points_of(adaptive)]
    assert len(places) < n
    assert np.count_nonzero(places != np.arange(len(places))) > 10
    assert carried() == [[values[k] for k in places] for values in before]


def test_nodes_at_the_rim_of_a_void_move_and_virtual_ones_stay(device, rng):
    """Void tetrahedra are renamed, too."""
    forest = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=9, surface_error=3e-4)
    assert len(forest.lattice) > forest.node_count
    adaptive = DeviceForest(forest, 20000, density=DENSITY, device=device)
    places = adaptive.nodes_in_use[forest.node_count :]
    virtual = adaptive.pools.lattice.numpy()[places]
    assert np.array_equal(virtual, forest.lattice[forest.node_count :])
    tree = forest.tree
    at_void = np.unique(tree.tets[tree.first_child == -2])
    at_void = {tuple(p) for p in forest.lattice[at_void[at_void < forest.node_count]].tolist()}
    remesh, moved = RemeshPass(adaptive), 0
    for refine, simplify in [(0.0, 0.8), (0.0, 1.0), (0.1, 0.5), (0.0, 1.0)]:
        number = {p: n for n, p in enumerate(points_of(adaptive))}
        remesh.apply(random_marks(adaptive, rng, refine, simplify))
        assert_sound(adaptive)
        moved += sum(p in at_void and n != number.get(p, n) for n, p in enumerate(points_of(adaptive)))
        assert np.array_equal(adaptive.pools.lattice.numpy()[places], virtual)
    assert moved > 20


def test_what_the_last_pass_did_is_counted(device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 3)
    adaptive = DeviceForest(forest, 2000, device=device)
    remesh = RemeshPass(adaptive)
    for chances in [(0.3, 0.2), (0.0, 0.9), (0.0, 0.0), (0.1, 0.6), (1.0, 0.0), (1.0, 0.0), (1.0, 0.0), (1.0, 0.0)]:
        before = set(points_of(adaptive))
        remesh.apply(random_marks(adaptive, rng, *chances))
        counts, mesh, after = counts_of(adaptive), adaptive.to_forest(), set(points_of(adaptive))
        assert (counts.leaves, counts.nodes) == (len(mesh.tets), len(mesh.points))
        assert (counts.added, counts.removed) == (len(after - before), len(before - after))
        assert counts.full == is_full(adaptive)
    assert counts.full


def test_new_held_nodes_follow_the_row_that_both_ends_follow(device, rng):
    """-2 if these differ, -1 if there are none."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, 6)
    n = len(forest.points)
    held = forest.points[:, 0] < 0.6 * CUBE
    row = np.where(held, np.digitize(forest.points[:, 1], [0.3 * CUBE, 0.6 * CUBE]) - 1, -1)
    adaptive = DeviceForest(forest, 20000, device=device)
    set_nodes(adaptive.carriage, held=held, rows=row)
    remesh = RemeshPass(adaptive)
    for chances in [(0.3, 0.0), (0.3, 0.0), (0.3, 0.3)]:
        remesh.apply(random_marks(adaptive, rng, *chances))
    mesh = assert_sound(adaptive)
    known = {tuple(p): (bool(h), int(r)) for p, h, r in zip(forest.lattice.tolist(), held, row, strict=True)}
    ends = {tuple(p): e for p, e in zip(mesh.lattice.tolist(), mesh.lattice[mesh.node_ends].tolist(), strict=True)}

    def expected(point):
        if point not in known:
            (held_a, a), (held_b, b) = (expected(tuple(end)) for end in ends[point])
            both = held_a and held_b
            known[point] = both, -1 if not both else a if a == b else -2
        return known[point]

    arrays = adaptive.carriage.arrays
    found = zip(arrays.held.numpy()[: len(mesh.points)] != 0, arrays.row.numpy()[: len(mesh.points)], strict=True)
    assert [(bool(h), int(r)) for h, r in found] == [expected(p) for p in points_of(adaptive)]
    new = arrays.row.numpy()[n : len(mesh.points)][arrays.held.numpy()[n : len(mesh.points)] != 0]
    assert set(new) == {-2, -1, 0, 1}


# --- back to an earlier state -----------------------------------------------------------------------------------------


def in_use(device):
    """All used parts of all arrays, by name."""
    nodes, elements = device.nodes_in_use, np.flatnonzero(device.pools.level.numpy() >= 0)
    found = {"leaves": device.leaf_elements.copy(), "impulse": support_impulse(device).copy()}
    for struct, names, places in (
        (device.pools, OF_NODES, nodes),
        (device.carriage.arrays, CARRIED_BY_NODES, nodes),
        (device.pools, OF_TETRAHEDRA, elements),
        (device.carriage.arrays, CARRIED_BY_TETRAHEDRA, elements),
    ):
        found |= {name: getattr(struct, name).numpy()[places] for name in names}
    return found


def assert_same_state(device, expected):
    for name, values in in_use(device).items():
        assert np.array_equal(values, expected[name]), name


START = {
    "box": lambda: wc.TetForest.box((2, 1, 1), CUBE, 3),
    "sphere": lambda: wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3),
}


@pytest.mark.parametrize("kind", ["box", "sphere"])
def test_restarting_leads_back_and_recorded_passes_go_on(kind, device, rng):
    forest = START[kind]()
    adaptive = moving(forest, device, rng, held=rng.random(len(forest.points)) < 0.2)
    adaptive.remember()
    remesh, first = RemeshPass(adaptive), in_use(adaptive)
    marks = [random_marks(adaptive, rng, 0.3, 0.3)]
    remesh.apply(marks[0])
    leaves = leaf_list(adaptive.to_forest())
    for _ in range(5):
        remesh.apply(random_marks(adaptive, rng, 0.1, 0.7))
    adaptive.restart()
    assert_same_state(adaptive, first)
    assert_sound(adaptive)
    remesh.apply(marks[0])
    assert leaf_list(assert_sound(adaptive)) == leaves
    # The remembered state may be any other one, and smaller than the current one.
    remesh.apply(random_marks(adaptive, rng, 0.0, 1.0))
    adaptive.remember()
    second = in_use(adaptive)
    for _ in range(4):
        remesh.apply(random_marks(adaptive, rng, 0.5, 0.1))
    assert adaptive.leaf_count > 2 * len(second["leaves"])
    adaptive.restart()
    assert_same_state(adaptive, second)
    assert_sound(adaptive)


@pytest.mark.parametrize("kind", ["box", "sphere"])
def test_a_mesh_restarts_at_what_it_began_as(kind, device, rng):
    """Even if its pools were full."""
    forest = START[kind]()
    adaptive = DeviceForest(forest, len(forest.tets) + 300, density=DENSITY, device=device)
    remesh, first = RemeshPass(adaptive), in_use(adaptive)
    for _ in range(4):
        remesh.apply(np.ones(adaptive.leaf_count, int))
    assert is_full(adaptive)
    adaptive.restart()
    assert_same_state(adaptive, first)
    assert not is_full(adaptive)
    assert np.array_equal(assert_sound(adaptive).tets, forest.tets)
    for _ in range(4):
        remesh.apply(np.full(adaptive.leaf_count, -1))
        assert_sound(adaptive)
    assert adaptive.leaf_count < len(forest.tets)
