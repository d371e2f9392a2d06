"""What a force evaluation goes through: complete subtrees in batches of one type, and the leaves left over.

The tree is what meshing edits; the plan is derived from it once and is all that stepping reads. On an adaptive forest
every stretch of equal levels profits: eight leaves under one ancestor three levels up make a subtree, eight such
subtrees under one ancestor a group (CUDA), and what is neither goes leaf by leaf.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from .elements import forest_elements
from .kernels.elements import Subtrees
from .kernels.subtree import GROUP_NODES, LEAVES, group_nodes
from .mesh import TetForest

SUBTREE_LEVELS = 3
GROUP_LEVELS = 6


class Sharing(Enum):
    """Whose rotation the leaves of a subtree use."""

    OWN = "own"
    ROOT = "the subtree root's"
    ABOVE = "an ancestor's above the root"


@dataclass(frozen=True)
class Batch:
    """Subtrees of one type that one launch goes through.

    Attributes:
        shape: Their type, 0, 1 or 2.
        grouped: Whether they come in groups of eight (CUDA).
        count: How many.
        sharing: Whose rotation their leaves use.
        subtrees: ``kernels.elements.Subtrees``.
        roots: Their roots as forest elements where leaves share the root's rotation, else None.
        flagged: Set by the kernel where a subtree was left out, uint8 [count].
    """

    shape: int
    grouped: bool
    count: int
    sharing: Sharing
    subtrees: Any
    roots: Any
    flagged: wp.array


@dataclass(frozen=True)
class ForcePlan:
    """Batches of subtrees and the leaves left over.

    Attributes:
        batches: Subtrees by type, grouped or not, and sharing.
        flat: The other leaves, indices into the mesh's elements.
    """

    batches: tuple[Batch, ...]
    flat: npt.NDArray[np.int32]

    @classmethod
    def of_forest(cls, forest: TetForest, rotation_level: int | None, device: wp.Device) -> ForcePlan:
        """The plan of a forest whose rotations are shared at a level of the tree (None: not shared)."""
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
        if device.is_cuda:
            starts = complete_subtrees(forest, GROUP_LEVELS)
            at = np.searchsorted(first, starts)
            in_group[(at[:, None] + np.arange(8)).ravel()] = True
        batches = []
        left = np.ones(len(forest.tets), bool)
        for sharing, mask in chosen.items():
            for shape in range(3):
                for grouped in (True, False):
                    members = first[mask & (level % 3 == shape) & (in_group == grouped)]
                    if len(members):
                        batches.append(_batch(forest, members, shape, grouped, sharing, device))
                        left[(members[:, None] + np.arange(8)).ravel()] = False
        return cls(tuple(batches), np.flatnonzero(left).astype(np.int32))


def complete_subtrees(forest: TetForest, depth: int) -> npt.NDArray[np.int32]:
    """First leaves of the subtrees whose 2**depth leaves all lie ``depth`` levels below their root; in tree order."""
    size = 2**depth
    levels = forest.levels
    if levels[0] >= depth and (levels == levels[0]).all():
        return np.arange(0, len(levels), size, dtype=np.int32)
    ancestor = forest.tree.above(forest.tree.leaves, depth)
    # In tree order the leaves at one depth below an ancestor follow one another unless deeper ones come between.
    change = np.flatnonzero(np.diff(ancestor, prepend=-2))
    length = np.diff(change, append=len(ancestor))
    return change[(length == size) & (ancestor[change] >= 0)].astype(np.int32)


def _batch(
    forest: TetForest, first: np.ndarray, shape: int, grouped: bool, sharing: Sharing, device: wp.Device
) -> Batch:
    count = len(first)
    root_indices = forest.tree.above(forest.tree.leaves[first], SUBTREE_LEVELS)
    roots = forest_elements(forest, root_indices, device)
    subtrees = Subtrees()
    subtrees.code = roots.code
    subtrees.frames = roots.frames
    subtrees.size = roots.size
    subtrees.first = wp.array(first, dtype=wp.int32, device=device)
    if grouped:
        places = np.array(group_nodes(shape))
        nodes = np.full((count // 8, GROUP_NODES), -1, np.int32)
        nodes[:, : len(places)] = forest.tets[first[::8, None] + places[:, 0], places[:, 1]]
    else:
        places = np.array([_place(shape, node) for node in range(10)])
        nodes = forest.tets[first[:, None] + places[:, 0], places[:, 1]]
        if device.is_cuda:
            nodes = nodes.T
    subtrees.nodes = wp.array(np.ascontiguousarray(nodes), dtype=wp.int32, device=device)
    return Batch(
        shape=shape,
        grouped=grouped,
        count=count,
        sharing=sharing,
        subtrees=subtrees,
        roots=roots if sharing is Sharing.ROOT else None,
        flagged=wp.zeros(count, dtype=wp.uint8, device=device),
    )


def _place(shape: int, node: int) -> tuple[int, int]:
    """A leaf of the subtree, and which of its nodes, where a local node is named."""
    return next((at, n) for at, leaf in enumerate(LEAVES[shape]) for n in range(4) if leaf[n] == node)
