"""Nodes by tree level, and linear transfers between levels."""

import numpy as np
import pytest
import warp as wp
from remesh_cases import random_marks
from remeshed import SOFT
from tree_levels import TreeLevels
from volumes import blobs

import warp_corot as wc

ROUNDING = np.finfo(np.float32).eps


def uniform():
    return wc.TetForest.box((2, 1, 1), 0.1, 7)


def mixed():
    """A forest with levels 2 to 11."""
    forest = wc.TetForest.box((1, 2, 1), 0.1, 2)
    for _ in range(9):
        forest = forest.refine([0])
    return forest


def sphere():
    domain = wc.Domain.sphere(0.4, (0.03, 0.01, -0.02), device="cpu")
    return wc.TetForest.from_domain(domain, 0.5, max_level=8, surface_error=0.01)


def speck():
    """A ball much smaller than its cube: most ancestors of its leaves contain void."""
    domain = wc.Domain.sphere(0.06, (0.12, 0.07, -0.11), device="cpu")
    return wc.TetForest.from_domain(domain, 0.5, max_level=10, surface_error=0.003)


def refined_sphere():
    forest = sphere()
    return forest.refine(np.flatnonzero(forest.points[forest.tets].mean(axis=1)[:, 0] > 0.25))


def labelled():
    volume = blobs(np.random.default_rng(7))
    domain = wc.Domain.from_labels(volume, (0.01, 0.012, 0.02), unit="m", device="cpu")
    return wc.TetForest.from_domain(domain, 0.1, max_level=7)


FORESTS = {
    "roots": lambda: wc.TetForest.box((2, 1, 1), 0.1, 0),
    "uniform": uniform,
    "mixed": mixed,
    "sphere": sphere,
    "speck": speck,
    "refined sphere": refined_sphere,
    "labels": labelled,
}
forests = pytest.mark.parametrize("name", FORESTS)


def body_of(name, device, worlds=1):
    return wc.SoftBody(FORESTS[name](), SOFT, worlds=worlds, device=device)


def changing_body(mesh, device):
    body = wc.SoftBody(mesh, SOFT, device=device)
    wc.Simulation(body, model=wc.NeoHookean(), remesh=wc.OnlineRemesh(capacity=20000, min_level=0, max_level=12))
    return body


def remesh(body, rng, passes):
    """Refine and simplify at random; returns the numbers of new and removed nodes."""
    added = removed = 0
    for _ in range(passes):
        body.changing.passes.apply(random_marks(body.changing.forest, rng, 0.05, 0.3))
        body.changing.renew()
        counts = body.changing.forest.counts()
        added, removed = added + counts.added, removed + counts.removed
    assert not body.changing.is_full
    return added, removed


def lattice_and_tree(body):
    """All lattice points of nodes, and the tree with their numbers."""
    if body.changing is None:
        return body.mesh.lattice, body.mesh.tree
    forest = body.changing.forest
    return forest.pools.lattice.numpy(), forest.tree()[0]


def places_of(levels):
    """Places of the nodes in the mesh's own numbering."""
    return np.concatenate([np.arange(levels.mesh_nodes), levels.others.numpy()])


def assert_equals_the_tree(levels, body):
    """Levels, ends and finest levels equal those found by walking down the tree, and every order is deterministic."""
    lattice, tree = lattice_and_tree(body)
    expected = TreeLevels.of(tree, len(lattice))
    places, order, starts = places_of(levels), levels.nodes.numpy(), levels.starts
    assert levels.mesh_nodes == body.sizes.world_nodes
    assert np.array_equal(places, np.flatnonzero(expected.level >= 0))
    assert levels.node_count == len(places)
    assert levels.depth == expected.level.max()
    # By level, then by number.
    level = np.repeat(np.arange(levels.depth + 1), np.diff(starts))
    assert np.array_equal(order, np.lexsort([np.arange(len(places)), expected.level[places]]))
    assert np.array_equal(level, expected.level[places[order]])
    ends = levels.ends.numpy()
    assert (ends[: starts[1]] == -1).all()
    assert np.array_equal(np.sort(places[ends[starts[1] :]], axis=1), expected.ends[places[order[starts[1] :]]])
    assert np.array_equal(levels.finest.numpy(), expected.finest[places])
    assert_gathers_every_end(levels)


def assert_gathers_every_end(levels):
    """Each level gathers from its own nodes, each at both of its ends, in the order of their numbers."""
    order, ends, coarse = levels.nodes.numpy(), levels.ends.numpy(), levels.coarse.numpy()
    where, midpoints = levels.midpoint_starts.numpy(), levels.midpoints.numpy()
    assert levels.coarse_starts[:2] == (0, 0)
    assert where[-1] == len(midpoints)
    assert len(where) == len(coarse) + 1 == levels.coarse_starts[-1] + 1
    for level in range(1, levels.depth + 1):
        part = slice(levels.starts[level], levels.starts[level + 1])
        rows = range(levels.coarse_starts[level], levels.coarse_starts[level + 1])
        assert np.array_equal(coarse[rows], np.unique(ends[part]))
        for row in rows:
            expected = np.sort(order[part][(ends[part] == coarse[row]).any(axis=1)])
            assert np.array_equal(midpoints[where[row] : where[row + 1]], expected)


def nodal(values, device):
    return wp.array(values.astype(np.float32), dtype=wp.vec4, device=device)


def assert_prolongates_linear_functions(levels, lattice):
    """Prolongation from every level to all finer nodes: lattice coordinates exactly, others to rounding."""
    points = lattice[places_of(levels)].astype(float)
    gradient = np.random.default_rng(3).standard_normal((3, 4))
    linear = 0.5 + points @ (gradient / points.max())
    level = np.empty(levels.node_count, int)
    level[levels.nodes.numpy()] = np.repeat(np.arange(levels.depth + 1), np.diff(levels.starts))
    for coarse in range(levels.depth + 1):
        for values, atol in ((np.column_stack([points, points[:, 0]]), 0.0), (linear, 8 * ROUNDING)):
            given = np.where(level[:, None] <= coarse, values, np.nan)
            x = nodal(np.tile(given, (levels.worlds, 1)), levels.device)
            levels.prolongate(x, coarse)
            expected = np.tile(values, (levels.worlds, 1))
            np.testing.assert_allclose(x.numpy(), expected, rtol=0, atol=atol * np.abs(values).max())


@forests
def test_levels_and_ends_are_the_trees(name, device):
    body = body_of(name, device)
    assert_equals_the_tree(body.discretization.levels(), body)


@forests
def test_linear_functions_are_prolongated_exactly(name, device):
    body = body_of(name, device)
    assert_prolongates_linear_functions(body.discretization.levels(), body.mesh.lattice)


@pytest.mark.parametrize("name", ["sphere", "labels"])
def test_coarse_levels_of_a_carved_forest_have_nodes_that_no_leaf_names(name, device):
    """Some nodes are missing in these levels, too, because only void tetrahedra name them."""
    body = body_of(name, device)
    levels = body.discretization.levels()
    assert len(body.mesh.points) == levels.mesh_nodes < levels.node_count < len(body.mesh.lattice)


@pytest.mark.parametrize("name", ["mixed", "sphere", "labels"])
def test_levels_follow_a_mesh_that_changes(name, device, rng):
    body = changing_body(FORESTS[name](), device)
    for passes in (2, 5):
        added, removed = remesh(body, rng, passes)
        assert added
        assert removed
        levels = body.discretization.levels()
        assert_equals_the_tree(levels, body)
        lattice, _ = lattice_and_tree(body)
        assert_prolongates_linear_functions(levels, lattice)
        assert (levels.node_count > levels.mesh_nodes) == (name != "mixed")
        # The pools also store the ends of each node.
        places, made = places_of(levels), slice(levels.starts[1], None)
        of_pools = body.changing.forest.pools.ends.numpy()[places[levels.nodes.numpy()[made]]]
        assert np.array_equal(places[levels.ends.numpy()[made]], of_pools)


def test_levels_are_found_once_for_each_mesh(device, rng):
    body = changing_body(uniform(), device)
    first = body.discretization.levels()
    assert body.discretization.levels() is first
    remesh(body, rng, 1)
    assert body.discretization.levels().node_count == body.node_count != first.node_count
    body.changing.forest.restart()
    body.changing.renew()
    back = body.discretization.levels()
    assert back is not first
    assert np.array_equal(back.nodes.numpy(), first.nodes.numpy())


@pytest.mark.parametrize("name", ["mixed", "sphere"])
def test_restriction_is_the_transpose(name, device, rng):
    """Against dense float64 matrices, between any two levels, in two worlds at once."""
    body = body_of(name, device, worlds=2)
    levels, (lattice, tree) = body.discretization.levels(), lattice_and_tree(body)
    expected, places = TreeLevels.of(tree, len(lattice)), places_of(levels)
    level = expected.level[places]
    x, y = rng.standard_normal((2, 2, levels.node_count, 4))
    for coarse, fine in ((0, levels.depth), (0, 3), (3, 6), (4, 5), (6, levels.depth), (5, 5)):
        matrix = expected.prolongation(places, coarse, fine)
        known, found = level <= coarse, level <= fine
        down, up = nodal(y.reshape(-1, 4), device), nodal(x.reshape(-1, 4), device)
        levels.prolongate(up, coarse, fine)
        levels.restrict(down, coarse, fine)
        up, down = (a.numpy().reshape(2, -1, 4) for a in (up, down))
        np.testing.assert_allclose(up[:, found], (matrix @ x)[:, found], rtol=0, atol=4 * ROUNDING * np.abs(x).max())
        summed = matrix.T @ np.where(found[:, None], y, 0.0)
        np.testing.assert_allclose(down[:, known], summed[:, known], rtol=0, atol=16 * ROUNDING * np.abs(summed).max())
        # Nodes beyond both levels keep their values.
        np.testing.assert_array_equal(up[:, ~found], x[:, ~found].astype(np.float32))
        np.testing.assert_array_equal(down[:, ~found], y[:, ~found].astype(np.float32))


@pytest.mark.parametrize("name", ["uniform", "labels"])
def test_inner_products_are_those_of_transposed_operators(name, device, rng):
    levels = body_of(name, device).discretization.levels()
    x, y = rng.standard_normal((2, levels.node_count, 4)).astype(np.float32)
    for coarse in (0, 3, levels.depth - 1):
        known = levels.nodes.numpy()[: levels.starts[coarse + 1]]
        up, down = nodal(x, device), nodal(y, device)
        levels.prolongate(up, coarse)
        levels.restrict(down, coarse)
        one = (up.numpy().astype(float) * y).sum()
        other = (x[known].astype(float) * down.numpy()[known]).sum()
        size = float(np.linalg.norm(up.numpy()) * np.linalg.norm(y))
        assert one == pytest.approx(other, abs=4 * float(ROUNDING) * size)


def test_worlds_share_the_tables(device):
    one, three = (body_of("sphere", device, worlds).discretization.levels() for worlds in (1, 3))
    for name in ("others", "nodes", "ends", "finest", "coarse", "midpoint_starts", "midpoints"):
        assert np.array_equal(getattr(one, name).numpy(), getattr(three, name).numpy()), name
    assert_prolongates_linear_functions(three, FORESTS["sphere"]().lattice)


def test_transfers_can_be_recorded(device, rng):
    levels = body_of("mixed", device).discretization.levels()
    values = rng.standard_normal((levels.node_count, 4))
    for transfer in (levels.prolongate, levels.restrict):
        expected, x = nodal(values, device), nodal(values, device)
        transfer(expected, 2)
        with wp.ScopedCapture(device=device) as capture:
            transfer(x, 2)
        x.assign(values.astype(np.float32))
        wp.capture_launch(capture.graph)
        assert np.array_equal(x.numpy(), expected.numpy())


def test_general_meshes_have_no_levels(device):
    box = wc.TetForest.box((1, 1, 1), 0.1, 1)
    body = wc.SoftBody(wc.TetMesh(box.points, box.tets), SOFT, device=device)
    with pytest.raises(wc.InputError, match="only a TetForest has levels; this mesh is a TetMesh"):
        body.discretization.levels()


def test_levels_and_arrays_that_do_not_fit_are_refused(device):
    levels = body_of("uniform", device, worlds=2).discretization.levels()
    x = wp.zeros(2 * levels.node_count, dtype=wp.vec4, device=device)
    for transfer in (levels.prolongate, levels.restrict):
        for coarse, fine in ((-1, 3), (4, 3), (0, levels.depth + 1)):
            with pytest.raises(wc.InputError, match="they must be in order, from 0 to 7"):
                transfer(x, coarse, fine)
        with pytest.raises(wc.InputError, match=f"it must have 2 \\* {levels.node_count}"):
            transfer(x[:-1])
