"""What a force evaluation goes through: complete subtrees in batches of one type, and the leaves left over.

The tree is what meshing edits; the plan is derived from it on the device and is all that stepping reads: once where
the mesh stays as it is (``planning.fixed``), and after each pass where it changes (``changing.plan``).
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
    """Tetrahedra, leaves or above these, of which rotations are found.

    Attributes:
        elements: ``kernels.elements.elements.ForestElements``, or general ones where there is no tree.
        count: How many one launch goes through.
        unit: Which of them each of the mesh's elements uses, int32 [T].
    """

    elements: Elements
    count: int
    unit: wp.array

    @classmethod
    def own(cls, elements: Elements, count: int) -> Units:
        """Each element by itself."""
        return cls(elements, count, wp.array(np.arange(count), dtype=wp.int32, device=elements.nodes.device))


@dataclass(frozen=True)
class FlatLeaves:
    """Leaves that are in no subtree, as elements of their own, world after world.

    Attributes:
        leaves: Which of the mesh's elements they are, int32 [n]; ``len`` is how many one launch goes through.
        elements: ``kernels.elements.elements.ForestElements``.
        unit: Which of ``Units`` each uses where rotations are shared, int32 [n], else None.
        general: The same leaves as general elements, if that is known, else None.
        material: Their Lamé parameters mu and lambda [Pa] where these vary and are known, float32 [n] each, else None.
        live: How many there are where launches go through more, int32 [1] on the device, else None.
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
    """How many leaves there are where their number changes, for launches that derive something of each.

    Attributes:
        most: How many there may be, padding included.
        now, before: How many there are, and were when the plan was last derived; int32 [1] on the device.
        goes: Whether the plan has just been derived, int32 [1] on the device.
        threads: Threads of a launch that goes through all of them.
    """

    most: int
    now: wp.array
    before: wp.array
    goes: wp.array
    threads: int


class Plan(Protocol):
    """What a force field goes through, however it came about.

    Attributes:
        elements: All leaves, ``ForestElements`` or, of a general mesh, ``GeneralElements`` of ``kernels.elements``;
            their forces go to the slots if there are any.
        batches: Subtrees by type, grouped or not, and sharing; none where the field goes leaf by leaf.
        flat: The other leaves.
        slots: Where forces go first if their sums must have one order, else None.
        counts: How many leaves there are, if that changes, else None.
    """

    @property
    def elements(self) -> Elements: ...

    @property
    def batches(self) -> tuple[Batch, ...]: ...

    @property
    def flat(self) -> FlatLeaves: ...

    @property
    def units(self) -> Units | None:
        """What rotations are found of if some batch or flat leaf asks for that, else None."""
        ...

    @property
    def all_units(self) -> Units:
        """What rotations are found of, whether a launch of forces asks for it or not; only where they are shared."""
        ...

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        """Shape, whether in groups, and sharing of all batches that there may ever be."""
        ...

    @property
    def slots(self) -> Slots | None: ...

    @property
    def counts(self) -> LeafCounts | None: ...
