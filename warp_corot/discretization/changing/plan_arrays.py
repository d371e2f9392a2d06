"""The arrays that a derived plan stands in: as large as they may ever get, with padding everywhere to begin with."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.subtrees import Sharing, subtree_nodes
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.elements.general_cpu import rest_matrices
from warp_corot.kernels.plan.batches import Batches, FlatLeaves
from warp_corot.kernels.plan.plan import Plan
from warp_corot.kernels.remesh.pools import LEAF_PADDING, SINKS
from warp_corot.kernels.tables.shapes import MIRROR_BIT
from warp_corot.kernels.tables.subtree import GROUP_NODES, group_nodes
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_LEVEL

from .pools import DeviceForest

#: Subtrees are launched in multiples of this: whole groups, and whole lanes.
GRANULE = 64


class PlanArrays:
    """See ``DevicePlan`` for the arguments.

    Attributes:
        kinds: Sharing and shape of subtrees that one launch goes through, grouped or not.
        most_subtrees: Places for subtrees of a class.
        plan, batches, leaves: ``kernels.plan.plan.Plan``, ``kernels.plan.batches.Batches`` and ``FlatLeaves``.
        edge_lengths: As in ``kernels.elements.elements.ForestElements``.
    """

    def __init__(self, forest: DeviceForest, rotation_level: int | None, *, subtrees: bool, grouped: bool):
        self._forest = forest
        self.device = forest.device
        self._grouped = grouped
        self._shared = rotation_level is not None
        self._most_leaves = forest.capacity + LEAF_PADDING
        self.most_subtrees = max(-(-forest.capacity // (8 * GRANULE)) if subtrees else 0, 1) * GRANULE
        self.kinds = [(Sharing.OWN, shape) for shape in range(3)]
        if rotation_level is not None:
            self.kinds += [(Sharing.ROOT, rotation_level % 3), *((Sharing.ABOVE, shape) for shape in range(3))]
        sizes = forest.source.cell_size * 0.5 ** np.arange(LATTICE_BITS + 1)
        self.edge_lengths = wp.array(sizes, dtype=wp.float32, device=self.device)
        self._root_code = int(forest.pools.code[:1].numpy()[0])
        self.plan = self._make_plan(-1 if rotation_level is None else rotation_level, subtrees)
        self.batches = self._make_batches()
        self.leaves = self._make_leaves(self._most_leaves if subtrees else 1)

    def _make_plan(self, rotation_level: int, subtrees: bool) -> Plan:
        leaves = self._most_leaves
        units = leaves if self._shared else 0
        plan = Plan()
        plan.rotation_level, plan.with_subtrees = rotation_level, int(subtrees)
        plan.members = 2 if self._grouped else 1
        plan.classes = plan.members * len(self.kinds)
        plan.counts, plan.before = self._zeros(plan.classes + 3), self._zeros(plan.classes + 3)
        plan.stale, plan.goes = self._zeros(1), self._zeros(1)
        plan.code = self._codes(leaves)
        plan.values = self._zeros((len(self._forest.carriage.names), leaves), wp.float32)
        plan.marks = self._zeros(leaves, wp.int8)
        plan.unit = self._zeros(units)
        plan.first = self._zeros((plan.classes, self.most_subtrees))
        plan.flat = self._zeros(leaves)
        plan.unit_nodes = self._padding(units)
        plan.unit_code = self._codes(units)
        return plan

    def _make_batches(self) -> Batches:
        most, kinds, plan = self.most_subtrees, len(self.kinds), self.plan
        sinks = self._sinks(most)
        nodes = np.broadcast_to(sinks, (kinds, 10, most))
        # In a group the k-th node of all eight subtrees' share stands on the sink of one of them.
        shares = np.repeat(sinks.reshape(-1, 8), GROUP_NODES // 8, axis=1)
        of_groups = np.array([np.where(self._group_places[shape][:, 0] < 0, -1, shares) for _, shape in self.kinds])
        batches = Batches()
        batches.places = self._pairs(np.array([subtree_nodes(shape) for shape in range(3)]))
        batches.group_places = self._pairs(self._group_places)
        batches.by_node = int(self.device.is_cuda)
        batches.nodes = self._ints(nodes if self.device.is_cuda else np.swapaxes(nodes, 1, 2))
        batches.group_nodes = self._ints(of_groups if self._grouped else np.zeros((kinds, 0, GROUP_NODES)))
        batches.code = self._codes((plan.classes, most))
        batches.unit = self._zeros((plan.classes if self._shared else 0, most))
        roots = np.repeat(np.repeat(sinks[None, :, None], plan.members, axis=0), 4, axis=2)
        batches.root_nodes = wp.array(roots if self._shared else roots[:0], dtype=wp.vec4i, device=self.device, ndim=2)
        return batches

    def _make_leaves(self, count: int) -> FlatLeaves:
        names = self._forest.carriage.names
        varies = "mu" in names
        leaves = FlatLeaves()
        leaves.nodes = self._padding(count)
        leaves.code = self._codes(count)
        leaves.unit = self._zeros(count if self._shared else 0)
        leaves.mu_row, leaves.lam_row = (names.index(name) if varies else -1 for name in ("mu", "lam"))
        leaves.mu, leaves.lam = (self._zeros(count if varies else 0, wp.float32) for _ in range(2))
        # Eight elements at a time, on the CPU, want to have their own rotations.
        general = count if self.device.is_cpu and not self._shared else 0
        leaves.rest_inverse = self._zeros(general, wp.mat33)
        leaves.volume = self._zeros(general, wp.float32)
        if general:
            frames = 2 * len(self._forest.pools.frames)
            codes = (np.arange(frames)[:, None] << MIRROR_BIT) + np.arange(3)
            leaves.inverse_of, _ = self._rest_matrices(codes.ravel())
            _, leaves.volume_of = self._rest_matrices(np.arange(MAX_LEVEL + 1))
        return leaves

    def _rest_matrices(self, codes: npt.NDArray[np.integer]) -> tuple[wp.array, wp.array]:
        """Rest matrices and volumes of elements by their codes."""
        elements = ForestElements()
        elements.code, elements.frames = self._ints(codes), self._forest.pools.frames
        elements.size = self.edge_lengths
        found = self._zeros(len(codes), wp.mat33), self._zeros(len(codes), wp.float32)
        wp.launch(rest_matrices, len(codes), [elements], list(found), device=self.device)
        return found

    @property
    def _group_places(self) -> npt.NDArray[np.int_]:
        """``kernels.tables.subtree.group_nodes`` by shape, -1 past the last, [3, 40, 2]."""
        places = np.full((3, GROUP_NODES, 2), -1)
        for shape in range(3):
            given = group_nodes(shape)
            places[shape, : len(given)] = given
        return places

    def _sinks(self, count: int) -> npt.NDArray[np.int32]:
        """What padding names in the first places of an array, int32 [count]."""
        return self._forest.pools.sink + np.arange(count, dtype=np.int32) % int(SINKS)

    def _padding(self, count: int) -> wp.array:
        return wp.array(np.repeat(self._sinks(count)[:, None], 4, axis=1), dtype=wp.vec4i, device=self.device)

    def _codes(self, shape: int | tuple[int, int]) -> wp.array:
        """Codes of padding: see ``kernels.plan.plan.padding_code``."""
        return wp.full(shape, self._root_code, dtype=wp.int32, device=self.device)

    def _zeros(self, shape: int | tuple[int, int], dtype: Any = wp.int32) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _ints(self, values: npt.NDArray[Any]) -> wp.array:
        return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=self.device)

    def _pairs(self, values: npt.NDArray[np.int_]) -> wp.array:
        return wp.array(values.astype(np.int32), dtype=wp.vec2i, device=self.device, ndim=2)
