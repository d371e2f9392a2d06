"""A place of its own for every force that a unit of work adds to a node; see ``kernels.reproducible``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from .elements import in_worlds
from .kernels.reproducible import gather_slots


@dataclass(frozen=True, eq=False)
class Slots:
    """Slots of all nodes, node after node.

    Attributes:
        starts: Where each node's begin, and where the last one's end, int32 [worlds * N + 1].
        values: Forces, all zero between uses, vec4 [worlds * per_world].
        per_world: How many there are in a world.
    """

    starts: wp.array
    values: wp.array
    per_world: int

    @classmethod
    def of_units(
        cls, units: Sequence[npt.NDArray[np.int32]], node_count: int, device: wp.Device, worlds: int = 1
    ) -> tuple[Slots, list[npt.NDArray[np.int32]]]:
        """Slots for units of work, and which slot each unit's nodes have.

        Args:
            units: Nodes of the units of one kind, [n, m] for each kind, of one world; negative where there is none.
            node_count: Number of nodes of one world.

        Returns:
            The slots, and for each kind their numbers in the same places, int32 [n, m], of one world.
        """
        flat = np.concatenate([nodes.ravel() for nodes in units])
        there = np.flatnonzero(flat >= 0)
        order = there[np.argsort(flat[there], kind="stable")]
        number = np.full(len(flat), -1, np.int32)
        number[order] = np.arange(len(order), dtype=np.int32)
        ends_of_nodes = np.cumsum(np.bincount(flat[there], minlength=node_count))
        starts = np.concatenate([[0], in_worlds(ends_of_nodes, worlds, len(order))])
        slots = cls(
            wp.array(starts, dtype=wp.int32, device=device),
            wp.zeros(worlds * len(order), dtype=wp.vec4, device=device),
            len(order),
        )
        ends = np.cumsum([nodes.size for nodes in units])
        parts = np.split(number, ends[:-1])
        return slots, [part.reshape(nodes.shape) for part, nodes in zip(parts, units, strict=True)]

    def gather(self, f: wp.array) -> None:
        """Add each node's slots to its force, vec4 [N], and clear them."""
        wp.launch(gather_slots, dim=len(f), inputs=[self.starts, self.values], outputs=[f], device=f.device)
