"""The present state of a changing forest as a ``TetForest`` on the host."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from warp_corot.mesh import TetForest
from warp_corot.mesh.numbering import renumbered

if TYPE_CHECKING:
    from .pools import DeviceForest


def exported(device: DeviceForest) -> TetForest:
    """See ``DeviceForest.to_forest``."""
    source = device.source
    tree, places = device.tree()
    lattice, ends = device.pools.lattice.numpy(), device.pools.ends.numpy()
    order = device.nodes_in_use
    if source.node_count < len(source.lattice):
        order, stands_for = _without_doubles(order, lattice, np.unique(tree.leaf_tets))
        tree = replace(tree, tets=stands_for[tree.tets])
        ends = np.where(ends < 0, ends, stands_for[ends])
    new_ends, new_tree = renumbered(order, ends, tree)
    lattice = lattice[order]
    leaves = places[tree.leaves]
    known = _same_points(lattice, source.lattice)
    carriage = device.carriage
    return replace(
        source,
        lattice=lattice,
        node_ends=new_ends,
        tree=new_tree,
        phi=None if source.phi is None else _from_ends(source.phi, known, new_ends, first=False),
        node_labels=None if source.node_labels is None else _from_ends(source.node_labels, known, new_ends, first=True),
        snap=None if tree.cut is None else carriage.arrays.snap.numpy()[order, :3],
        fill=None if source.fill is None else carriage.values("fill")[leaves].astype(np.float64),
        labels=None if source.labels is None else carriage.arrays.label.numpy()[leaves],
    )


def _without_doubles(order: np.ndarray, lattice: np.ndarray, real: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge doubled nodes: the nodes that stay, and which of them stands for each.

    A new node of a leaf does not look for a node that void tetrahedra have at the same point; here the two are merged.
    """
    stands_for = np.arange(len(lattice), dtype=np.int32)
    is_real = np.zeros(len(lattice), bool)
    is_real[real] = True
    virtual = order[~is_real[order]]
    twin = _same_points(lattice[virtual], lattice[real])
    doubled = twin >= 0
    stands_for[virtual[doubled]] = real[twin[doubled]]
    gone = np.zeros(len(lattice), bool)
    gone[virtual[doubled]] = True
    return order[~gone[order]], stands_for


def _same_points(points: np.ndarray, among: np.ndarray) -> np.ndarray:
    """The place of each lattice point among others, -1 if it is not there."""
    both, number = np.unique(np.concatenate([among, points]), axis=0, return_inverse=True)
    place = np.full(len(both), -1, np.int64)
    number = number.ravel()
    place[number[: len(among)][::-1]] = np.arange(len(among))[::-1]
    return place[number[len(among) :]]


def _from_ends(values: np.ndarray, known: np.ndarray, ends: np.ndarray, *, first: bool) -> np.ndarray:
    """Values at known points; elsewhere the mean of both ends, or the first end's value."""
    found = np.zeros(len(known), values.dtype)
    there = known >= 0
    found[there] = values[known[there]]
    while not there.all():
        next_ones = np.flatnonzero(~there & there[ends].all(axis=1))
        at_ends = found[ends[next_ones]]
        found[next_ones] = at_ends[:, 0] if first else at_ends.mean(axis=1)
        there[next_ones] = True
    return found
