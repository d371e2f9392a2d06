"""The force plan of a forest that changes, derived after each pass; see ``kernels.plan.plan``."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.discretization.elements import device_frames, edge_lengths
from warp_corot.discretization.groups import cubes_of
from warp_corot.discretization.plan import LeafCounts, Sharing, Units
from warp_corot.discretization.planner import GRANULE, PlanArrays, Room
from warp_corot.discretization.sizes import allocated
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.plan import changing as kernels
from warp_corot.kernels.plan.plan import Plan, Tree
from warp_corot.kernels.remesh.pools import LEAF_PADDING, LEAVES, NODE_TOP

#: A launch keeps its size until it needs less than this fraction of it.
SLACK = 0.8


def launch_size(count: int, present: int, granule: int = 1, limit: int | None = None) -> int:
    """A size for launches over ``count`` items and some padding, rarely different from the present one.

    A new size is too large by at most a sixteenth or one granule.

    Args:
        count: Number of items.
        present: The present size, or 0.
        granule: A power of two; the size is a multiple of it.
        limit: Number of places; a multiple of the granule if that matters.

    Returns:
        At least ``count``; 0 if that is 0.
    """
    if SLACK * present <= count <= present:
        return present
    if count == 0:
        return 0
    step = max(granule, 1 << max(count.bit_length() - 5, 0))
    size = -(-count // step) * step
    return size if limit is None else min(size, limit)


# --- the plan --------------------------------------------------------------------------------------------------------


#: Launches over leaves outside subtrees grow by at least about this part of all leaves.
LEAST_FLAT = 128


class DevicePlan:
    """The ``plan.Plan`` of a forest that changes, derived from its leaves by launches.

    All arrays have room for the largest mesh and are padded, so that launches may cover more items than there are.
    The order of sums of forces is not fixed.

    Args:
        forest: The pools.
        rotation_level: Level of the tree at which rotations are shared; None: not shared.
        subtrees: False: all leaves are computed one by one, for models without subtree kernels.
        grouped: Whether complete subtrees form groups where possible; None: only on CUDA.

    Attributes:
        elements: The leaves as ``kernels.elements.elements.ForestElements``.
        values: The leaves' carried values by name, float32 [capacity + LEAF_PADDING] each; zero beyond the leaves.
        class_counts: The counts that ``refresh`` takes, int32 on the device.
        batches, flat, units, counts: As in ``plan.Plan``.
        slots: None.
    """

    slots = None

    def __init__(
        self,
        forest: DeviceForest,
        rotation_level: int | None = None,
        *,
        subtrees: bool = True,
        grouped: bool | None = None,
    ):
        self.forest = forest
        self.device = forest.device
        self._with_subtrees = subtrees
        grouped = self.device.is_cuda if grouped is None else grouped
        most_leaves = forest.capacity + LEAF_PADDING
        self._most_subtrees = max(-(-forest.capacity // (8 * GRANULE)) if subtrees else 0, 1) * GRANULE
        self.elements = self._leaves(most_leaves)
        options = {"subtrees": subtrees, "grouped": grouped}
        made = PlanArrays(tree_of(forest), self.elements, rotation_level, forest.threads, **options)
        self._made, self._plan = made, made.plan
        classes, shared = made.plan.classes, made.rotation_shared
        made.make(Room([self._most_subtrees] * classes, most_leaves, most_leaves * shared, most_leaves))
        self._fill_in(most_leaves)
        self._rows = classes + 2
        all_leaves = slice(self._rows, self._rows + 1)
        self.counts = LeafCounts(
            most=most_leaves,
            now=self._plan.counts[all_leaves],
            before=self._plan.before[all_leaves],
            goes=self._plan.goes,
            threads=forest.threads,
        )
        self.class_counts = self._plan.counts
        self.values = {name: self._plan.values[n] for n, name in enumerate(forest.carriage.names)}
        self._sizes = [0] * self._rows
        self._refit()
        self.derive()

    def launch(self) -> None:
        """Launch the derivation of the plan if the last pass has changed the mesh; may be recorded."""
        forest, plan, made = self.forest, self._plan, self._made
        wp.launch(kernels.begin_plan, 1, [forest.pools, plan], device=self.device)
        inputs = [forest.threads, forest.pools, made.tree, forest.carriage.arrays.values, plan]
        wp.launch(kernels.gather_leaves, forest.threads, inputs, device=self.device)
        if not (self._with_subtrees or self.rotation_shared):
            return
        made.find()
        made.list()
        if self._with_subtrees:
            made.fill_batches()
            made.fill_flat()
        if self.rotation_shared:
            made.pad_units()

    def outdate(self) -> None:
        """Make the next launches derive the plan even if the last pass changed nothing, as after ``restart``."""
        self._plan.stale.fill_(1)

    def derive(self) -> bool:
        """Derive the plan now, whether or not the last pass changed the mesh, wait for it, and ``refresh`` it."""
        self.outdate()
        self.launch()
        return self.refresh(self.class_counts.numpy())

    def refresh(self, counts: npt.NDArray[np.int32]) -> bool:
        """Fit the sizes of launches to the present counts.

        Args:
            counts: A copy of ``class_counts``.

        Returns:
            Whether ``batches``, ``flat`` or ``units`` were replaced, so that launches must be made again.
        """
        classes = self._plan.classes
        limits = [self._most_subtrees] * classes + [self.counts.most] * 2
        # Cuts move some leaves after others out of subtrees.
        granules = [GRANULE] * classes + [1 << (self.forest.capacity // LEAST_FLAT).bit_length(), 1]
        wanted = counts[: self._rows].tolist()
        wanted[-1] += 1  # the first unit is padding
        sizes = [launch_size(*of_row) for of_row in zip(wanted, self._sizes, granules, limits, strict=True)]
        if sizes == self._sizes:
            return False
        self._sizes = sizes
        self._refit()
        return True

    def values_row(self, name: str) -> int:
        """The row of ``arrays.values`` with the leaves' values of a name; -1 if there is none."""
        names = self.forest.carriage.names
        return names.index(name) if name in names else -1

    @property
    def arrays(self) -> Plan:
        """``kernels.plan.plan.Plan``, for launches that derive more from it."""
        return self._plan

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        """Shape, whether in groups, and sharing of all possible batches."""
        if not self._with_subtrees:
            return []
        members = (True, False) if self._plan.members == 2 else (False,)
        return [(shape, grouped, sharing) for sharing, shape in self._made.kinds for grouped in members]

    @property
    def rotation_shared(self) -> bool:
        return self._made.rotation_shared

    # --- what launches go through ------------------------------------------------------------------------------------

    @property
    def units(self) -> Units | None:
        above = any(batch.sharing is Sharing.ABOVE for batch in self.batches)
        return self.all_units if self.rotation_shared and (above or len(self.flat)) else None

    @property
    def all_units(self) -> Units:
        """All units, also those that no launch of forces uses; the first is padding."""
        return self._made.units(self._sizes[-1])

    def _refit(self) -> None:
        """``batches`` and ``flat`` of the present sizes."""
        sizes, classes = self._sizes, self._plan.classes
        found = ((c, self._made.batch(c, sizes[c])) for c in range(classes) if sizes[c])
        self.batches = tuple(replace(batch, live=self._live(c)) for c, batch in found)
        self.flat = replace(self._made.flat(sizes[classes]), live=self._live(classes))

    def _live(self, row: int) -> wp.array:
        """The number of subtrees of a class, or of leaves outside subtrees."""
        return self._plan.counts[row : row + 1]

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _leaves(self, count: int) -> ForestElements:
        """The leaves, with room for their codes."""
        forest, elements = self.forest, ForestElements()
        elements.nodes = elements.targets = forest.pools.leaf_tets
        elements.code = wp.empty(count, dtype=wp.int32, device=self.device)
        elements.frames, elements.size = forest.pools.frames, edge_lengths(forest.source, self.device)
        return elements

    def _fill_in(self, most_leaves: int) -> None:
        """Fill in the data that only a changing plan has. Counts begin as if all places were used, so all become
        padding.
        """
        plan, names = self._plan, self.forest.carriage.names
        plan.first_unit = 1
        plan.stale, plan.goes = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))
        plan.marks = wp.zeros(most_leaves, dtype=wp.int8, device=self.device)
        plan.values = wp.zeros((len(names), most_leaves), dtype=wp.float32, device=self.device)
        units, found = (most_leaves - 1) * self.rotation_shared, int(self._with_subtrees)
        plan.counts.assign([found * self._most_subtrees] * plan.classes + [found * most_leaves, units, most_leaves])


def tree_of(forest: DeviceForest) -> Tree:
    """The data of pools for the planner's kernels."""
    pools, tree = forest.pools, Tree()
    tree.leaf_count, tree.node_count = (pools.counts[row : row + 1] for row in (int(LEAVES), int(NODE_TOP)))
    tree.named = int(pools.node_limit == pools.sink)
    tree.leaf_tets, tree.leaves = pools.leaf_tets, pools.leaves
    tree.roots, tree.parent, tree.tets, tree.cut = pools.roots, pools.parent, pools.tets, pools.cut
    tree.parent_code = device_frames(forest.device)[1]
    # The frame of a root is along the axes: deformation gradients of padding are exact, energies zero.
    tree.sink, tree.padding_code = pools.sink, int(pools.code[:1].numpy()[0])
    return tree


# --- groups of the leaves outside subtrees ---------------------------------------------------------------------------


class ChangingGroups:
    """Groups of a plan's leaves outside subtrees.

    Args:
        plan: The plan; launch ``launch`` after it.

    Attributes:
        starts, members: As in ``groups.Groups``, with room for the largest possible number.
        live: Number of groups, int32 [1] on the device.
    """

    def __init__(self, plan: DevicePlan):
        self._forest, self._plan, self.device = plan.forest, plan.arrays, plan.device
        source, most = plan.forest.source, len(plan.arrays.flat)
        _, cube_of_root = np.unique(
            cubes_of(source, source.tree.tets[: self._pools.roots]), axis=0, return_inverse=True
        )
        cubes = int(cube_of_root.max()) + 1
        sizes = [(most + 1, "starts size"), (most, "members filled"), (1, "count")]
        sizes += [(len(self._pools.level), "tally makes is_flat"), (cubes, "cube_tally cube_makes")]
        groups = self._groups = allocated(kernels.Groups, self.device, sizes)
        groups.cube_of_root = wp.array(cube_of_root.ravel(), dtype=wp.int32, device=self.device)
        self.starts, self.members, self.live = groups.starts, groups.members, groups.count

    def launch(self) -> None:
        """Launch the search for groups if the plan has just been derived; may be recorded."""
        pools, plan, groups = self._pools, self._plan, self._groups
        most, tetrahedra, cubes = len(groups.filled), len(groups.tally), len(groups.cube_tally)
        self._launch(kernels.begin_groups, max(most, tetrahedra, cubes), pools, plan)
        self._launch(kernels.mark_flat, most, pools, plan)
        self._launch(kernels.climb, tetrahedra, pools, plan)
        self._launch(kernels.number_cubes, cubes, plan)
        self._launch(kernels.count_members, most, pools, plan)
        wp.utils.array_scan(groups.size, groups.starts, inclusive=True)
        self._launch(kernels.place_members, most, pools, plan)
        self._launch(kernels.order_members, most, plan)

    @property
    def _pools(self) -> Any:
        return self._forest.pools

    def _launch(self, kernel: wp.Kernel, dim: int, *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=[*arguments, self._groups], device=self.device)
