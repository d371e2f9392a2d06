"""A place of its own for every force that a unit of work adds to a node; see ``kernels.elements.reproducible``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.elements.reproducible import gather_slots

from .elements import in_worlds

#: Slots are numbered in 32 bits.
MOST_SLOTS = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Slots:
    """Slots of all units of work, unit after unit, so that each writes to one stretch of memory.

    Attributes:
        starts: Where each node's entries in ``order`` begin, and where the last one's end, int32 [worlds * N + 1].
        order: The slots that each node adds up, int32.
        values: Forces, vec4 [worlds * per_world].
        per_world: How many slots there are in a world.
    """

    starts: wp.array
    order: wp.array
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

        Raises:
            InputError: More slots than can be numbered.
        """
        flat = np.concatenate([nodes.ravel() for nodes in units])
        if worlds * len(flat) > MOST_SLOTS:
            raise InputError(
                f"a deterministic run of this body needs {worlds * len(flat)} slots for forces; "
                f"there can be {MOST_SLOTS} at most"
            )
        there = np.flatnonzero(flat >= 0)
        order = there[np.argsort(flat[there], kind="stable")]
        ends = np.cumsum(np.bincount(flat[there], minlength=node_count))
        slots = cls(
            wp.array(np.concatenate([[0], in_worlds(ends, worlds, len(order))]), dtype=wp.int32, device=device),
            wp.array(in_worlds(order, worlds, len(flat)), dtype=wp.int32, device=device),
            wp.zeros(worlds * len(flat), dtype=wp.vec4, device=device),
            len(flat),
        )
        number = np.where(flat < 0, -1, np.arange(len(flat))).astype(np.int32)
        parts = np.split(number, np.cumsum([nodes.size for nodes in units])[:-1])
        return slots, [part.reshape(nodes.shape) for part, nodes in zip(parts, units, strict=True)]

    def gather(self, f: wp.array, values: wp.array | None = None) -> None:
        """Add each node's slots to its force, vec4 [worlds * N]; ``values`` are others in the place of the slots'."""
        inputs = [self.starts, self.order, self.values if values is None else values]
        wp.launch(gather_slots, dim=len(f), inputs=inputs, outputs=[f], device=f.device)
