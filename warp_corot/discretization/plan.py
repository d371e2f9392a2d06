"""What a force evaluation goes through: complete subtrees in batches of one type, and the leaves left over.

The tree is what meshing edits; the plan is derived from it and is all that stepping reads: once where the mesh stays
as it is, and on the device after each pass where it changes (``remesh.plan``).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.mesh import TetForest

from .elements import Elements, device_elements, forest_elements, in_worlds, with_targets
from .slots import Slots
from .subtrees import Batch, Sharing, chosen, in_batches

__all__ = ["Batch", "FlatLeaves", "ForcePlan", "LeafCounts", "Plan", "Sharing", "Units"]


@dataclass(frozen=True)
class Units:
    """Tetrahedra, leaves or above these, of which rotations are found.

    Attributes:
        elements: ``kernels.elements.elements.ForestElements``, or general ones where there is no tree.
        count: How many one launch goes through.
        unit: Which of them each of the mesh's elements uses, int32 [T].
    """

    elements: Elements
    count: int
    unit: wp.array

    @classmethod
    def own(cls, elements: Elements, count: int) -> Units:
        """Each element by itself."""
        return cls(elements, count, wp.array(np.arange(count), dtype=wp.int32, device=elements.nodes.device))

    @classmethod
    def of_forest(cls, forest: TetForest, rotation_level: int, device: wp.Device, worlds: int = 1) -> Units:
        """The highest tetrahedra that are not above a level, each once."""
        ancestors, unit = np.unique(forest.ancestors(rotation_level), return_inverse=True)
        return cls(
            forest_elements(forest, ancestors, device, worlds),
            worlds * len(ancestors),
            wp.array(in_worlds(unit.ravel(), worlds, len(ancestors)), dtype=wp.int32, device=device),
        )


@dataclass(frozen=True)
class FlatLeaves:
    """Leaves that are in no subtree, as elements of their own, world after world.

    Attributes:
        leaves: Which of the mesh's elements they are, int32 [n]; ``len`` is how many one launch goes through.
        elements: ``kernels.elements.elements.ForestElements``.
        unit: Which of ``Units`` each uses where rotations are shared, int32 [n], else None.
        general: The same leaves as general elements, if that is known, else None.
        material: Their Lamé parameters mu and lambda [Pa] where these vary and are known, float32 [n] each, else None.
    """

    leaves: wp.array
    elements: Elements
    unit: wp.array | None = None
    general: GeneralElements | None = None
    material: tuple[wp.array, wp.array] | None = None

    def __len__(self) -> int:
        return len(self.leaves)


@dataclass(frozen=True)
class LeafCounts:
    """How many leaves there are where their number changes, for launches that derive something of each.

    Attributes:
        most: How many there may be, padding included.
        now, before: How many there are, and were when the plan was last derived; int32 [1] on the device.
        goes: Whether the plan has just been derived, int32 [1] on the device.
        threads: Threads of a launch that goes through all of them.
    """

    most: int
    now: wp.array
    before: wp.array
    goes: wp.array
    threads: int


class Plan(Protocol):
    """What a force field goes through, however it came about.

    Attributes:
        elements: All leaves, ``ForestElements`` or, of a general mesh, ``GeneralElements`` of ``kernels.elements``;
            their forces go to the slots if there are any.
        batches: Subtrees by type, grouped or not, and sharing; none where the field goes leaf by leaf.
        flat: The other leaves.
        slots: Where forces go first if their sums must have one order, else None.
        counts: How many leaves there are, if that changes, else None.
    """

    @property
    def elements(self) -> Elements: ...

    @property
    def batches(self) -> tuple[Batch, ...]: ...

    @property
    def flat(self) -> FlatLeaves: ...

    @property
    def units(self) -> Units | None:
        """What rotations are found of if some batch or flat leaf asks for that, else None."""
        ...

    @property
    def all_units(self) -> Units:
        """What rotations are found of, whether a launch of forces asks for it or not; only where they are shared."""
        ...

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        """Shape, whether in groups, and sharing of all batches that there may ever be."""
        ...

    @property
    def slots(self) -> Slots | None: ...

    @property
    def counts(self) -> LeafCounts | None: ...


@dataclass(frozen=True)
class ForcePlan:
    """The ``Plan`` of a mesh that stays as it is.

    Attributes:
        find_units: Makes ``all_units`` of a forest whose rotations are shared.
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
        """The plan of a field that goes through the elements of a mesh one by one."""
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
            worlds: How many copies of the body there are.
            elements: All leaves, if they are on the device already.
            grouped: Whether complete subtrees go in groups where they can, as launches on CUDA alone do; None: there.
            deterministic: Whether every unit has slots of its own for its forces.
        """
        grouped = device.is_cuda if grouped is None else grouped
        members, flat = in_batches(forest, rotation_level, grouped=grouped)
        elements = device_elements(forest, device, worlds) if elements is None else elements
        find_units = (
            None if rotation_level is None else partial(Units.of_forest, forest, rotation_level, device, worlds)
        )
        units = None
        if find_units and (len(flat) or any(m.sharing is Sharing.ABOVE for m in members)):
            units = find_units()
        of_nodes = [m.of_leaves(forest.tets) for m in members]
        of_targets, target_count = of_nodes, 0
        slots = targets = None
        if deterministic:
            slots, by_unit = Slots.of_units([*of_nodes, forest.tets[flat]], len(forest.points), device, worlds)
            *of_targets, of_flat = by_unit
            target_count = slots.per_world
            targets = np.empty_like(forest.tets)
            targets[flat] = of_flat
            for m, own in zip(members, of_targets, strict=True):
                m.hand_down(own, targets)
            targets = in_worlds(targets, worlds, target_count)
            elements = with_targets(elements, targets)
        batches = [
            m.batch(forest, device, worlds, n, t, target_count, units.unit if units else None)
            for m, n, t in zip(members, of_nodes, of_targets, strict=True)
        ]
        leaves = _flat_leaves(forest, flat, device, worlds, targets, units)
        return cls(elements, tuple(batches), leaves, units, slots, find_units)


def _flat_leaves(
    forest: TetForest,
    flat: npt.NDArray[np.int32],
    device: wp.Device,
    worlds: int,
    targets: npt.NDArray[np.int32] | None,
    units: Units | None,
) -> FlatLeaves:
    everywhere = in_worlds(flat, worlds, len(forest.tets))
    leaves = wp.array(everywhere, dtype=wp.int32, device=device)
    elements = forest_elements(forest, forest.tree.leaves[flat], device, worlds)
    if targets is not None:
        elements = with_targets(elements, targets[everywhere])
    return FlatLeaves(leaves, elements, None if units is None else chosen(units.unit, leaves))
