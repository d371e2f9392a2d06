"""The force plan: complete subtrees in batches of one type, the units of work of the fast force path, and the remaining
leaves.

In an adaptive forest, every stretch of equal levels benefits: eight leaves under one ancestor three levels up form a
subtree, and eight of these subtrees under one ancestor form a group (CUDA). Other leaves are computed one by one."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from enum import Enum
from typing import Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Elements, in_worlds
from warp_corot.errors import InputError
from warp_corot.inputs.cpu_threads import launch, part_of
from warp_corot.kernels.elements.elements import GeneralElements, Subtrees, gather_slots
from warp_corot.kernels.plan.slots import find_starts

#: Slots are numbered in 32 bits.
MOST_SLOTS = 2**31 - 1


@dataclass(frozen=True, eq=False)
class Slots:
    """Slots of all units of work, unit after unit, so that each writes to one stretch of memory.

    Attributes:
        starts: The beginning of each node's entries in ``order``, and the end of the last, int32 [worlds * N + 1].
        order: The slots that each node sums, int32.
        values: Forces, vec4 [slots].
    """

    starts: wp.array
    order: wp.array
    values: wp.array

    @classmethod
    def of_nodes(cls, nodes: wp.array, used: int, node_count: int) -> Slots:
        """Slots by the node that each belongs to.

        Args:
            nodes: Nodes of the slots, ``node_count`` for unused slots, and as many further places, int32 [2 * slots].
                It is overwritten.
            used: Number of used slots.
            node_count: Number of nodes.
        """
        count, device = len(nodes) // 2, nodes.device
        slots = wp.array(np.arange(len(nodes)), dtype=wp.int32, device=device)
        wp.utils.radix_sort_pairs(nodes, slots, count)
        starts = wp.empty(node_count + 1, dtype=wp.int32, device=device)
        wp.launch(find_starts, len(starts), [count, nodes], [starts], device=device)
        return cls(starts, wp.clone(slots[:used]), wp.zeros(count, dtype=wp.vec4, device=device))

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
        named = in_worlds(np.asarray(units, np.int32), worlds, node_count)
        nodes = wp.empty(2 * named.size, dtype=wp.int32, device=device)
        nodes[: named.size].assign(np.ascontiguousarray(named).ravel())
        numbers = np.arange(named.size, dtype=np.int32).reshape(named.shape)
        return cls.of_nodes(nodes, named.size, worlds * node_count), numbers

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
    unit: wp.array | None
    flagged: wp.array
    live: wp.array | None = None

    def part(self, begin: int, end: int) -> Batch:
        """Some of the subtrees, on the CPU; their leaves have own rotations or their root's."""
        flags = wp.zeros(-(-(end - begin) // 8) * 8, dtype=wp.uint8, device="cpu")
        return replace(self, count=end - begin, subtrees=part_of(self.subtrees, begin, end), flagged=flags)

    @property
    def flags_by_eights(self) -> wp.array:
        """``flagged`` as uint64, eight subtrees each."""
        return wp.array(ptr=self.flagged.ptr, dtype=wp.uint64, shape=len(self.flagged) // 8, device=self.flagged.device)


def chosen(values: wp.array, places: wp.array) -> wp.array:
    """The values of an array at chosen places."""
    return wp.array(values.numpy()[places.numpy()], dtype=values.dtype, device=values.device)


# --- the plan --------------------------------------------------------------------------------------------------------
#
# Meshing edits the tree. The plan is derived from the tree on the device, and steps read only the plan. It is derived
# once if the mesh never changes (``planner``), otherwise after each pass (``changing.plan``).


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
    """Leaves outside subtrees, world after world.

    Attributes:
        leaves: Their numbers among the mesh's elements, int32 [n]; ``len`` is the number in one launch.
        general: The same leaves as general elements, on the CPU; else None.
        live: The number of leaves, if launches cover more, int32 [1] on the device, else None.
    """

    leaves: wp.array
    general: GeneralElements | None = None
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


# --- nodes whose displacements arrive during a step ------------------------------------------------------------------


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
