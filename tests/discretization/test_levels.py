"""Nodes by tree level, and linear transfers between levels."""

import numpy as np
import pytest
from remesh_cases import apply_marks, counts_of, random_marks
from remeshed import SOFT
from tree_levels import TreeLevels
from volumes import blobs

import warp_corot as wc


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
        apply_marks(body.changing.passes, random_marks(body.changing.forest, rng, 0.05, 0.3))
        body.changing.renew()
        counts = counts_of(body.changing.forest)
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
    """Levels and ends equal those found by walking down the tree, and every order is deterministic."""
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


@forests
def test_levels_and_ends_are_the_trees(name, device):
    body = body_of(name, device)
    assert_equals_the_tree(body.discretization.levels(), body)


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


def test_worlds_share_the_tables(device):
    one, three = (body_of("sphere", device, worlds).discretization.levels() for worlds in (1, 3))
    for name in ("others", "nodes", "ends"):
        assert np.array_equal(getattr(one, name).numpy(), getattr(three, name).numpy()), name


def test_general_meshes_have_no_levels(device):
    box = wc.TetForest.box((1, 1, 1), 0.1, 1)
    body = wc.SoftBody(wc.TetMesh(box.points, box.tets), SOFT, device=device)
    with pytest.raises(wc.InputError, match="only a TetForest has levels; this mesh is a TetMesh"):
        body.discretization.levels()
