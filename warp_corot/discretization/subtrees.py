"""Batches of complete subtrees of a forest, the units of work of the fast force path.

In an adaptive forest, every stretch of equal levels benefits: eight leaves under one ancestor three levels up form a
subtree, and eight of these subtrees under one ancestor form a group (CUDA). Other leaves are computed one by one.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import warp as wp

from warp_corot.inputs.cpu_threads import part_of
from warp_corot.kernels.elements.elements import ForestElements, Subtrees

#: With at least this many leaves in groups, a launch for groups saves more time than it costs.
GROUPED_LEAVES = 1 << 16


class Sharing(Enum):
    """The owner of the rotation that the leaves of a subtree use."""

    OWN = "own"
    ROOT = "the subtree root's"
    ABOVE = "an ancestor's above the root"


@dataclass(frozen=True)
class Batch:
    """Subtrees of one type in one launch, world after world.

    Attributes:
        shape: Their type, 0, 1 or 2.
        grouped: Whether they come in groups of eight (CUDA).
        count: Number of subtrees.
        sharing: The owner of the rotation that their leaves use.
        subtrees: ``kernels.elements.elements.Subtrees``.
        roots: Their roots as forest elements if leaves share the root's rotation, else None.
        unit: The one of ``Units`` that each uses if leaves share a rotation from further up, int32 [count], else None.
        flagged: Set by the kernel: bit k of a subtree's byte if its leaf k, in tree order, was left out; uint8
            [count, rounded up to eights].
        live: The number of subtrees, if launches cover more, int32 [1] on the device, else None.
    """

    shape: int
    grouped: bool
    count: int
    sharing: Sharing
    subtrees: Subtrees
    roots: ForestElements | None
    unit: wp.array | None
    flagged: wp.array
    live: wp.array | None = None

    def part(self, begin: int, end: int) -> Batch:
        """Some of the subtrees, on the CPU; their leaves have own rotations."""
        flags = wp.zeros(-(-(end - begin) // 8) * 8, dtype=wp.uint8, device="cpu")
        return replace(self, count=end - begin, subtrees=part_of(self.subtrees, begin, end), flagged=flags)

    @property
    def flags_by_eights(self) -> wp.array:
        """``flagged`` as uint64, eight subtrees each."""
        return wp.array(ptr=self.flagged.ptr, dtype=wp.uint64, shape=len(self.flagged) // 8, device=self.flagged.device)


def chosen(values: wp.array, places: wp.array) -> wp.array:
    """The values of an array at chosen places."""
    return wp.array(values.numpy()[places.numpy()], dtype=values.dtype, device=values.device)
