"""Parts of a box that are made without the whole box equal those cut out of it. One process is enough."""

from types import SimpleNamespace

import numpy as np
import pytest

import warp_corot as wc
from warp_corot.distributed import meshes
from warp_corot.distributed.divided_mesh import divide
from warp_corot.distributed.meshes import cut_box
from warp_corot.distributed.partition import Partition, numbered_points
from warp_corot.mesh.lattice import LATTICE_BITS
from warp_corot.mesh.tree import Tree
from warp_corot.mesh.uniform import halvings


@pytest.mark.parametrize(
    ("cells", "level", "ranks", "costs"),
    [
        ((1, 1, 1), 3, 5, None),
        ((2, 1, 3), 4, 3, None),
        ((3, 2, 1), 5, 7, None),
        ((1, 1, 1), 9, 1, None),
        ((1, 1, 2), 9, 3, [1.0, 3.0, 2.0]),
        ((1, 2, 2), 8, 7, None),
        ((1, 1, 1), 11, 4, None),
    ],
)
def test_parts_are_those_of_the_whole(cells, level, ranks, costs):
    mesh = wc.TetForest.box(cells, 0.1, level)
    dealt, first = Partition.of(mesh, ranks, costs), 0
    for rank in range(ranks):
        kept = dealt.needed(mesh, rank)
        part = divide(mesh, dealt, rank)
        nodes = part.numbers.nodes
        cut = cut_box(cells, level, ranks, rank, costs)
        np.testing.assert_array_equal(cut.elements, np.flatnonzero(kept))
        np.testing.assert_array_equal(cut.counted, dealt.rank_of_element[kept] == rank)
        np.testing.assert_array_equal(cut.tree.leaf_tets, part.tets)
        np.testing.assert_array_equal(cut.owner, dealt.rank_of_node[nodes])
        lattice = cut.lattice << (LATTICE_BITS - halvings(level))
        np.testing.assert_array_equal(lattice[: len(nodes)], part.lattice[: len(nodes)])
        # Nodes are the middles of the same edges.
        ends, theirs = cut.ends[: len(nodes)], part.node_ends[: len(nodes)]
        np.testing.assert_array_equal(ends < 0, theirs < 0)
        inner = ends[:, 0] >= 0
        np.testing.assert_array_equal(
            lattice[ends[inner]].sum(axis=1), part.lattice[theirs[inner]].sum(axis=1, dtype=np.int32)
        )
        # Numbers of nodes follow one another from rank to rank.
        own = nodes[cut.owner == rank]
        np.testing.assert_array_equal(own, first + np.arange(len(own)))
        first += len(own)
    assert first == len(mesh.points)


def test_the_tree_of_a_part_is_a_tree():
    cut = cut_box((1, 2, 1), 7, 3, 1)
    tree = cut.tree
    plain = Tree(tree.tets, tree.level, tree.parent, tree.first_child)
    for name in ("leaves", "leaf_tets", "leaf_levels"):
        np.testing.assert_array_equal(getattr(tree, name), getattr(plain, name))
    inner = np.flatnonzero(tree.first_child >= 0)
    for child in (tree.first_child[inner], tree.first_child[inner] + 1):
        np.testing.assert_array_equal(tree.parent[child], inner)
        np.testing.assert_array_equal(tree.level[child], tree.level[inner] + 1)
    # Both halves of an element fill it.
    volume = np.abs(np.linalg.det(np.diff(cut.lattice[tree.tets].astype(float), axis=1)))
    child = tree.first_child[inner]
    np.testing.assert_allclose(volume[child] + volume[child + 1], volume[inner])


def test_a_large_box_is_cut_without_the_whole():
    """A rank's part of a box of 100 million elements."""
    cells, level, ranks = (1, 1, 1), 24, 20000
    cut = cut_box(cells, level, ranks, 12345)
    assert np.count_nonzero(cut.counted) == pytest.approx(6 * 2**level / ranks, rel=0.01)
    assert len(cut.elements) < 3 * np.count_nonzero(cut.counted)


def test_copies_get_their_numbers_from_the_ranks_that_move_them():
    """Three ranks in one process, one after another."""
    cuts = [cut_box((1, 1, 2), 6, 3, rank) for rank in range(3)]
    mesh = wc.TetForest.box((1, 1, 2), 1.0, 6)
    dealt = Partition.of(mesh, 3)
    counts = [int((cut.owner == rank).sum()) for rank, cut in enumerate(cuts)]

    def told(rank, keys):
        """The numbers of the nodes that a rank moves."""
        own = np.flatnonzero(cuts[rank].owner == rank)
        first = sum(counts[:rank])
        number = dict(zip(cuts[rank].keys[own].tolist(), range(first, first + len(own)), strict=True))
        return np.array([number[key] for key in keys.tolist()], np.int64)

    for rank, cut in enumerate(cuts):
        sent = []

        def alltoall(values, sent=sent):
            sent.append(values)
            # First what others ask for, nothing here; then what they answer.
            none = [np.zeros(0, np.int64)] * 3
            return none if len(sent) == 1 else [told(k, keys) for k, keys in enumerate(sent[0])]

        comm = SimpleNamespace(rank=rank, size=3, allgather=lambda _: counts, alltoall=alltoall)
        numbers, count = numbered_points(cut.owner, cut.keys, comm)
        nodes = divide(mesh, dealt, rank).numbers.nodes
        np.testing.assert_array_equal(numbers, nodes)
        assert count == len(mesh.points)


def test_a_part_is_refused_as_a_whole_body(monkeypatch):
    asked = []

    def alltoall(values):
        asked.append(values)
        return [np.zeros(0, np.int64)] * 2 if len(asked) == 1 else [np.arange(len(keys)) for keys in asked[0]]

    comm = SimpleNamespace(rank=1, size=2, allgather=lambda value: [value, value], alltoall=alltoall)
    monkeypatch.setattr(meshes.mpi, "world", lambda: comm)
    body = wc.SoftBody(meshes.box((1, 1, 2), 0.1, 3), wc.Isotropic(1e3, 0.3, 1000.0), device="cpu")
    np.testing.assert_allclose(body.mesh.bounds, [[0, 0, 0], [0.1, 0.1, 0.2]])
    # Bounds are those of the whole box, of which this part has one half.
    assert len(body.node_indices("z <= zmin")) == 0
    assert len(body.node_indices("z >= zmax")) > 0
    for act in (lambda: wc.Simulation(body), lambda: wc.solve_static(body)):
        with pytest.raises(wc.InputError, match="48 of 96 elements"):
            act()
    with pytest.raises(wc.InputError, match="nearest needs the whole mesh"):
        body.fix("nearest(0, 0, 0)")
    with pytest.raises(wc.InputError, match="cannot be refined"):
        body.mesh.refine([0])


@pytest.mark.parametrize(
    ("given", "said"),
    [({"level": 2}, "at least 3"), ({"level": 48, "cells": (9, 9, 9)}, "at most"), ({"level": 3.5}, "whole number")],
)
def test_bad_boxes_are_refused(given, said, monkeypatch):
    monkeypatch.setattr(meshes.mpi, "world", lambda: SimpleNamespace(rank=0, size=1))
    with pytest.raises(wc.InputError, match=said):
        meshes.box(**given)
