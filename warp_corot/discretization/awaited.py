"""Nodes whose displacements arrive from other processes during a step: launches that need them are separate."""

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
        nodes: Mask of these nodes among those of all worlds, bool [worlds * N].
        later: Launches within this context see their displacements, and run beside launches outside of it.
        is_used: Whether forces have separate launches, so that some are computed before the nodes arrive.
    """

    nodes: npt.NDArray[np.bool_]
    later: Callable[[], AbstractContextManager[None]]
    is_used: bool = False

    def divided(self, batch: Batch) -> tuple[Batch, Batch]:
        """Divide groups of eight subtrees into those that need none of the nodes, and the others."""
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
