"""The force plan of a forest that changes, derived on the device after each pass; see ``kernels.plan.plan``."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.plan import FlatLeaves, LeafCounts, Units
from warp_corot.discretization.subtrees import Batch, Sharing
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements, Subtrees
from warp_corot.kernels.plan import batches as remesh_batches
from warp_corot.kernels.plan import lists as remesh_lists
from warp_corot.kernels.plan import plan as remesh_plan
from warp_corot.kernels.plan import units as remesh_units

from .plan_arrays import GRANULE, PlanArrays
from .pools import DeviceForest
from .sizes import launch_size


class DevicePlan:
    """The ``plan.Plan`` of a forest that changes, derived from its leaves by launches.

    Everything stands in arrays as large as it may ever get, with padding beyond what there is, so that launches may go
    through more than that. Forces need not have one order.

    Args:
        forest: The pools.
        rotation_level: Level of the tree at which rotations are shared; None: not shared.
        subtrees: False: all leaves go one by one, for models that know no subtrees.
        grouped: Whether complete subtrees go in groups where they can, as launches on CUDA alone do; None: there.

    Attributes:
        elements: The leaves as ``kernels.elements.elements.ForestElements``.
        values: What leaves carry by name, float32 [capacity + LEAF_PADDING] each; zero beyond the leaves.
        class_counts: What ``refresh`` wants, int32 on the device.
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
        made = PlanArrays(forest, rotation_level, subtrees=subtrees, grouped=grouped)
        self._kinds, self._most_subtrees = made.kinds, made.most_subtrees
        self._plan, self._batches, self._leaves = made.plan, made.batches, made.leaves
        self._rows = self._plan.classes + 2
        all_leaves = slice(self._rows, self._rows + 1)
        self.counts = LeafCounts(
            most=len(made.plan.code),
            now=self._plan.counts[all_leaves],
            before=self._plan.before[all_leaves],
            goes=self._plan.goes,
            threads=forest.threads,
        )
        self._flagged = wp.zeros((self._plan.classes, self._most_subtrees), dtype=wp.uint8, device=self.device)
        self._sums, self._ends = (
            wp.zeros(self._rows * forest.threads, dtype=wp.int32, device=self.device) for _ in range(2)
        )
        self.class_counts = self._plan.counts
        self._edge_lengths = made.edge_lengths
        self.elements = self._elements(forest.pools.leaf_tets, self._plan.code)
        self.values = {name: self._plan.values[n] for n, name in enumerate(forest.carriage.names)}
        self._sizes = [0] * self._rows
        self._refit()
        self.derive()

    def launch(self) -> None:
        """Launch what derives the plan if the last pass has changed the mesh; may be recorded."""
        pools, plan, threads = self.forest.pools, self._plan, self.forest.threads
        self._launch(remesh_plan.begin_plan, 1, pools, plan)
        self._launch(remesh_plan.gather_leaves, threads, threads, pools, self.forest.carriage.arrays.values, plan)
        if not (self._with_subtrees or self.rotation_shared):
            return
        self._launch(remesh_lists.mark_leaves, threads, threads, pools, plan, self._sums)
        wp.utils.array_scan(self._sums, self._ends, inclusive=True)
        self._launch(remesh_lists.list_leaves, threads, threads, pools, self._ends, plan)
        if self._with_subtrees:
            self._launch(remesh_batches.fill_batches, (plan.classes, threads), threads, pools, plan, self._batches)
            self._launch(remesh_batches.fill_flat, threads, threads, pools, plan, self._leaves)
        if self.rotation_shared:
            self._launch(remesh_units.pad_units, threads, threads, pools, plan)

    def outdate(self) -> None:
        """Let the next launches derive the plan also if the last pass has changed nothing, as after ``restart``."""
        self._plan.stale.fill_(1)

    def derive(self) -> bool:
        """Derive the plan now, whatever the last pass was, and wait for it; returns what ``refresh`` does."""
        self.outdate()
        self.launch()
        return self.refresh(self.class_counts.numpy())

    def refresh(self, counts: npt.NDArray[np.int32]) -> bool:
        """Fit the sizes of launches to what there is.

        Args:
            counts: A copy of ``class_counts``.

        Returns:
            Whether ``batches``, ``flat`` or ``units`` are other ones now, so that launches must be made anew.
        """
        classes = self._plan.classes
        limits = [self._most_subtrees] * classes + [self.counts.most] * 2
        granules = [GRANULE] * classes + [1, 1]
        wanted = counts[: self._rows].tolist()
        wanted[-1] += 1  # the first unit is padding
        sizes = [launch_size(*of_row) for of_row in zip(wanted, self._sizes, granules, limits, strict=True)]
        if sizes == self._sizes:
            return False
        self._sizes = sizes
        self._refit()
        return True

    def values_row(self, name: str) -> int:
        """Where leaves' values of a name stand in ``arrays.values``; -1 if they carry none."""
        names = self.forest.carriage.names
        return names.index(name) if name in names else -1

    @property
    def arrays(self) -> remesh_plan.Plan:
        """``kernels.plan.plan.Plan``, for launches that derive more from it."""
        return self._plan

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        """Shape, whether in groups, and sharing of all batches that there may ever be."""
        if not self._with_subtrees:
            return []
        members = (True, False) if self._plan.members == 2 else (False,)
        return [(shape, grouped, sharing) for sharing, shape in self._kinds for grouped in members]

    @property
    def rotation_shared(self) -> bool:
        return bool(self._plan.rotation_level >= 0)

    # --- what launches go through ----------------------------------------------------------------------------------

    @property
    def units(self) -> Units | None:
        above = any(batch.sharing is Sharing.ABOVE for batch in self.batches)
        return self.all_units if self.rotation_shared and (above or len(self.flat)) else None

    @property
    def all_units(self) -> Units:
        """What rotations are found of, whether a launch of forces asks for it or not; the first is padding."""
        plan = self._plan
        return Units(self._elements(plan.unit_nodes, plan.unit_code), self._sizes[-1], plan.unit)

    def _refit(self) -> None:
        """``batches`` and ``flat`` of the present sizes."""
        sizes, classes = self._sizes, self._plan.classes
        self.batches = tuple(self._batch(c, sizes[c]) for c in range(classes) if sizes[c])
        self.flat = self._flat(sizes[classes])

    def _batch(self, row: int, count: int) -> Batch:
        arrays, grouped = self._batches, self._plan.members == 2 and row % 2 == 0
        kind = row // self._plan.members
        sharing, shape = self._kinds[kind]
        subtrees = Subtrees()
        if grouped:
            subtrees.nodes = arrays.group_nodes[kind][: count // 8]
        elif arrays.by_node:
            subtrees.nodes = arrays.nodes[kind][:, :count]
        else:
            subtrees.nodes = arrays.nodes[kind][:count]
        subtrees.targets = subtrees.nodes
        subtrees.code = arrays.code[row][:count]
        subtrees.first = self._plan.first[row][:count]
        subtrees.frames, subtrees.size = self.elements.frames, self.elements.size
        roots = unit = None
        if sharing is Sharing.ROOT:
            roots = self._elements(arrays.root_nodes[row % self._plan.members][:count], subtrees.code)
        elif sharing is Sharing.ABOVE:
            unit = arrays.unit[row][:count]
        return Batch(shape, grouped, count, sharing, subtrees, roots, unit, self._flagged[row][:count])

    def _flat(self, count: int) -> FlatLeaves:
        leaves, general = self._leaves, None
        if len(leaves.volume):
            general = GeneralElements()
            general.nodes = general.targets = _first(leaves.nodes, count)
            general.rest_inverse, general.volume = _first(leaves.rest_inverse, count), _first(leaves.volume, count)
        return FlatLeaves(
            leaves=_first(self._plan.flat, count),
            elements=self._elements(_first(leaves.nodes, count), _first(leaves.code, count)),
            unit=_first(leaves.unit, count) if self.rotation_shared else None,
            general=general,
            material=(_first(leaves.mu, count), _first(leaves.lam, count)) if leaves.mu_row >= 0 else None,
        )

    def _elements(self, nodes: wp.array, code: wp.array) -> ForestElements:
        elements = ForestElements()
        elements.nodes = elements.targets = nodes
        elements.code = code
        elements.frames, elements.size = self.forest.pools.frames, self._edge_lengths
        return elements

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, int], *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(arguments), device=self.device)


def _first(array: wp.array, count: int) -> wp.array:
    """The first places of an array, which may have none."""
    return array[:count] if len(array) > count else array
