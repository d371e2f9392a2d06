"""A forest on the device that can change there: pools of tetrahedra and nodes, and the leaves in tree order; its state
at one time, and as a ``TetForest`` on the host."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.transfer import Carriage, Column, Numbers
from warp_corot.discretization.elements import all_frames, device_frames
from warp_corot.discretization.planner import threads_on
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_device
from warp_corot.kernels.remesh import pools as kernels
from warp_corot.kernels.remesh.pools import NO_ROW, SINKS, Carried
from warp_corot.kernels.tables.shapes import FRAME_SHIFT
from warp_corot.mesh import TetForest
from warp_corot.mesh.tree import LIVE, VOID, Tree, at_midpoints, renumbered

#: Arrays of ``kernels.remesh.pools.Pools``, without those that have no meaning after a pass.
OF_NODES: tuple[str, ...] = ("lattice", "ends", "valence")
OF_TETRAHEDRA: tuple[str, ...] = ("tets", "level", "parent", "first_child", "code", "cut")

#: Of ``kernels.remesh.pools.Carried``.
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
    """One stretch of an array of ``kernels.remesh.pools.Pools`` or ``kernels.remesh.pools.Carried``."""

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
        """The present state of ``kernels.remesh.pools.Pools`` and ``kernels.remesh.pools.Carried``."""
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
        counts = self.counts[: kernels.COUNTS].copy()
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
    bounds |= {name: (0, places) for name in ("leaves", "free_pairs")}
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
        phi=at_midpoints(source.phi, known, new_ends),
        node_labels=at_midpoints(source.node_labels, known, new_ends, first=True),
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


class PassCounts(NamedTuple):
    """The counts that the host reads after a pass.

    Attributes:
        leaves, nodes: Numbers of leaves and nodes; nodes of only void tetrahedra are not counted.
        added, removed: Nodes made and removed in the last pass. If both are zero, the mesh did not change.
        full: Whether a refinement was ever skipped because the pools were full.
    """

    leaves: int
    nodes: int
    added: int
    removed: int
    full: bool

    @classmethod
    def of(cls, counts: npt.NDArray[np.int32]) -> PassCounts:
        """From a copy of ``pools.counts``."""
        leaves, nodes, added, removed, full = (
            int(counts[which])
            for which in (kernels.LEAVES, kernels.NODE_TOP, kernels.ADDED, kernels.REMOVED, kernels.FULL)
        )
        return cls(leaves, nodes, added, removed, bool(full))


class DeviceForest:
    """A forest in pools of fixed capacity.

    The N nodes that leaves name are 0 … N - 1 after every pass. Nodes that only void tetrahedra name stand at the end
    of the pool and stay there. Nodes keep their numbers, except in passes that remove some: then the last ones move
    into the gaps. Tetrahedra keep their numbers as long as they are in use. Nodal arrays are zero beyond N, and
    ``pools.leaf_tets`` names sinks, places past the last node, beyond the last leaf. So a launch may go through more
    nodes, up to ``node_capacity``, and more leaves, up to ``capacity + LEAF_PADDING``, than there are.

    Args:
        forest: The mesh to begin with. Its void tetrahedra stay as they are.
        capacity: Maximum number of leaves.
        density: Mass per rest volume [kg/m^3], a number or one for each leaf [T], to be multiplied by the forest's
            filled share.
        values: Other quantities of leaves by name, [T] each, per full rest volume, as Lamé's parameters times the
            filled share. Children have their parent's value; a parent has its children's mean, or what a ``Column``
            says.
        node_capacity: Maximum number of nodes; None: one more for every two more leaves. Meshes usually have five or
            six leaves for each node.
        device: "cpu", "cuda:0", …; None for Warp's default.

    Attributes:
        pools: ``kernels.remesh.pools.Pools``.
        carriage: The quantities that nodes and tetrahedra carry.
        source: The forest that this began as.
        begun_with: Number of tetrahedra of all levels at the beginning, which keep the first places.
        capacity, node_capacity, tree_capacity: Places for leaves, nodes, and tetrahedra of all levels.
        remembered: The state to which ``restart`` returns.
        virtual_count: Nodes that only void tetrahedra name.
        threads: Threads of a launch.

    Raises:
        InputError: The mesh is not a forest, the capacity is below its size, or larger than can be numbered.
    """

    def __init__(
        self,
        forest: TetForest,
        capacity: int,
        *,
        density: npt.ArrayLike = 1.0,
        values: Mapping[str, npt.ArrayLike | Column | Numbers] | None = None,
        node_capacity: int | None = None,
        device: str | wp.Device | None = None,
    ):
        if not isinstance(forest, TetForest):
            raise InputError(f"only a TetForest can be remeshed; this is a {type(forest).__name__}")
        self.source = forest
        self.device = checked_device(device)
        tree = forest.tree
        leaves, nodes, elements = len(tree.leaves), len(forest.lattice), len(tree.level)
        self.capacity = checked_count(capacity, "capacity", least=leaves)
        more = self.capacity - leaves
        self.node_capacity = (
            nodes + (more + 1) // 2 if node_capacity is None else checked_count(node_capacity, "node_capacity", nodes)
        )
        self.virtual_count = nodes - forest.node_count
        self.begun_with, self.tree_capacity = elements, elements + 2 * more
        if self.tree_capacity >= 2**31:
            raise InputError(f"capacity is {capacity}: that is {self.tree_capacity} tetrahedra; there can be 2**31 - 1")
        self.threads = threads_on(self.device)
        self.pools = self._make_pools(tree)
        self.carriage = Carriage(forest, self.node_capacity, self.tree_capacity, density, values or {}, self.device)
        self.remember()

    def __repr__(self) -> str:
        return f"DeviceForest({self.leaf_count} of {self.capacity} leaves on {self.device})"

    # --- looking; each of these waits for the device ---------------------------------------------------------------

    @property
    def leaf_count(self) -> int:
        return self.count(kernels.LEAVES)

    @property
    def node_count(self) -> int:
        """Nodes that leaves name."""
        return self.count(kernels.NODE_TOP)

    def count(self, which: int) -> int:
        """One of the counts of ``kernels.remesh.pools``."""
        return int(self.pools.counts.numpy()[which])

    @property
    def nodes_in_use(self) -> npt.NDArray[np.intp]:
        """Places of the nodes in the order of ``to_forest``: those of the leaves, 0 … N - 1, then the others."""
        limit = self.node_capacity - self.virtual_count
        return np.concatenate([np.arange(self.node_count), np.arange(limit, self.node_capacity)])

    @property
    def leaf_elements(self) -> npt.NDArray[np.int32]:
        """The leaves' places in the pool of tetrahedra, in tree order, int32 [T]."""
        return self.pools.leaves.numpy()[: self.leaf_count]

    @property
    def leaf_tets(self) -> npt.NDArray[np.int32]:
        """The leaves' nodes by their places in the pool, in tree order, int32 [T, 4]."""
        return self.pools.leaf_tets.numpy()[: self.leaf_count]

    def tree(self) -> tuple[Tree, npt.NDArray[np.intp]]:
        """The tree without unused places, its nodes by their places in the pool; and where its tetrahedra stand."""
        pools = self.pools
        arrays = (getattr(pools, name).numpy() for name in ("tets", "level", "parent", "first_child", "cut"))
        whole = Tree(*arrays)
        used = np.flatnonzero(whole.level != kernels.UNUSED)
        tree = whole.taken(used)
        return tree if tree.cut is not None and tree.cut.any() else replace(tree, cut=None), used

    def to_forest(self) -> TetForest:
        """The present mesh on the host, its leaves as here in tree order.

        All nodes that leaves name keep their numbers. In a domain's mesh, the function's values at new nodes are means,
        as in ``TetForest.refine``; ``fill`` and ``labels`` are those that the leaves carry.
        """
        return exported(self)

    def remember(self) -> None:
        """Save the present mesh and all that it carries for ``restart``. The constructor does this once."""
        self.remembered = Snapshot.of(self.pools, self.carriage.arrays)

    def restart(self) -> None:
        """Return to the state that was saved last. Arrays stay the same, so recorded passes and steps stay valid."""
        self.remembered.restore(self.pools, self.carriage.arrays)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _make_pools(self, tree: Tree) -> kernels.Pools:
        forest, device = self.source, self.device
        leaves, elements = tree.leaves, len(tree.level)
        number = self._numbers()
        tets, frames = number[tree.tets], all_frames()
        pools = kernels.Pools()
        pools.roots = int(np.count_nonzero(tree.parent < 0))
        pools.node_limit = self.node_capacity - self.virtual_count
        pools.sink = self.node_capacity
        pools.tets = self._filled(tets, self.tree_capacity, wp.vec4i)
        pools.level = self._filled(tree.level, self.tree_capacity, wp.int32, kernels.UNUSED)
        pools.parent = self._filled(tree.parent, self.tree_capacity, wp.int32, -1)
        pools.first_child = self._filled(tree.first_child, self.tree_capacity, wp.int32, LIVE)
        codes = frames.codes(forest.lattice, tree.tets, tree.level)
        pools.code = self._filled(codes, self.tree_capacity, wp.int32)
        pools.frames = device_frames(device)[0]
        pools.child_code = wp.array(frames.of_children, dtype=wp.int32, device=device)
        cut = np.zeros(0, np.int32) if tree.cut is None else tree.cut
        pools.cut = self._filled(cut, self.tree_capacity, wp.int32)
        pools.next = wp.empty(self.tree_capacity, dtype=wp.int32, device=device)
        free_pairs = np.arange(self.tree_capacity - 2, elements - 1, -2, dtype=np.int32)
        most_pairs = (self.tree_capacity - pools.roots) // 2
        pools.free_pairs = self._filled(free_pairs, most_pairs, wp.int32)
        pools.fresh = wp.empty(max(most_pairs, 1), dtype=wp.int32, device=device)
        pools.lattice = self._filled(forest.lattice, self.node_capacity, wp.vec3i, places=number)
        ends = np.where(forest.node_ends < 0, np.int32(-1), number[forest.node_ends])
        pools.ends = self._filled(ends, self.node_capacity, wp.vec2i, -1, places=number)
        valence = np.bincount(tets[tree.first_child < 0].ravel(), minlength=self.node_capacity)
        pools.valence = self._filled(valence, self.node_capacity, wp.int32)
        pools.touched = wp.zeros(self.node_capacity, dtype=wp.int32, device=device)
        pools.leaves = self._filled(leaves, self.capacity, wp.int32)
        unused = padding(len(leaves), self.capacity + kernels.LEAF_PADDING, self.node_capacity)
        pools.leaf_tets = wp.array(np.concatenate([tets[leaves], unused]), dtype=wp.vec4i, device=device)
        pools.new_leaves = wp.empty(self.capacity, dtype=wp.int32, device=device)
        pools.marks = wp.zeros(self.capacity, dtype=wp.int8, device=device)
        counts = np.zeros(kernels.COUNTS, np.int32)
        counts[kernels.LEAVES] = len(leaves)
        counts[kernels.FREE_PAIRS] = len(free_pairs)
        counts[kernels.NODE_TOP] = counts[kernels.OLD_TOP] = forest.node_count
        pools.counts = wp.array(counts, dtype=wp.int32, device=device)
        return pools

    def _numbers(self) -> npt.NDArray[np.int32]:
        """Places of the source's nodes: first the nodes of leaves, then the others at the end."""
        real = self.source.node_count
        number = np.arange(len(self.source.lattice), dtype=np.int32)
        number[real:] += self.node_capacity - len(number)
        return number

    def _filled(
        self,
        values: npt.NDArray[Any],
        size: int,
        dtype: type,
        rest: int = 0,
        places: npt.NDArray[np.int32] | slice | None = None,
    ) -> wp.array:
        """Values at these places of an array of a size, or at its beginning."""
        padded = np.full((max(size, 1), *values.shape[1:]), rest, np.int32)
        padded[slice(len(values)) if places is None else places] = values
        return wp.array(padded, dtype=dtype, device=self.device)
