"""The force plan of a mesh that never changes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import TYPE_CHECKING, cast

import warp as wp

from warp_corot.discretization.elements import Elements, device_elements, with_targets
from warp_corot.discretization.plan import GROUPED_LEAVES, Batch, FlatLeaves, Sharing, Units
from warp_corot.discretization.slots import Slots
from warp_corot.mesh import TetForest

from .planner import PlanArrays, Planner, Room, SubtreeTargets, threads_on, tree_of

if TYPE_CHECKING:
    from warp_corot.kernels.elements.elements import ForestElements


@dataclass(frozen=True)
class ForcePlan:
    """The ``Plan`` of a mesh that never changes.

    Attributes:
        find_units: A function that makes ``all_units`` for a forest with shared rotations.
    """

    elements: Elements
    batches: tuple[Batch, ...]
    flat: FlatLeaves
    units: Units | None = None
    slots: Slots | None = None
    find_units: Callable[[], Units] | None = None
    counts: None = None

    @cached_property
    def all_units(self) -> Units:
        assert self.find_units is not None
        return self.units or self.find_units()

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        return [(batch.shape, batch.grouped, batch.sharing) for batch in self.batches]

    @classmethod
    def leaf_by_leaf(
        cls, elements: Elements, slots: Slots | None = None, find_units: Callable[[], Units] | None = None
    ) -> ForcePlan:
        """The plan of a field that computes the elements of a mesh one by one."""
        none = wp.empty(0, dtype=wp.int32, device=elements.nodes.device)
        return cls(elements, (), FlatLeaves(none, elements), slots=slots, find_units=find_units)

    @classmethod
    def of_forest(
        cls,
        forest: TetForest,
        rotation_level: int | None,
        device: wp.Device,
        *,
        worlds: int = 1,
        elements: Elements | None = None,
        grouped: bool | None = None,
        deterministic: bool = False,
    ) -> ForcePlan:
        """The plan of a forest.

        Args:
            rotation_level: Level of the tree at which rotations are shared; None: not shared.
            worlds: Number of copies of the body.
            elements: All leaves, if they are on the device already.
            grouped: Whether complete subtrees form groups where possible; None: only on CUDA.
            deterministic: Whether every unit of work has separate slots for its forces.

        Raises:
            InputError: There are more slots, or nodes of subtrees, than can be numbered.
        """
        if elements is None:
            elements = device_elements(forest, device, worlds)
        found = _Found(forest, elements, rotation_level, worlds, grouped=device.is_cuda if grouped is None else grouped)
        find_units = None if rotation_level is None else partial(units_of, forest, elements, rotation_level, worlds)
        has_units = rotation_level is not None and (found.flat > 0 or found.has_units_above)
        made = found.made(with_units=has_units)
        targets = SubtreeTargets(made, found.subtrees, found.flat, elements, worlds) if deterministic else None
        batches = [
            made.batch(row, worlds * count, targets and targets.of_subtrees)
            for row, count in enumerate(found.subtrees)
            if count
        ]
        return cls(
            elements if targets is None else with_targets(elements, targets.of_leaves),
            tuple(batches),
            made.flat(worlds * found.flat, targets and targets.of_flat),
            made.units(worlds * found.units) if has_units else None,
            None if targets is None else targets.slots,
            find_units,
        )


def units_of(forest: TetForest, elements: Elements, rotation_level: int, worlds: int) -> Units:
    """The highest tetrahedra that are not above a level and whose corners are nodes, each once; in tree order.

    Args:
        elements: The forest's leaves, in all worlds.
    """
    found = _Found(forest, elements, rotation_level, worlds, subtrees=False)
    return found.made(with_units=True, with_lists=False).units(worlds * found.units)


def pays_in_groups(forest: TetForest, elements: Elements, worlds: int) -> bool:
    """Whether enough leaves are in groups to make launches of subtrees faster than one of single elements (CUDA)."""
    found = _Found(forest, elements, None, worlds, grouped=True)
    return worlds * 8 * sum(found.subtrees[::2]) >= GROUPED_LEAVES


class _Found:
    """A world's numbers of subtrees of each class, of leaves outside subtrees, and of units; and the arrays of all of
    them.
    """

    def __init__(
        self,
        forest: TetForest,
        elements: Elements,
        rotation_level: int | None,
        worlds: int,
        *,
        subtrees: bool = True,
        grouped: bool = False,
    ):
        device, leaves = elements.nodes.device, cast("ForestElements", elements)
        tree = tree_of(forest, leaves, rotation_level)
        self._arrays = PlanArrays(tree, leaves, rotation_level, subtrees=subtrees, grouped=grouped)
        plan = self._arrays.plan
        plan.worlds, plan.world_nodes, plan.world_leaves = worlds, len(forest.points), len(forest.tets)
        plan.marks = wp.empty(plan.world_leaves, dtype=wp.int8, device=device)
        plan.goes = wp.ones(1, dtype=wp.int32, device=device)
        self._planner = Planner(self._arrays, min(threads_on(device), plan.world_leaves))
        self._planner.find()
        *self.subtrees, self.flat, self.units, _ = plan.counts.numpy().tolist()

    @property
    def has_units_above(self) -> bool:
        """Whether leaves of some subtree share a rotation further up."""
        rows = zip(self._arrays.kinds, self._by_kind(), strict=True)
        return any(count for (sharing, _), count in rows if sharing is Sharing.ABOVE)

    def made(self, *, with_units: bool, with_lists: bool = True) -> PlanArrays:
        """The arrays of subtrees and of leaves outside them, of units, or of both."""
        made, plan, planner = self._arrays, self._arrays.plan, self._planner
        worlds, leaves = plan.worlds, plan.worlds * plan.world_leaves
        plan.world_units = self.units
        made.make(
            Room([worlds * n for n in self.subtrees], worlds * self.flat, worlds * self.units * with_units, leaves)
        )
        planner.list()
        if with_units and worlds > 1:
            planner.repeat_units()
        if with_lists and any(self.subtrees):
            planner.fill_batches()
        if with_lists and self.flat:
            planner.fill_flat()
        return made

    def _by_kind(self) -> list[int]:
        members = self._arrays.plan.members
        return [sum(self.subtrees[k : k + members]) for k in range(0, len(self.subtrees), members)]
