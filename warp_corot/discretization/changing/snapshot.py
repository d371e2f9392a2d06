"""The state of a changing forest at one time, and as a ``TetForest`` on the host."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.meshing.growth import LIVE, VOID
from warp_corot.kernels.remesh import pools as kernels
from warp_corot.kernels.remesh.pools import SINKS
from warp_corot.kernels.remesh.state import NO_ROW, Carried
from warp_corot.kernels.tables.shapes import FRAME_SHIFT
from warp_corot.mesh import TetForest
from warp_corot.mesh.tree import renumbered

if TYPE_CHECKING:
    from warp_corot.discretization.changing.pools import DeviceForest


#: Arrays of ``kernels.remesh.pools.Pools``, without those that have no meaning after a pass.
OF_NODES: tuple[str, ...] = ("lattice", "ends", "valence")
OF_TETRAHEDRA: tuple[str, ...] = ("tets", "level", "parent", "first_child", "code", "cut")

#: Of ``kernels.remesh.state.Carried``.
CARRIED_BY_NODES: tuple[str, ...] = (
    "rest",
    "u",
    "v",
    "load",
    "reaction",
    "snap",
    "mass",
    "held",
    "row",
    "mass32",
    "inverse_mass",
)
CARRIED_BY_TETRAHEDRA: tuple[str, ...] = ("density", "label", "values", "numbers")


def padding(start: int, stop: int, sink: int) -> npt.NDArray[np.int32]:
    """The contents of ``Pools.leaf_tets`` in places without leaves, int32 [stop - start, 4].

    Args:
        start, stop: The places.
        sink: ``Pools.sink``, the first place past the last node.
    """
    sinks = sink + np.arange(start, stop, dtype=np.int32) % int(SINKS)
    return np.repeat(sinks[:, None], 4, axis=1)


# --- the state at one time -------------------------------------------------------------------------------------------


#: The contents of unused places, if they are not zero.
_UNUSED = {"level": int(kernels.UNUSED), "row": int(NO_ROW)}

_CARRIED = (*CARRIED_BY_NODES, *CARRIED_BY_TETRAHEDRA, "impulse", "cut_area")


class Piece(NamedTuple):
    """One stretch of an array of ``kernels.remesh.pools.Pools`` or ``kernels.remesh.state.Carried``."""

    name: str
    start: int
    values: wp.array


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of the used parts of all arrays, on the device.

    Attributes:
        counts: ``Pools.counts``, int32.
        pieces: The stretches.
    """

    counts: npt.NDArray[np.int32]
    pieces: tuple[Piece, ...]

    @classmethod
    def of(cls, pools: kernels.Pools, carried: Carried) -> Snapshot:
        """The present state of ``kernels.remesh.pools.Pools`` and ``kernels.remesh.state.Carried``."""
        counts = pools.counts.numpy().copy()
        stretches = ((name, start, count) for name, start, count in _in_use(pools, carried, counts) if count)
        pieces = (
            Piece(n, start, wp.clone(array_of(pools, carried, n)[start : start + count]))
            for n, start, count in stretches
        )
        return cls(counts, tuple(pieces))

    def restore(self, pools: kernels.Pools, carried: Carried) -> None:
        """Write the state back into the same arrays."""
        present = pools.counts.numpy()
        leaves, known = int(present[kernels.LEAVES]), int(self.counts[kernels.LEAVES])
        if leaves > known:
            pools.leaf_tets[known:leaves].assign(padding(known, leaves, pools.sink))
        for name in (*OF_TETRAHEDRA, *OF_NODES, *CARRIED_BY_TETRAHEDRA, *CARRIED_BY_NODES):
            array_of(pools, carried, name).fill_(_UNUSED.get(name, 0))
        for name, start, values in self.pieces:
            array_of(pools, carried, name)[start : start + len(values)].assign(values)
        counts = self.counts.copy()
        # The count of rounds continues, so that nodes touched in later rounds do not look newly touched.
        counts[kernels.STAMP] = present[kernels.STAMP]
        pools.counts.assign(counts)


def check_places(
    pools: kernels.Pools, carried: Carried, counts: npt.NDArray[np.int32], pieces: dict[str, npt.NDArray[Any]]
) -> None:
    """Check that the stretches lie within the arrays.

    Args:
        pools, carried: The destination of the stretches.
        counts: ``Pools.counts``.
        pieces: Values, by the name of their array and, after a dot, the beginning of the stretch.

    Raises:
        ValueError: A stretch goes beyond an array; in one line.
    """
    levels = len(carried.volume)
    places, nodes, named = len(pools.level), len(pools.lattice), len(carried.rest)
    bounds = {"tets": (-1, nodes), "ends": (-1, nodes), "leaf_tets": (0, named), "level": (-1, levels)}
    bounds |= {name: (0, places) for name in ("leaves", "free_pairs", "void_leaves")}
    bounds |= {"parent": (-1, places), "first_child": (min(int(LIVE), int(VOID)), places)}
    for key, values in pieces.items():
        name, _, _ = key.partition(".")
        lowest, end = bounds.get(name, (None, None))
        if name == "code":
            values, lowest, end = values >> FRAME_SHIFT, 0, len(pools.frames)
        if end is not None and values.size and (values.min() < lowest or values.max() >= end):
            raise ValueError(f"{name} has {values.min()} to {values.max()}, should be {lowest} to {end - 1}")
    for place, most in ((kernels.LEAVES, pools.leaves), (kernels.FREE_PAIRS, pools.free_pairs)):
        if not 0 <= counts[place] <= len(most):
            raise ValueError(f"{counts[place]} places are counted, and there are {len(most)}")
    if not 0 <= counts[kernels.NODE_TOP] <= pools.node_limit:
        raise ValueError(f"{counts[kernels.NODE_TOP]} nodes are counted, and there are {pools.node_limit}")


def array_of(pools: kernels.Pools, carried: Carried, name: str) -> wp.array:
    """An array of the pools or of the carried state."""
    return getattr(carried if name in _CARRIED else pools, name)


def _in_use(pools: kernels.Pools, carried: Carried, counts: npt.NDArray[np.int32]) -> Iterator[tuple[str, int, int]]:
    """The stretches in use: names of arrays, and the beginning and length of each stretch."""
    used = int(np.flatnonzero(pools.level.numpy() != kernels.UNUSED)[-1]) + 1
    for name in (*OF_TETRAHEDRA, *CARRIED_BY_TETRAHEDRA):
        if array_of(pools, carried, name).size:
            yield name, 0, used
    for name in (*OF_NODES, *CARRIED_BY_NODES):
        yield name, 0, int(counts[kernels.NODE_TOP])
        yield name, pools.node_limit, pools.sink - pools.node_limit
    yield "free_pairs", 0, int(counts[kernels.FREE_PAIRS])
    for name in ("leaves", "leaf_tets"):
        yield name, 0, int(counts[kernels.LEAVES])
    yield "void_leaves", 0, pools.void_count
    yield "impulse", 0, 1
    yield "cut_area", 0, 1


# --- the present state as a ``TetForest`` ----------------------------------------------------------------------------


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
