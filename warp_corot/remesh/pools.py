"""A forest on the device that can change there: pools of tetrahedra and nodes, and the leaves in tree order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ..checks import checked_count
from ..device import checked_device
from ..errors import InputError
from ..kernels import remesh as kernels
from ..mesh import TetForest
from ..mesh.tree import LIVE, Tree
from .transfer import Carriage

#: Threads of a launch on CUDA for each multiprocessor.
THREADS_PER_PROCESSOR = 1024


class DeviceForest:
    """A forest in pools of fixed capacity.

    Numbers of nodes and of tetrahedra in the pools stay theirs as long as they are in use. Nothing is said of the
    places that are not in use, but that nodes there have no mass, displacement, velocity or load.

    Args:
        forest: The mesh to begin with. Its void tetrahedra stay as they are.
        capacity: How many leaves there may ever be.
        density: Mass per rest volume [kg/m^3], a number or one for each leaf [T]; the forest's filled share comes on
            top.
        values: Other quantities of leaves by name, [T] each, that are per full rest volume, as Lamé's parameters times
            the filled share: children have their parent's, a parent its children's mean.
        node_capacity: How many nodes; None: one for every two more leaves, where five or six a node are usual.
        device: "cpu", "cuda:0", …; None for Warp's default.

    Attributes:
        pools: ``kernels.remesh.Pools``.
        carriage: What nodes and tetrahedra carry.
        source: The forest that this began as.
        capacity, node_capacity, tree_capacity: Places for leaves, nodes, and tetrahedra of all levels.
        threads: Threads of a launch.

    Raises:
        InputError: Not a forest, a capacity below what there is, or more than can be numbered.
    """

    def __init__(
        self,
        forest: TetForest,
        capacity: int,
        *,
        density: npt.ArrayLike = 1.0,
        values: Mapping[str, npt.ArrayLike] | None = None,
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
        self.tree_capacity = elements + 2 * more
        if self.tree_capacity >= 2**31:
            raise InputError(f"capacity is {capacity}: that is {self.tree_capacity} tetrahedra; there can be 2**31 - 1")
        self.threads = 1 if self.device.is_cpu else self.device.sm_count * THREADS_PER_PROCESSOR
        self.pools = self._make_pools(tree)
        self.carriage = Carriage(self, density, values or {})

    def __repr__(self) -> str:
        return f"DeviceForest({self.leaf_count} of {self.capacity} leaves on {self.device})"

    # --- looking; each of these waits for the device ---------------------------------------------------------------

    @property
    def leaf_count(self) -> int:
        return self.count(kernels.LEAVES)

    @property
    def node_count(self) -> int:
        """Nodes in use."""
        return self.node_capacity - self.count(kernels.FREE_NODES)

    @property
    def free_nodes(self) -> int:
        return self.count(kernels.FREE_NODES)

    @property
    def free_leaves(self) -> int:
        """By how many the leaves may still grow."""
        return self.count(kernels.FREE_PAIRS)

    @property
    def is_full(self) -> bool:
        """Whether a refinement ever had to be left out for want of room."""
        return bool(self.count(kernels.FULL))

    def count(self, which: int) -> int:
        """One of the counts of ``kernels.remesh``."""
        return int(self.pools.counts.numpy()[which])

    @property
    def nodes_in_use(self) -> npt.NDArray[np.intp]:
        """Numbers of the nodes in use, those of the leaves first, as they come in ``to_forest``; ascending in each."""
        used = np.flatnonzero(self.pools.valence.numpy() > 0)
        real = np.zeros(self.node_capacity, bool)
        real[self.leaf_tets] = True
        return np.concatenate([used[real[used]], used[~real[used]]])

    @property
    def leaf_elements(self) -> npt.NDArray[np.int32]:
        """The leaves' places in the pool of tetrahedra, in tree order, int32 [T]."""
        return self.pools.leaves.numpy()[: self.leaf_count]

    @property
    def leaf_tets(self) -> npt.NDArray[np.int32]:
        """The leaves' nodes by their places in the pool, in tree order, int32 [T, 4]."""
        return self.pools.leaf_tets.numpy()[: self.leaf_count]

    def tree(self) -> tuple[Tree, npt.NDArray[np.intp]]:
        """The tree without unused places, nodes still by their places in the pool, and where each of it stands."""
        pools = self.pools
        level = pools.level.numpy()
        used = np.flatnonzero(level != kernels.UNUSED)
        number = np.full(len(level), -1, np.int32)
        number[used] = np.arange(len(used), dtype=np.int32)
        parent, child = pools.parent.numpy()[used], pools.first_child.numpy()[used]
        parent = np.where(parent < 0, np.int32(-1), number[parent])
        child = np.where(child < 0, child, number[child])
        return Tree(pools.tets.numpy()[used], level[used], parent, child), used

    def to_forest(self) -> TetForest:
        """The present mesh on the host, its leaves as here in tree order.

        Node i is ``nodes_in_use[i]`` for all that leaves name. Of a domain's mesh the function's values at new nodes
        are means, as in ``TetForest.refine``; ``fill`` and ``labels`` are what the leaves carry.
        """
        from .export import exported

        return exported(self)

    def compact(self) -> None:
        """Number nodes and tetrahedra anew in the order of the leaves, which are in tree order after every pass.

        For memory that has become scattered. Arrays stay the same, but numbers of nodes held elsewhere are void.
        """
        from .compaction import compact

        compact(self)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _make_pools(self, tree: Tree) -> Any:
        forest = self.source
        elements, nodes = len(tree.level), len(forest.lattice)
        leaves = tree.leaves
        pools = kernels.Pools()
        pools.roots = int(np.count_nonzero(tree.parent < 0))
        pools.tets = self._filled(tree.tets, self.tree_capacity, wp.vec4i)
        pools.level = self._filled(tree.level, self.tree_capacity, wp.int32, kernels.UNUSED)
        pools.parent = self._filled(tree.parent, self.tree_capacity, wp.int32, -1)
        pools.first_child = self._filled(tree.first_child, self.tree_capacity, wp.int32, LIVE)
        pools.next = wp.empty(self.tree_capacity, dtype=wp.int32, device=self.device)
        free_pairs = np.arange(self.tree_capacity - 2, elements - 1, -2, dtype=np.int32)
        most_pairs = (self.tree_capacity - pools.roots) // 2
        pools.free_pairs = self._filled(free_pairs, most_pairs, wp.int32)
        pools.fresh = wp.empty(max(most_pairs, 1), dtype=wp.int32, device=self.device)
        pools.lattice = self._filled(forest.lattice, self.node_capacity, wp.vec3i)
        pools.ends = self._filled(forest.node_ends, self.node_capacity, wp.vec2i)
        named = tree.tets[tree.first_child < 0]
        valence = np.bincount(named.ravel(), minlength=nodes)
        pools.valence = self._filled(valence, self.node_capacity, wp.int32)
        pools.touched = wp.zeros(self.node_capacity, dtype=wp.int32, device=self.device)
        free_nodes = np.flatnonzero(np.bincount(named.ravel(), minlength=self.node_capacity) == 0)[::-1]
        pools.free_nodes = self._filled(free_nodes, self.node_capacity, wp.int32)
        pools.leaves = self._filled(leaves, self.capacity, wp.int32)
        pools.leaf_tets = self._filled(forest.tets, self.capacity, wp.vec4i)
        pools.new_leaves = wp.empty(self.capacity, dtype=wp.int32, device=self.device)
        pools.marks = wp.zeros(self.capacity, dtype=wp.int8, device=self.device)
        counts = np.zeros(kernels.COUNTS, np.int32)
        counts[kernels.LEAVES] = len(leaves)
        counts[kernels.FREE_NODES] = len(free_nodes)
        counts[kernels.FREE_PAIRS] = len(free_pairs)
        counts[kernels.NODE_TOP] = nodes
        pools.counts = wp.array(counts, dtype=wp.int32, device=self.device)
        return pools

    def _filled(self, values: npt.NDArray[Any], size: int, dtype: Any, rest: int = 0) -> wp.array:
        """Values at the beginning of an array of a size."""
        padded = np.full((max(size, 1), *values.shape[1:]), rest, np.int32)
        padded[: len(values)] = values
        return wp.array(padded, dtype=dtype, device=self.device)
