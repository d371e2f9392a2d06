"""Complete subtrees of a forest, the units of work of the fast force path: found, sorted, put into batches.

On an adaptive forest every stretch of equal levels profits: eight leaves under one ancestor three levels up make a
subtree, eight such subtrees under one ancestor a group (CUDA), and what is neither goes leaf by leaf.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.elements.elements import ForestElements, Subtrees
from warp_corot.kernels.tables.subtree import GROUP_NODES, LEAVES, group_leaves, group_nodes
from warp_corot.mesh import TetForest
from warp_corot.mesh.tree import UniformTree

from .elements import forest_elements, in_worlds

SUBTREE_LEVELS = 3
GROUP_LEVELS = 6
#: Leaves in groups from which these have a launch of their own: what that takes off the time is more than it costs.
GROUPED_LEAVES = 1 << 16


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
        subtrees: ``kernels.elements.elements.Subtrees``.
        roots: Their roots as forest elements where leaves share the root's rotation, else None.
        unit: Which of ``Units`` each uses where leaves share one from further up, int32 [count], else None.
        flagged: Set by the kernel: bit k of a subtree's byte where its leaf k, in tree order, was left out; uint8
            [count, rounded up to eights].
    """

    shape: int
    grouped: bool
    count: int
    sharing: Sharing
    subtrees: Subtrees
    roots: ForestElements | None
    unit: wp.array | None
    flagged: wp.array

    @property
    def flags_by_eights(self) -> wp.array:
        """``flagged`` as uint64, eight subtrees each."""
        return wp.array(ptr=self.flagged.ptr, dtype=wp.uint64, shape=len(self.flagged) // 8, device=self.flagged.device)


@dataclass(frozen=True)
class Members:
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
        unit: wp.array | None,
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
        return Batch(
            shape=self.shape,
            grouped=self.grouped,
            count=count,
            sharing=self.sharing,
            subtrees=subtrees,
            roots=roots if self.sharing is Sharing.ROOT else None,
            unit=chosen(unit, subtrees.first) if unit is not None and self.sharing is Sharing.ABOVE else None,
            flagged=wp.zeros(-(-count // 8) * 8, dtype=wp.uint8, device=device),
        )

    def _on_device(self, indices: npt.NDArray[np.int32], device: wp.Device) -> wp.array:
        if device.is_cuda and not self.grouped:
            indices = indices.T
        return wp.array(np.ascontiguousarray(indices), dtype=wp.int32, device=device)


def in_batches(
    forest: TetForest, rotation_level: int | None, *, grouped: bool
) -> tuple[list[Members], npt.NDArray[np.int32]]:
    """Batches-to-be, and the leaves that are in none."""
    first = complete_subtrees(forest, SUBTREE_LEVELS)
    level = forest.levels[first]
    root = level - SUBTREE_LEVELS
    if rotation_level is None:
        shares = {Sharing.OWN: np.ones(len(first), bool)}
    else:
        # Between root and leaves, leaves of one subtree use different rotations: those go leaf by leaf.
        shares = {
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
    for sharing, mask in shares.items():
        for shape in range(3):
            for kind in (True, False):
                found = first[mask & (level % 3 == shape) & (in_group == kind)]
                if len(found):
                    members.append(Members(shape, kind, sharing, found))
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


def pays_in_groups(forest: TetForest, worlds: int) -> bool:
    """Whether so many leaves are in groups that launches of subtrees are faster than one of single elements (CUDA)."""
    return worlds * 8**2 * len(complete_subtrees(forest, GROUP_LEVELS)) >= GROUPED_LEAVES


def subtree_nodes(shape: int) -> list[tuple[int, int]]:
    """Where to read a subtree's ten nodes: (leaf of 8, local node of 4) for each."""
    named = [(node, (at, n)) for at, leaf in enumerate(LEAVES[shape]) for n, node in enumerate(leaf)]
    return [next(place for other, place in named if other == node) for node in range(10)]


def chosen(values: wp.array, places: wp.array) -> wp.array:
    """Some values of an array, by their places."""
    return wp.array(values.numpy()[places.numpy()], dtype=values.dtype, device=values.device)
