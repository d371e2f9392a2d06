"""The force plan: complete subtrees in batches of one type, and the remaining leaves.

Meshing edits the tree. The plan is derived from the tree on the device, and steps read only the plan. It is derived
once if the mesh never changes (``planning.fixed``), otherwise after each pass (``changing.plan``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
import warp as wp

from warp_corot.kernels.elements.elements import GeneralElements

from .elements import Elements
from .slots import Slots
from .subtrees import Batch, Sharing

__all__ = ["Batch", "FlatLeaves", "LeafCounts", "Plan", "Sharing", "Units"]


@dataclass(frozen=True)
class Units:
    """Tetrahedra, leaves or ancestors of leaves, whose rotations are computed.

    Attributes:
        elements: ``kernels.elements.elements.ForestElements``, or general ones without a tree.
        count: Number of units in one launch.
        unit: The unit whose rotation each of the mesh's elements uses, int32 [T].
    """

    elements: Elements
    count: int
    unit: wp.array

    @classmethod
    def own(cls, elements: Elements, count: int) -> Units:
        """Every element is its own unit."""
        return cls(elements, count, wp.array(np.arange(count), dtype=wp.int32, device=elements.nodes.device))


@dataclass(frozen=True)
class FlatLeaves:
    """Leaves outside subtrees, as single elements, world after world.

    Attributes:
        leaves: Their numbers among the mesh's elements, int32 [n]; ``len`` is the number in one launch.
        elements: ``kernels.elements.elements.ForestElements``.
        unit: The one of ``Units`` that each uses if rotations are shared, int32 [n], else None.
        general: The same leaves as general elements, if these exist, else None.
        material: Their Lamé parameters mu and lambda [Pa] if these vary and are kept, float32 [n] each, else None.
        live: The number of leaves, if launches cover more, int32 [1] on the device, else None.
    """

    leaves: wp.array
    elements: Elements
    unit: wp.array | None = None
    general: GeneralElements | None = None
    material: tuple[wp.array, wp.array] | None = None
    live: wp.array | None = None

    def __len__(self) -> int:
        return len(self.leaves)


@dataclass(frozen=True)
class LeafCounts:
    """The number of leaves of a changing mesh, for launches that derive data for each leaf.

    Attributes:
        most: The largest possible number, with padding.
        now, before: The present number, and the number when the plan was last derived; int32 [1] on the device.
        goes: Whether the plan has just been derived, int32 [1] on the device.
        threads: Threads of a launch over all leaves.
    """

    most: int
    now: wp.array
    before: wp.array
    goes: wp.array
    threads: int


class Plan(Protocol):
    """The units of work of a force field, for any mesh.

    Attributes:
        elements: All leaves, ``ForestElements`` or, of a general mesh, ``GeneralElements`` of ``kernels.elements``;
            their forces go to the slots if there are any.
        batches: Subtrees by type, grouped or not, and sharing; none if the field computes leaf by leaf.
        flat: The other leaves.
        slots: The places to which kernels first add forces if sums must have a fixed order, else None.
        counts: The number of leaves, if it changes, else None.
    """

    @property
    def elements(self) -> Elements: ...

    @property
    def batches(self) -> tuple[Batch, ...]: ...

    @property
    def flat(self) -> FlatLeaves: ...

    @property
    def units(self) -> Units | None:
        """The units, if a batch or a flat leaf uses their rotations, else None."""
        ...

    @property
    def all_units(self) -> Units:
        """The units, also if no launch of forces uses them; only if rotations are shared."""
        ...

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        """Shape, whether in groups, and sharing of all possible batches."""
        ...

    @property
    def slots(self) -> Slots | None: ...

    @property
    def counts(self) -> LeafCounts | None: ...
