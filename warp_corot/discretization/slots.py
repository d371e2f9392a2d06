"""Slots: one place for every force that a unit of work adds to a node; see ``kernels.elements.elements``."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.cpu_threads import launch
from warp_corot.kernels.elements.elements import gather_slots
from warp_corot.kernels.plan.slots import find_starts, number_slots, order_slots

from .elements import in_worlds

#: Slots are numbered in 32 bits.
MOST_SLOTS = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Slots:
    """Slots of all units of work, unit after unit, so that each writes to one stretch of memory.

    Attributes:
        starts: The beginning of each node's entries in ``order``, and the end of the last, int32 [worlds * N + 1].
        order: The slots that each node sums, int32.
        values: Forces, vec4 [worlds * per_world].
        per_world: How many slots there are in a world.
    """

    starts: wp.array
    order: wp.array
    values: wp.array
    per_world: int

    @classmethod
    def of_nodes(cls, nodes: wp.array, per_world: int, used: int, node_count: int, worlds: int) -> Slots:
        """Slots by the node that each belongs to.

        Args:
            nodes: Nodes of the slots of one world, ``node_count`` for unused slots, and as many further places, int32
                [2 * per_world]. It is overwritten.
            per_world: How many slots there are in a world.
            used: Number of used slots.
            node_count: Number of nodes of one world.
        """
        device = nodes.device
        slots = wp.empty_like(nodes)
        wp.launch(number_slots, per_world, outputs=[slots], device=device)
        wp.utils.radix_sort_pairs(nodes, slots, per_world)
        starts = wp.empty(worlds * node_count + 1, dtype=wp.int32, device=device)
        inputs = [per_world, node_count, used, nodes]
        wp.launch(find_starts, (worlds, node_count + 1), inputs, [starts], device=device)
        order = wp.empty(worlds * used, dtype=wp.int32, device=device)
        wp.launch(order_slots, (worlds, used), [per_world, used, slots], [order], device=device)
        return cls(starts, order, wp.zeros(worlds * per_world, dtype=wp.vec4, device=device), per_world)

    @classmethod
    def of_units(
        cls, units: npt.NDArray[np.int32], node_count: int, device: wp.Device, worlds: int = 1
    ) -> tuple[Slots, npt.NDArray[np.int32]]:
        """Slots for units of work that all have the same number of nodes.

        Args:
            units: Their nodes, of one world, [n, m].
            node_count: Number of nodes of one world.

        Returns:
            The slots, and their numbers in the same places in all worlds, int32 [worlds * n, m].

        Raises:
            InputError: There are more slots than can be numbered.
        """
        check_slots(worlds * units.size)
        nodes = wp.empty(2 * units.size, dtype=wp.int32, device=device)
        nodes[: units.size].assign(np.ascontiguousarray(units, dtype=np.int32).ravel())
        numbers = np.arange(units.size, dtype=np.int32).reshape(units.shape)
        slots = cls.of_nodes(nodes, units.size, units.size, node_count, worlds)
        return slots, in_worlds(numbers, worlds, units.size)

    def gather(self, f: wp.array, begin: int = 0, end: int | None = None, *, clears: bool = False) -> None:
        """Add each node's slots to its force.

        Args:
            f: Forces [N], vec4 [worlds * N].
            begin, end: The nodes.
            clears: Whether these slots are zero afterwards.
        """
        end = len(f) if end is None else end
        inputs = [self.starts[begin : end + 1], self.order, int(clears), self.values]
        launch(gather_slots, end - begin, inputs, [f[begin:end]], device=f.device)


def check_slots(count: int) -> None:
    """Check that the slots can be numbered.

    Raises:
        InputError: There are too many.
    """
    if count > MOST_SLOTS:
        raise InputError(
            f"a deterministic run of this body needs {count} slots for forces; there can be {MOST_SLOTS} at most"
        )
