"""The force plans of forests that stay as they are equal those of the NumPy oracle to the last bit."""

import numpy as np
import pytest
import warp as wp
from plan_oracle import OraclePlan, OracleUnits, complete_subtrees

import warp_corot as wc
from warp_corot.discretization.elements import all_frames
from warp_corot.discretization.plan import GROUPED_LEAVES, Sharing
from warp_corot.discretization.planner import ForcePlan, pays_in_groups
from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU
from warp_corot.kernels.tables import subtree
from warp_corot.kernels.tables.shapes import FRAME_SHIFT

MATERIAL = wc.Isotropic(young=1e4, poisson=0.4, density=1000.0)


def uniform(level):
    return wc.TetForest.box((2, 1, 1), 0.1, level)


def mixed(level):
    rng, forest = np.random.default_rng(level), uniform(level)
    for _ in range(3):
        forest = forest.refine(rng.choice(len(forest.tets), 5, replace=False))
    return forest


def sphere(level):
    """With void leaves, and corners of ancestors that no leaf names."""
    forest = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=level, surface_error=1e-3)
    assert len(forest.lattice) > forest.node_count
    return forest


MESHES = [(uniform, 0), (uniform, 2), (uniform, 7), (mixed, 2), (mixed, 5), (mixed, 7), (sphere, 6), (sphere, 8)]


def frames_of(elements, code):
    return elements.frames.numpy()[code >> FRAME_SHIFT]


def assert_same_codes(elements, codes, frames):
    """The same levels and handedness, and the very same frames, whatever table they stand in."""
    found, low = elements.code.numpy(), (1 << FRAME_SHIFT) - 1
    assert np.array_equal(found & low, codes & low)
    assert np.array_equal(frames_of(elements, found), frames[codes >> FRAME_SHIFT].astype(np.float32))


def by_unit(nodes, grouped):
    """Nodes of a batch's subtrees or groups, a row for each."""
    return nodes.numpy() if grouped or nodes.device.is_cpu else nodes.numpy().T


def assert_same_units(units, unit, expected, expected_unit):
    """Leaves or subtrees use the same tetrahedra, in whatever order these stand."""
    assert units.count == expected.count
    own, other = unit.numpy(), expected_unit
    assert np.array_equal(units.elements.nodes.numpy()[own], expected.nodes[other])
    code, wanted = units.elements.code.numpy()[own], expected.codes[other]
    assert np.array_equal(code & 127, wanted & 127)
    assert np.array_equal(frames_of(units.elements, code), expected.frames[wanted >> FRAME_SHIFT].astype(np.float32))


def assert_slots(plan):
    """Every node of a unit of work has a slot of its own, leaves have those of their subtrees, and nodes sum theirs."""
    node_of = np.full(len(plan.slots.values), -1)
    used = 4 * len(plan.flat.leaves)
    for batch in plan.batches:
        own, nodes = (by_unit(each, batch.grouped) for each in (batch.subtrees.targets, batch.subtrees.nodes))
        assert np.array_equal(own < 0, nodes < 0)
        node_of[own[own >= 0]] = nodes[own >= 0]
        used += np.count_nonzero(own >= 0)
    targets, nodes, flat = plan.elements.targets.numpy(), plan.elements.nodes.numpy(), plan.flat.leaves.numpy()
    node_of[targets[flat]] = nodes[flat]
    there = np.flatnonzero(node_of >= 0)
    assert len(there) == used
    assert np.array_equal(node_of[targets], nodes)
    assert np.array_equal(plan.slots.order.numpy(), there[np.argsort(node_of[there], kind="stable")])
    assert np.array_equal(np.diff(plan.slots.starts.numpy()), np.bincount(node_of[there]))


def assert_same(plan, expected):
    assert len(plan.batches) == len(expected.batches)
    for batch, wanted in zip(plan.batches, expected.batches, strict=True):
        assert (batch.shape, batch.grouped, batch.sharing) == (wanted.shape, wanted.grouped, wanted.sharing)
        assert batch.count == wanted.count
        assert np.array_equal(batch.subtrees.first.numpy(), wanted.first)
        assert np.array_equal(by_unit(batch.subtrees.nodes, batch.grouped), wanted.nodes)
        if plan.slots is None:
            assert np.array_equal(by_unit(batch.subtrees.targets, batch.grouped), wanted.nodes)
        assert_same_codes(batch.subtrees, wanted.codes, wanted.frames)
        assert (batch.unit is not None) == (batch.sharing is Sharing.ABOVE)
        if batch.unit is not None:
            assert_same_units(plan.units, batch.unit, expected.units, expected.units.unit[wanted.first])
        assert len(batch.flagged) == -(-batch.count // 8) * 8
        assert not batch.flagged.numpy().any()
    assert np.array_equal(plan.flat.leaves.numpy(), expected.flat)
    if plan.flat.general is not None:
        assert np.array_equal(plan.flat.general.nodes.numpy(), expected.flat_nodes)
        assert np.array_equal(plan.flat.general.numbers.numpy(), expected.flat)
    assert (plan.units is None) == (expected.units is None)
    if expected.units is not None:
        assert_same_units(plan.units, plan.units.unit, expected.units, expected.units.unit)
        assert (np.diff(plan.units.unit.numpy()) >= 0).all()


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("rotation_level", [None, 0, 1, 3, 4, 6, 9])
@pytest.mark.parametrize(("mesh", "level"), MESHES)
def test_a_plan_is_the_oracles(mesh, level, rotation_level, grouped, device):
    forest, device = mesh(level), wp.get_device(device)
    for worlds in (1, 3):
        plan = ForcePlan.of_forest(forest, rotation_level, device, worlds=worlds, grouped=grouped)
        assert_same(plan, OraclePlan(forest, rotation_level, worlds=worlds, grouped=grouped))
        assert plan.slots is None
        if rotation_level is not None:
            expected = OracleUnits(forest, rotation_level, worlds)
            assert_same_units(plan.all_units, plan.all_units.unit, expected, expected.unit)


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("rotation_level", [None, 4])
@pytest.mark.parametrize(("mesh", "level"), MESHES)
def test_every_force_has_a_slot(mesh, level, rotation_level, grouped, device):
    forest, device = mesh(level), wp.get_device(device)
    for worlds in (1, 3):
        options = {"worlds": worlds, "grouped": grouped}
        plan = ForcePlan.of_forest(forest, rotation_level, device, deterministic=True, **options)
        assert_same(plan, OraclePlan(forest, rotation_level, **options))
        assert_slots(plan)


@pytest.mark.parametrize("threads", [2, 7, 5000])
def test_any_number_of_threads_makes_the_same_plan(threads, device, monkeypatch):
    monkeypatch.setattr("warp_corot.discretization.planner.threads_on", lambda device: threads)
    forest, device = mixed(7), wp.get_device(device)
    options = {"worlds": 2, "grouped": True}
    plan = ForcePlan.of_forest(forest, 4, device, deterministic=True, **options)
    assert_same(plan, OraclePlan(forest, 4, **options))
    assert_slots(plan)


def test_a_field_without_subtrees_has_slots_and_units_too(device):
    forest = mixed(5)
    body = wc.SoftBody(forest, MATERIAL, worlds=2, device=device)
    plan = body.discretization.plan(3, subtrees=False, deterministic=True)
    assert np.array_equal(plan.elements.targets.numpy().ravel(), np.arange(8 * len(forest.tets)))
    node = body.discretization.elements.nodes.numpy().ravel()
    assert np.array_equal(plan.slots.order.numpy(), np.argsort(node, kind="stable"))
    assert np.array_equal(np.diff(plan.slots.starts.numpy()), np.bincount(node))
    expected = OracleUnits(forest, 3, worlds=2)
    assert_same_units(plan.all_units, plan.all_units.unit, expected, expected.unit)


def test_more_slots_than_can_be_numbered_are_refused(device, monkeypatch):
    monkeypatch.setattr("warp_corot.discretization.plan.MOST_SLOTS", 100)
    body = wc.SoftBody(uniform(5), MATERIAL, device=device)
    for subtrees in (True, False):
        with pytest.raises(wc.InputError, match="slots for forces; there can be 100 at most"):
            body.discretization.plan(subtrees=subtrees, deterministic=True)


def test_subtrees_pay_when_many_leaves_are_in_groups(device):
    forest = uniform(7)
    body = wc.SoftBody(forest, MATERIAL, device=device)
    count = len(forest.tets)
    worlds = -(-GROUPED_LEAVES // count)
    assert pays_in_groups(forest, body.discretization.elements, worlds)
    assert not pays_in_groups(forest, body.discretization.elements, worlds - 1)


def test_a_parents_frame_follows_from_its_childs():
    """Whatever the parent, and for the first and the second child alike."""
    table, forest = all_frames(), mixed(8)
    tree = forest.tree
    codes = table.codes(forest.lattice, tree.tets, tree.level)
    child = np.flatnonzero(tree.parent >= 0)
    which = child - tree.first_child[tree.parent[child]]
    found = table.of_parents[codes[child] >> FRAME_SHIFT, tree.level[child] % 3, which]
    assert set(which) == {0, 1}
    assert np.array_equal(found | (tree.level[child] - 1), codes[tree.parent[child]])


@pytest.mark.parametrize("level", [2, 5, 7])
@pytest.mark.parametrize("rotation_level", [None, 3, 5])
def test_every_leaf_is_computed_once(level, rotation_level, device):
    forest = mixed(level)
    plan = ForcePlan.of_forest(forest, rotation_level, wp.get_device(device))
    leaves = [batch.subtrees.first.numpy()[:, None] + np.arange(8) for batch in plan.batches]
    for batch, own in zip(plan.batches, leaves, strict=True):
        assert (forest.levels[own] % 3 == batch.shape).all()
        assert (forest.levels[own] == forest.levels[own[:, :1]]).all()
    done = np.concatenate([plan.flat.leaves.numpy(), *map(np.ravel, leaves)])
    assert np.array_equal(np.sort(done), np.arange(len(forest.tets)))


@pytest.mark.parametrize("depth", [3, 6])
def test_complete_subtrees_are_those_of_the_tree(depth):
    """Those of the oracle."""
    forest = mixed(6)
    tree, leaves = forest.tree, forest.tree.leaves
    expected = []
    for root in range(len(tree.tets)):
        below = [root]
        for _ in range(depth):
            below = [c for p in below if tree.first_child[p] >= 0 for c in tree.first_child[p] + np.arange(2)]
        if len(below) == 2**depth and (tree.first_child[below] < 0).all():
            expected.append(np.flatnonzero(leaves == below[0])[0])
    assert np.array_equal(complete_subtrees(forest, depth), np.sort(expected))


@pytest.mark.parametrize("shape", range(3))
def test_subtree_tables(shape):
    """Ten nodes, or 35 (37 for type 2) for six levels; the stiffness of a subtree is the sum over its leaves."""
    assert len(subtree.POSITIONS[shape]) == 10
    assert len(subtree.group_nodes(shape)) == (37 if shape == 2 else 35)
    assert sum(map(len, subtree.group_sources(shape))) == 80
    frames = np.array(subtree.FRAMES[shape])
    np.testing.assert_allclose(np.einsum("lca,lda->lcd", frames, frames), np.tile(np.eye(3), (8, 1, 1)), atol=1e-12)
    for part, table in zip(subtree.stiffness(shape), (STIFFNESS_LAMBDA[shape], STIFFNESS_MU[shape]), strict=True):
        total = np.zeros((30, 30))
        for leaf, frame in zip(subtree.LEAVES[shape], frames, strict=True):
            turn = np.kron(np.eye(4), frame.T)
            at = (3 * np.array(leaf)[:, None] + np.arange(3)).ravel()
            total[np.ix_(at, at)] += 0.5 * turn @ np.array(table) @ turn.T
        np.testing.assert_allclose(part, total, atol=1e-12)
        np.testing.assert_allclose(part, np.transpose(part), atol=1e-12)
