"""What a force evaluation goes through: complete subtrees in batches of one type, and the leaves left over.

The tree is what meshing edits; the plan is derived from it once and is all that stepping reads. On an adaptive forest
every stretch of equal levels profits: eight leaves under one ancestor three levels up make a subtree, eight such
subtrees under one ancestor a group (CUDA), and what is neither goes leaf by leaf.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from .elements import forest_elements, in_worlds, with_targets
from .kernels.elements import Subtrees
from .kernels.subtree import GROUP_NODES, LEAVES, group_leaves, group_nodes
from .mesh import TetForest
from .mesh.tree import UniformTree
from .slots import Slots

SUBTREE_LEVELS = 3
GROUP_LEVELS = 6


class Sharing(Enum):
    """Whose rotation the leaves of a subtree use."""

    OWN = "own"
    ROOT = "the subtree root's"
    ABOVE = "an ancestor's above the root"


@dataclass(frozen=True)
class Batch:
    """Subtrees of one type that one launch goes through, world after world.

    Attributes:
        shape: Their type, 0, 1 or 2.
        grouped: Whether they come in groups of eight (CUDA).
        count: How many.
        sharing: Whose rotation their leaves use.
        subtrees: ``kernels.elements.Subtrees``.
        roots: Their roots as forest elements where leaves share the root's rotation, else None.
        unit: Which of ``Units`` each uses where leaves share one from further up, int32 [count], else None.
        flagged: Set by the kernel where a subtree was left out, uint8 [count, rounded up to eights].
    """

    shape: int
    grouped: bool
    count: int
    sharing: Sharing
    subtrees: Any
    roots: Any
    unit: wp.array | None
    flagged: wp.array

    @property
    def flags_by_eights(self) -> wp.array:
        """``flagged`` as uint64, eight subtrees each."""
        return wp.array(ptr=self.flagged.ptr, dtype=wp.uint64, shape=len(self.flagged) // 8, device=self.flagged.device)


@dataclass(frozen=True)
class Units:
    """Tetrahedra, leaves or above these, of which rotations are found.

    Attributes:
        elements: ``kernels.elements.ForestElements``, or general ones where there is no tree.
        count: How many one launch goes through.
        unit: Which of them each of the mesh's elements uses, int32 [T].
    """

    elements: Any
    count: int
    unit: wp.array

    @classmethod
    def own(cls, elements: Any, count: int) -> Units:
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
        elements: ``kernels.elements.ForestElements``.
        unit: Which of ``Units`` each uses where rotations are shared, int32 [n], else None.
        general: The same leaves as general elements, if that is known, else None.
        material: Their Lamé parameters mu and lambda [Pa] where these vary and are known, float32 [n] each, else None.
    """

    leaves: wp.array
    elements: Any
    unit: wp.array | None = None
    general: Any = None
    material: tuple[wp.array, wp.array] | None = None

    def __len__(self) -> int:
        return len(self.leaves)


class Plan(Protocol):
    """What a force field goes through, however it came about.

    Attributes:
        batches: Subtrees by type, grouped or not, and sharing.
        flat: The other leaves.
        slots: Where forces go first if their sums must have one order, else None.
        targets: Then each leaf's slots, int32 [worlds * T, 4], else None.
    """

    @property
    def batches(self) -> tuple[Batch, ...]: ...

    @property
    def flat(self) -> FlatLeaves: ...

    @property
    def units(self) -> Units | None:
        """What rotations are found of if some batch or flat leaf asks for that, else None."""
        ...

    @property
    def slots(self) -> Slots | None: ...

    @property
    def targets(self) -> npt.NDArray[np.int32] | None: ...


@dataclass(frozen=True)
class ForcePlan:
    """The ``Plan`` of a forest that stays as it is."""

    batches: tuple[Batch, ...]
    flat: FlatLeaves
    units: Units | None
    slots: Slots | None = None
    targets: npt.NDArray[np.int32] | None = None

    @classmethod
    def of_forest(
        cls,
        forest: TetForest,
        rotation_level: int | None,
        device: wp.Device,
        *,
        worlds: int = 1,
        grouped: bool = True,
        deterministic: bool = False,
    ) -> ForcePlan:
        """The plan of a forest.

        Args:
            rotation_level: Level of the tree at which rotations are shared; None: not shared.
            worlds: How many copies of the body there are.
            grouped: False: subtrees one by one also on CUDA.
            deterministic: Whether every unit has slots of its own for its forces.
        """
        members, flat = _members(forest, rotation_level, grouped=grouped and device.is_cuda)
        units = None
        if rotation_level is not None and (len(flat) or any(m.sharing is Sharing.ABOVE for m in members)):
            units = Units.of_forest(forest, rotation_level, device, worlds)
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
        batches = [
            m.batch(forest, device, worlds, n, t, target_count, units)
            for m, n, t in zip(members, of_nodes, of_targets, strict=True)
        ]
        return cls(tuple(batches), _flat_leaves(forest, flat, device, worlds, targets, units), units, slots, targets)


@dataclass(frozen=True)
class _Members:
    """The subtrees of a batch-to-be: their first leaves, in tree order."""

    shape: int
    grouped: bool
    sharing: Sharing
    first: npt.NDArray[np.int32]

    @property
    def unit_leaves(self) -> int:
        return 64 if self.grouped else 8

    def of_leaves(self, values: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
        """What leaves have at their nodes, int32 [T, 4], by the nodes of the units: [units, 40 or 10]."""
        if not self.grouped:
            places = np.array(subtree_nodes(self.shape))
            return values[self.first[:, None] + places[:, 0], places[:, 1]]
        places = np.array(group_nodes(self.shape))
        found = np.full((len(self.first) // 8, GROUP_NODES), -1, np.int32)
        found[:, : len(places)] = values[self.first[::8, None] + places[:, 0], places[:, 1]]
        return found

    def hand_down(self, values: npt.NDArray[np.int32], leaves: npt.NDArray[np.int32]) -> None:
        """The opposite: write what units have at their nodes to their leaves."""
        places = np.array(group_leaves(self.shape) if self.grouped else LEAVES[self.shape])
        starts = self.first[::8] if self.grouped else self.first
        leaves[starts[:, None] + np.arange(self.unit_leaves)] = values[:, places]

    def batch(
        self,
        forest: TetForest,
        device: wp.Device,
        worlds: int,
        nodes: npt.NDArray[np.int32],
        targets: npt.NDArray[np.int32],
        target_count: int,
        units: Units | None,
    ) -> Batch:
        count = worlds * len(self.first)
        root_indices = forest.tree.above(forest.tree.leaves[self.first], SUBTREE_LEVELS)
        roots = forest_elements(forest, root_indices, device, worlds)
        subtrees = Subtrees()
        subtrees.code = roots.code
        subtrees.frames = roots.frames
        subtrees.size = roots.size
        subtrees.first = wp.array(in_worlds(self.first, worlds, len(forest.tets)), dtype=wp.int32, device=device)
        subtrees.nodes = self._on_device(in_worlds(nodes, worlds, len(forest.points)), device)
        subtrees.targets = subtrees.nodes
        if targets is not nodes:
            subtrees.targets = self._on_device(in_worlds(targets, worlds, target_count), device)
        unit = None
        if units is not None and self.sharing is Sharing.ABOVE:
            unit = _chosen(units.unit, subtrees.first)
        return Batch(
            shape=self.shape,
            grouped=self.grouped,
            count=count,
            sharing=self.sharing,
            subtrees=subtrees,
            roots=roots if self.sharing is Sharing.ROOT else None,
            unit=unit,
            flagged=wp.zeros(-(-count // 8) * 8, dtype=wp.uint8, device=device),
        )

    def _on_device(self, indices: npt.NDArray[np.int32], device: wp.Device) -> wp.array:
        if device.is_cuda and not self.grouped:
            indices = indices.T
        return wp.array(np.ascontiguousarray(indices), dtype=wp.int32, device=device)


def _members(
    forest: TetForest, rotation_level: int | None, *, grouped: bool
) -> tuple[list[_Members], npt.NDArray[np.int32]]:
    """Batches-to-be, and the leaves that are in none."""
    first = complete_subtrees(forest, SUBTREE_LEVELS)
    level = forest.levels[first]
    root = level - SUBTREE_LEVELS
    if rotation_level is None:
        chosen = {Sharing.OWN: np.ones(len(first), bool)}
    else:
        # Between root and leaves, leaves of one subtree use different rotations: those go leaf by leaf.
        chosen = {
            Sharing.OWN: level <= rotation_level,
            Sharing.ROOT: root == rotation_level,
            Sharing.ABOVE: root > rotation_level,
        }
    in_group = np.zeros(len(first), bool)
    if grouped:
        starts = complete_subtrees(forest, GROUP_LEVELS)
        at = np.searchsorted(first, starts)
        in_group[(at[:, None] + np.arange(8)).ravel()] = True
    members = []
    left = np.ones(len(forest.tets), bool)
    for sharing, mask in chosen.items():
        for shape in range(3):
            for kind in (True, False):
                found = first[mask & (level % 3 == shape) & (in_group == kind)]
                if len(found):
                    members.append(_Members(shape, kind, sharing, found))
                    left[(found[:, None] + np.arange(8)).ravel()] = False
    return members, np.flatnonzero(left).astype(np.int32)


def complete_subtrees(forest: TetForest, depth: int) -> npt.NDArray[np.int32]:
    """First leaves of the subtrees whose 2**depth leaves all lie ``depth`` levels below their root; in tree order."""
    size = 2**depth
    levels = forest.levels
    if isinstance(forest.tree, UniformTree) and forest.tree.depth >= depth:
        return np.arange(0, len(levels), size, dtype=np.int32)
    ancestor = forest.tree.above(forest.tree.leaves, depth)
    # In tree order the leaves at one depth below an ancestor follow one another unless deeper ones come between.
    change = np.flatnonzero(np.diff(ancestor, prepend=-2))
    length = np.diff(change, append=len(ancestor))
    return change[(length == size) & (ancestor[change] >= 0)].astype(np.int32)


def subtree_nodes(shape: int) -> list[tuple[int, int]]:
    """Where to read a subtree's ten nodes: (leaf of 8, local node of 4) for each."""
    named = [(node, (at, n)) for at, leaf in enumerate(LEAVES[shape]) for n, node in enumerate(leaf)]
    return [next(place for other, place in named if other == node) for node in range(10)]


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
    return FlatLeaves(leaves, elements, None if units is None else _chosen(units.unit, leaves))


def _chosen(values: wp.array, places: wp.array) -> wp.array:
    return wp.array(values.numpy()[places.numpy()], dtype=values.dtype, device=values.device)
