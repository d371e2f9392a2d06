"""Nodes whose displacements come from elsewhere while a step has begun: what needs them is launched apart."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.elements.elements import Subtrees

from .subtrees import Batch, chosen


@dataclass(eq=False)
class Awaited:
    """Nodes that other processes move.

    Attributes:
        nodes: Which nodes of all worlds these are, bool [worlds * N].
        later: Launches within this context have their displacements, and run beside what is launched outside of it.
        is_used: Whether forces are launched apart, so that they may be computed before the nodes have come.
    """

    nodes: npt.NDArray[np.bool_]
    later: Callable[[], AbstractContextManager[None]]
    is_used: bool = False

    def divided(self, batch: Batch) -> tuple[Batch, Batch]:
        """Subtrees in groups of eight: those that need none of the nodes, and the others."""
        nodes = batch.subtrees.nodes.numpy()
        late = (self.nodes[np.maximum(nodes, 0)] & (nodes >= 0)).any(axis=1)
        first, second = (_those(batch, nodes, np.flatnonzero(late == wanted)) for wanted in (False, True))
        return first, second


def _those(batch: Batch, nodes: npt.NDArray[np.int32], groups: npt.NDArray[np.intp]) -> Batch:
    """Some groups of a batch."""
    given, subtrees, device = batch.subtrees, Subtrees(), batch.flagged.device
    members = wp.array((8 * groups[:, None] + np.arange(8)).ravel(), dtype=wp.int32, device="cpu")
    subtrees.nodes = subtrees.targets = wp.array(nodes[groups], dtype=wp.int32, device=device, ndim=2)
    subtrees.code, subtrees.first = chosen(given.code, members), chosen(given.first, members)
    subtrees.frames, subtrees.size = given.frames, given.size
    flagged = wp.zeros(len(members), dtype=wp.uint8, device=device)
    return replace(batch, count=len(members), subtrees=subtrees, flagged=flagged)
