"""The forest of bisected tetrahedra: the table of the three types, the tree, conformity, sequential bisection."""

import itertools

import numpy as np
import oracle
import pytest
import warp as wp
from cases import CUBE, mixed_forest
from sequential import Bisection

import warp_corot as wc
from warp_corot.discretization.elements import device_elements

PAIRS = list(itertools.combinations(range(4), 2))


def frames(forest):
    """The table's columns [T, 3, 3] (last axis: column) from the vertices, and h [T]."""
    x = np.moveaxis(forest.points[forest.tets], 1, 0)
    h = forest.cell_size / 2.0 ** (forest.levels // 3)
    root2 = np.sqrt(2)
    table = (
        (x[1] - x[0], x[2] - x[1], x[3] - x[2]),
        (x[1] - x[0], x[2] - x[1], 2 * x[3] - x[0] - x[2]),
        (root2 * (x[0] - x[2]), root2 * (x[1] - x[2]), 2 * (x[3] - x[2])),
    )
    columns = np.stack([np.stack(row, axis=-1) for row in table])
    return columns[forest.levels % 3, np.arange(len(h))] / h[:, None, None], h


def leaf_set(forest):
    """Leaves as (level, vertices in Maubach order) on the oracle's lattice."""
    lattice = np.rint((forest.points - forest.origin) / forest.cell_size * Bisection.CUBE).astype(int)
    vertices = lattice[forest.tets]
    return [
        (int(level), *(tuple(int(c) for c in p) for p in tet))
        for level, tet in zip(forest.levels, vertices, strict=True)
    ]


def assert_conforming(forest):
    """Every face is shared by two leaves or lies on the boundary, and no node lies in the middle of an edge."""
    faces = np.concatenate([forest.tets[:, list(face)] for face in itertools.combinations(range(4), 3)])
    faces, count = np.unique(np.sort(faces, axis=1), axis=0, return_counts=True)
    assert count.max() <= 2
    single = forest.points[faces[count == 1]]
    low, high = forest.points.min(0), forest.points.max(0)
    on_boundary = ((single == low).all(1) | (single == high).all(1)).any(1)
    assert on_boundary.all()
    edges = np.unique(np.sort(np.concatenate([forest.tets[:, pair] for pair in PAIRS]), axis=1), axis=0)
    doubled = {tuple(p) for p in np.rint(2 * forest.points / forest.cell_size * 2**20).astype(int)}
    ends = np.rint(forest.points / forest.cell_size * 2**20).astype(int)[edges].sum(1)
    assert doubled.isdisjoint(map(tuple, ends))


def test_the_papers_mesh():
    forest = wc.TetForest.box(cells=(1, 1, 3), cell_size=CUBE, level=6)
    assert forest.points.shape == (325, 3)
    assert forest.tets.shape == (1152, 4)
    assert forest.points.dtype == np.float64
    assert forest.tets.dtype == np.int32
    assert forest.levels.dtype == np.int32
    assert (forest.levels == 6).all()
    assert forest.points.min(0) == pytest.approx([0, 0, 0])
    assert forest.points.max(0) == pytest.approx([0.064, 0.064, 0.192])


@pytest.mark.parametrize("level", range(8))
@pytest.mark.parametrize("cells", [(1, 1, 1), (2, 1, 3)])
def test_uniform_leaves_are_those_of_the_sequential_bisection(cells, level):
    forest = wc.TetForest.box(cells, CUBE, level, origin=(0.5, -1.0, 2.0))
    leaves = leaf_set(forest)
    assert len(leaves) == 6 * np.prod(cells) * 2**level
    assert set(leaves) == Bisection(cells, level).leaves
    assert len(np.unique(forest.points, axis=0)) == len(forest.points)
    assert np.array_equal(np.unique(forest.tets), np.arange(len(forest.points)))


@pytest.mark.parametrize("seed", range(6))
def test_refined_leaves_are_those_of_the_sequential_bisection(seed):
    """Random leaves are bisected, three times: conformity adds exactly the required bisections."""
    rng = np.random.default_rng(seed)
    forest, sequential = wc.TetForest.box((2, 1, 1), CUBE, seed % 3), Bisection((2, 1, 1), seed % 3)
    for _ in range(3):
        chosen = rng.random(len(forest.tets)) < 0.15
        chosen[0] = True
        leaves = leaf_set(forest)
        for index in np.flatnonzero(chosen):
            sequential.refine(leaves[index])
        before = forest
        forest = before.refine(chosen)
        assert set(leaf_set(forest)) == sequential.leaves
        assert set(leaf_set(before.refine(np.flatnonzero(chosen)))) == sequential.leaves
        assert np.array_equal(forest.points[: len(before.points)], before.points)
        assert leaf_set(before) == leaves  # the old forest is unchanged
    assert len(set(forest.levels)) > 2


def test_refining_one_corner_deeply_stays_conforming():
    """The leaf at one corner bisected thirty times: levels from 0 to 30 side by side in a small forest."""
    forest = wc.TetForest.box((2, 2, 1), CUBE, 0)
    for _ in range(30):
        at_corner = np.flatnonzero((forest.points[forest.tets] == 0).all(2).any(1))
        forest = forest.refine(at_corner[:1])
    assert forest.levels.max() >= 20
    assert forest.levels.min() <= 3
    assert len(forest.tets) < 3000
    assert_conforming(forest)
    assert oracle.Mesh(forest.points, forest.tets).volumes.sum() == pytest.approx(4 * CUBE**3)


@pytest.mark.parametrize("level", range(10))
def test_table_of_the_types(level):
    """At rest the table's columns are orthonormal, and volumes are h^3/6, h^3/12, h^3/24, half of them mirrored."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, level)
    F, h = frames(forest)
    assert np.abs(np.swapaxes(F, 1, 2) @ F - np.eye(3)).max() < 1e-12
    volumes = oracle.Mesh(forest.points, forest.tets).volumes
    assert np.allclose(volumes, h**3 / (6, 12, 24)[level % 3], rtol=1e-12)
    assert np.allclose(forest.volumes, volumes, rtol=1e-12)
    assert volumes.sum() == pytest.approx(CUBE**3, rel=1e-12)
    assert (np.linalg.det(F) < 0).mean() == 0.5


def test_table_of_the_types_in_mixed_levels():
    forest = mixed_forest(cells=(2, 1, 1), level=1, passes=5)
    F, _ = frames(forest)
    assert set(forest.levels % 3) == {0, 1, 2}
    assert np.abs(np.swapaxes(F, 1, 2) @ F - np.eye(3)).max() < 1e-12
    volumes = oracle.Mesh(forest.points, forest.tets).volumes
    assert np.allclose(forest.volumes, volumes, rtol=1e-12)
    assert volumes.sum() == pytest.approx(2 * CUBE**3)


@pytest.mark.parametrize("level", range(10))
def test_there_are_48_frames(level):
    """The six roots have six frames; from level 3 on, each level has 48, whatever its type."""
    F, _ = frames(wc.TetForest.box((2, 1, 1), CUBE, level))
    assert len(np.unique(np.round(F, 6) + 0.0, axis=0)) == min(6 * 2**level, 48)


@pytest.mark.parametrize("level", range(9))
def test_shapes_are_as_good_as_the_paper_says(level):
    """Aspect ratio 3 r_in / R is at least 0.64, and R over the shortest edge at most sqrt(5)/2."""
    forest = wc.TetForest.box((1, 1, 1), 1.0, level)
    x = forest.points[forest.tets]
    edges = x[:, 1:] - x[:, :1]
    centre = np.linalg.solve(2 * edges, (edges**2).sum(2)[..., None])[..., 0]
    circumradius = np.linalg.norm(centre, axis=1)
    area = sum(
        np.linalg.norm(np.cross(x[:, j] - x[:, i], x[:, k] - x[:, i]), axis=1) / 2
        for i, j, k in itertools.combinations(range(4), 3)
    )
    inradius = 3 * np.abs(np.linalg.det(edges)) / 6 / area
    shortest = np.min([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in PAIRS], axis=0)
    assert (3 * inradius / circumradius).min() > 0.64 - 0.005
    assert (circumradius / shortest).max() < np.sqrt(5) / 2 + 1e-12


# --- the tree ---------------------------------------------------------------------------------------------------------


@pytest.fixture(params=["uniform", "mixed"])
def forest(request):
    return wc.TetForest.box((2, 1, 1), CUBE, 5) if request.param == "uniform" else mixed_forest(cells=(2, 1, 1))


def test_children_are_the_bisections_of_their_parent(forest):
    tree = forest.tree
    parents = np.flatnonzero(tree.first_child >= 0)
    first = tree.first_child[parents]
    assert (tree.parent[first] == parents).all()
    assert (tree.parent[first + 1] == parents).all()
    assert (tree.level[first] == tree.level[parents] + 1).all()
    assert (tree.level[first + 1] == tree.level[parents] + 1).all()
    assert len(tree.tets) == 12 + 2 * len(parents)
    assert ((tree.parent < 0) == (tree.level == 0)).all()
    points = np.rint(forest.points / CUBE * Bisection.CUBE).astype(int)

    def leaf(t):
        return (int(tree.level[t]), *(tuple(int(c) for c in points[n]) for n in tree.tets[t]))

    for parent, child in zip(parents, first, strict=True):
        assert Bisection.children(leaf(parent)) == (leaf(child), leaf(child + 1))


def test_leaves_are_in_tree_order(forest):
    """A walk down the tree, first children first, visits the leaves in order, so siblings are neighbours."""
    tree = forest.tree
    walked, stack = [], list(np.flatnonzero(tree.parent < 0)[::-1])
    while stack:
        t = stack.pop()
        if tree.first_child[t] < 0:
            walked.append(t)
        else:
            stack += [tree.first_child[t] + 1, tree.first_child[t]]
    assert np.array_equal(tree.leaves, walked)
    assert np.array_equal(forest.tets, tree.tets[walked])
    assert np.array_equal(forest.levels, tree.level[walked])


def test_rows_and_what_is_above(forest):
    """Rows are those of the whole tree; k steps up are k parents, and above a root there is nothing."""
    tree = forest.tree
    everything = np.arange(len(tree.level))
    for chosen in (tree.leaves, everything[tree.level == 3], everything[::-3], everything[:0]):
        tets, level = tree.rows(chosen)
        assert np.array_equal(tets, tree.tets[chosen])
        assert np.array_equal(level, tree.level[chosen])
        climbed = np.array(chosen)
        for steps in range(7):
            assert np.array_equal(tree.above(chosen, steps), climbed)
            climbed = np.where(climbed >= 0, tree.parent[climbed], -1)


@pytest.mark.parametrize("level", range(9))
def test_ancestors(forest, level):
    """The ancestor at a level contains the leaf's centroid; a leaf above that level is its own ancestor."""
    tree, found = forest.tree, forest.ancestors(level)
    assert np.array_equal(tree.level[found], np.minimum(forest.levels, level))
    above = forest.levels <= level
    assert np.array_equal(found[above], tree.leaves[above])
    corners = forest.points[tree.tets[found]]
    centroid = forest.points[forest.tets].mean(1) - corners[:, 0]
    weights = np.linalg.solve(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2), centroid[..., None])[..., 0]
    assert (weights > 0).all()
    assert (weights.sum(1) < 1).all()


def test_nodes_are_midpoints_of_their_ends(forest):
    inner = forest.node_ends[:, 0] >= 0
    ends = forest.node_ends[inner]
    assert np.array_equal(2 * forest.lattice[inner], forest.lattice[ends].sum(1))
    corners = forest.points[~inner] / CUBE
    assert np.array_equal(corners, np.round(corners))
    assert len(corners) == 12
    assert np.allclose(forest.points, forest.lattice * (CUBE / 2**16))
    assert len(np.unique(forest.lattice, axis=0)) == len(forest.points)


def test_node_ends_are_the_bisected_edges(forest):
    tree = forest.tree
    parents = np.flatnonzero(tree.first_child >= 0)
    k = 3 - tree.level[parents] % 3
    middle = tree.tets[tree.first_child[parents], k]
    ends = np.stack([tree.tets[parents, 0], tree.tets[parents, k]], axis=1)
    assert np.array_equal(forest.node_ends[middle], np.sort(ends, axis=1))
    assert np.array_equal(np.unique(middle), np.flatnonzero(forest.node_ends[:, 0] >= 0))


@pytest.mark.parametrize("level", range(14))
def test_nodes_are_numbered_as_the_leaves_name_them(level):
    for cells in ((1, 1, 1), (1, 2, 1)):
        forest = wc.TetForest.box(cells, CUBE, level)
        nodes, first = np.unique(forest.tets, return_index=True)
        assert np.array_equal(nodes, np.arange(len(forest.points)))
        assert (np.diff(first) > 0).all()


@pytest.mark.parametrize("level", range(14))
def test_a_uniform_forest_is_the_level_above_refined(level):
    """Patch by patch from the roots, or leaf by leaf from the level above: same tetrahedra in the same order."""
    at_once = wc.TetForest.box((1, 2, 1), CUBE, level + 1)
    above = wc.TetForest.box((1, 2, 1), CUBE, level)
    refined = above.refine(np.ones(len(above.tets), bool))
    assert np.array_equal(refined.lattice[refined.tets], at_once.lattice[at_once.tets])
    assert np.array_equal(refined.levels, at_once.levels)
    assert np.array_equal(refined.volumes, at_once.volumes)
    for name in ("level", "parent", "first_child", "leaves"):
        assert np.array_equal(getattr(refined.tree, name), getattr(at_once.tree, name))
    assert np.array_equal(refined.lattice[refined.tree.tets], at_once.lattice[at_once.tree.tets])


def test_frames_down_to_the_deepest_level(device):
    """One corner is bisected to the end of the lattice: local frames on the device equal the table's at every level."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, 0)
    while forest.levels.max() < 48:
        at_corner = (forest.points[forest.tets] == 0).all(2).any(1)
        forest = forest.refine([np.argmax(np.where(at_corner, forest.levels, -1))])
    F, _ = frames(forest)
    F[np.linalg.det(F) < 0, :, 2] *= -1
    elements = device_elements(forest, wp.get_device(device))
    code = elements.code.numpy()
    assert np.array_equal(code & 63, forest.levels)
    assert np.abs(elements.frames.numpy()[code >> 7] - F).max() < 1e-6
    with pytest.raises(wc.InputError, match="deepest"):
        forest.refine([np.argmax(forest.levels)])


def test_neighbours_in_memory_are_neighbours_in_space():
    """Eight consecutive leaves are a subtree of three levels: they have ten nodes, close together."""
    forest = wc.TetForest.box((1, 1, 1), 1.0, 9)
    groups = forest.tets.reshape(-1, 8 * 4)
    assert {len(np.unique(group)) for group in groups} == {10}
    spread = np.ptp(forest.points[groups], axis=1).max()
    assert spread <= 1 / 4 + 1e-12


def test_large_forest_is_built():
    forest = wc.TetForest.box((1, 1, 1), 1.0, 15)
    assert len(forest.tets) == 6 * 2**15
    assert len(forest.points) == 33**3
    assert oracle.Mesh(forest.points, forest.tets).volumes.sum() == pytest.approx(1.0)


@pytest.mark.slow
def test_a_million_and_a_half():
    forest = wc.TetForest.box((1, 1, 1), 1.0, 18)
    assert len(forest.tets) == 6 * 2**18
    assert len(forest.points) == 65**3
    assert forest.volumes.sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        ({"cells": (1, 0, 1)}, "cells"),
        ({"cells": (1, 1)}, "cells"),
        ({"cells": (1, 1.5, 1)}, "cells"),
        ({"cell_size": 0.0}, "cell_size"),
        ({"cell_size": -1.0}, "cell_size"),
        ({"cell_size": np.nan}, "cell_size"),
        ({"level": -1}, "level"),
        ({"level": 1.5}, "level"),
        ({"level": 1000}, "level"),
        ({"level": 29}, "level.*2147483647"),
        ({"origin": (0, np.inf, 0)}, "origin"),
        ({"origin": (0, 0)}, "origin"),
        ({"up_axis": "y"}, "up_axis"),
    ],
)
def test_bad_box(arguments, named):
    with pytest.raises(wc.InputError, match=named):
        wc.TetForest.box(**arguments)


@pytest.mark.parametrize("chosen", [[6], [-7], np.zeros(5, bool), [0.5], np.zeros((6, 1), bool)])
def test_bad_refinement(chosen):
    with pytest.raises(wc.InputError):
        wc.TetForest.box().refine(np.array(chosen))
