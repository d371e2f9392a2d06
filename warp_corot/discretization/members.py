"""The nodes of groups of elements that share their dilatation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import warp as wp

from warp_corot.kernels.elements import mean_dilatation_rows as kernels
from warp_corot.kernels.elements.dilatation import Dilatation

#: Groups in the form of ``kernels.elements.mean_dilatation.share_in_groups``: starts, members, the number of groups
#: if launches cover more, and the number in launches.
Batch = tuple[wp.array, wp.array, wp.array, int]


@dataclass(frozen=True, eq=False)
class Members:
    """Groups, their elements and their nodes.

    Attributes:
        count: Number of groups in launches; some may be empty.
        entries: Total number of nodes of all groups.
        arrays: The arrays on the device.
        law: The shared dilatation.
    """

    count: int
    entries: int
    arrays: kernels.GroupNodes
    law: Dilatation

    @classmethod
    def of(cls, law: Dilatation, batches: list[Batch], nodes: wp.array, below: int | None = None) -> Members:
        """The members of the present mesh; waits for the device.

        Args:
            law: The shared dilatation.
            batches: Groups.
            nodes: The nodes of all elements, vec4i.
            below: Groups of elements from this number on are left empty; None: all count.
        """
        device = nodes.device
        # Subtrees store only their first leaf.
        places = [len(members) or 8 * groups for _, members, _, groups in batches]
        count, room = sum(groups for *_, groups in batches), sum(places)
        found = kernels.GroupNodes()
        found.ranges = wp.zeros(count, dtype=wp.vec2i, device=device)
        found.members, found.corners = (wp.zeros(room, dtype=wp.int32, device=device) for _ in range(2))
        first_group = first_place = 0
        for (starts, members, live, groups), more in zip(batches, places, strict=True):
            inputs = [starts, members, live, first_group, first_place]
            inputs += [np.iinfo(np.int32).max if below is None else below]
            wp.launch(kernels.list_members, groups, inputs, [found.ranges, found.members], device=device)
            first_group, first_place = first_group + groups, first_place + more
        found.ends = wp.zeros(count, dtype=wp.int32, device=device)
        wp.launch(kernels.count_nodes, count, [found.ranges, found.members, nodes], [found.ends], device=device)
        wp.utils.array_scan(found.ends, found.ends, inclusive=True)
        entries = int(found.ends[-1:].numpy()[0]) if count else 0
        found.nodes = wp.zeros(entries, dtype=wp.int32, device=device)
        wp.launch(kernels.name_nodes, count, [nodes], [found], device=device)
        return cls(count, entries, found, law)
