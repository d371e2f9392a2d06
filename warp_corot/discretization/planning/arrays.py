"""The arrays of a plan, and the parts that launches of forces read."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from warp_corot.discretization.plan import FlatLeaves, Units
from warp_corot.discretization.subtrees import Batch, Sharing
from warp_corot.errors import InputError
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements, Subtrees
from warp_corot.kernels.plan import batches as batch_kernels
from warp_corot.kernels.plan.plan import Plan, places_t
from warp_corot.kernels.plan.tree import Tree
from warp_corot.kernels.tables.subtree import GROUP_NODES

from .tree import places_on

#: Classes begin at multiples of this: whole groups, whole lanes and whole lines of memory.
GRANULE = 64
#: Nodes of subtrees are numbered in 32 bits.
MOST_NODES = 2**31 - 1


@dataclass(frozen=True)
class Room:
    """Places in a plan's arrays, for all worlds.

    Attributes:
        subtrees: For subtrees of each class.
        flat: For leaves outside subtrees.
        units: For units; 0 if they are not listed.
        leaves: For leaves.
    """

    subtrees: Sequence[int]
    flat: int
    units: int
    leaves: int


class PlanArrays:
    """The arrays of a plan, at first without values.

    Args:
        tree: The tree that the plan is derived from.
        elements: The leaves, in one world or more. Other elements have the same frames and edge lengths.
        rotation_level: Level of the tree at which rotations are shared; None: not shared.
        subtrees: False: all leaves are computed one by one.
        grouped: Whether complete subtrees form groups where possible.

    Attributes:
        kinds: Sharing and shape of the subtrees of one launch, grouped or not.
        tree: The argument.
        plan, batches, leaves: ``kernels.plan.plan.Plan``, ``kernels.plan.batches.Batches`` and ``FlatLeaves``.
    """

    def __init__(
        self, tree: Tree, elements: ForestElements, rotation_level: int | None, *, subtrees: bool, grouped: bool
    ):
        self.tree, self._elements_like = tree, elements
        self.device = elements.nodes.device
        self.kinds = [(Sharing.OWN, shape) for shape in range(3)]
        if rotation_level is not None:
            self.kinds += [(Sharing.ROOT, rotation_level % 3), *((Sharing.ABOVE, shape) for shape in range(3))]
        plan = Plan()
        plan.rotation_level, plan.with_subtrees = -1 if rotation_level is None else rotation_level, int(subtrees)
        plan.members, plan.worlds = 2 if grouped else 1, 1
        plan.classes = plan.members * len(self.kinds)
        plan.counts, plan.before = self._zeros(plan.classes + 3), self._zeros(plan.classes + 3)
        plan.code = elements.code
        self.plan, self.batches, self.leaves = plan, batch_kernels.Batches(), batch_kernels.FlatLeaves()
        self.leaves.mu_row = self.leaves.lam_row = -1

    def make(self, room: Room) -> None:
        """Make the arrays.

        Raises:
            InputError: The subtrees have more nodes than can be numbered.
        """
        plan, batches, leaves = self.plan, self.batches, self.leaves
        begin, node_begin = [0], [0]
        for row, count in enumerate(room.subtrees):
            begin.append(_rounded(begin[-1] + count))
            node_begin.append(_rounded(node_begin[-1] + (5 if self.is_grouped(row) else 10) * count))
        if node_begin[-1] > MOST_NODES:
            raise InputError(f"subtrees of this body name {node_begin[-1]} nodes; there can be {MOST_NODES} at most")
        self._room = room
        self._begin, self._node_begin = begin, node_begin
        plan.begin, batches.node_begin, batches.room = (_places(given) for given in (begin, node_begin, room.subtrees))
        plan.first = self._empty(begin[-1])
        plan.flat = self._empty(room.flat)
        plan.with_units = int(room.units > 0)
        if room.units:
            plan.unit, plan.unit_code = self._empty(room.leaves), self._empty(room.units)
            plan.unit_nodes = self._empty(room.units, wp.vec4i)
        tables = places_on(self.device.alias)
        batches.places, batches.group_places = tables.subtree, tables.group
        batches.by_node = int(self.device.is_cuda)
        batches.nodes, batches.code = self._empty(node_begin[-1]), self._empty(begin[-1])
        if len(self.kinds) > 3:
            batches.unit = self._empty(begin[-1])
            batches.roots = begin[3 * plan.members]
            batches.root_nodes = self._empty(begin[4 * plan.members] - batches.roots, wp.vec4i)
        flat = room.flat if plan.with_subtrees else 0
        leaves.nodes, leaves.code = self._empty(flat, wp.vec4i), self._empty(flat)
        leaves.unit = self._empty(flat if room.units else 0)
        self._flagged = wp.zeros(begin[-1], dtype=wp.uint8, device=self.device)

    def is_grouped(self, row: int) -> bool:
        """Whether subtrees of a class are in groups."""
        return self.plan.members == 2 and row % 2 == 0

    @property
    def rotation_shared(self) -> bool:
        return bool(self.plan.rotation_level >= 0)

    # --- what launches go through ------------------------------------------------------------------------------------

    def batch(self, row: int, count: int, targets: wp.array | None = None) -> Batch:
        """The first subtrees of a class.

        Args:
            targets: The places to which their forces are added, in the layout of ``batches.nodes``; None: the nodes.
        """
        arrays, begin = self.batches, self._begin[row]
        sharing, shape = self.kinds[row // self.plan.members]
        subtrees, here = Subtrees(), slice(begin, begin + count)
        subtrees.nodes = self._nodes(arrays.nodes, row, count)
        subtrees.targets = subtrees.nodes if targets is None else self._nodes(targets, row, count)
        subtrees.code, subtrees.first = arrays.code[here], self.plan.first[here]
        subtrees.frames, subtrees.size = self._elements_like.frames, self._elements_like.size
        roots = unit = None
        if sharing is Sharing.ROOT:
            first = begin - arrays.roots
            roots = self.elements(arrays.root_nodes[first : first + count], subtrees.code)
        elif sharing is Sharing.ABOVE:
            unit = arrays.unit[here]
        flagged = self._flagged[begin : begin + -(-count // 8) * 8]
        return Batch(shape, self.is_grouped(row), count, sharing, subtrees, roots, unit, flagged)

    def flat(self, count: int, targets: wp.array | None = None) -> FlatLeaves:
        """The first leaves outside subtrees; ``targets`` as for ``batch``."""
        leaves, general = self.leaves, None
        if leaves.volume is not None:
            general = GeneralElements()
            general.nodes = general.targets = _first(leaves.nodes, count)
            general.rest_inverse, general.volume = _first(leaves.rest_inverse, count), _first(leaves.volume, count)
        return FlatLeaves(
            leaves=_first(self.plan.flat, count),
            elements=self.elements(_first(leaves.nodes, count), _first(leaves.code, count), targets),
            unit=_first(leaves.unit, count) if self.plan.with_units else None,
            general=general,
            material=(_first(leaves.mu, count), _first(leaves.lam, count)) if leaves.mu_row >= 0 else None,
        )

    def units(self, count: int) -> Units:
        """The first units."""
        return Units(self.elements(self.plan.unit_nodes, self.plan.unit_code), count, self.plan.unit)

    def elements(self, nodes: wp.array, code: wp.array, targets: wp.array | None = None) -> ForestElements:
        """Any elements of the forest."""
        elements = ForestElements()
        elements.nodes, elements.targets = nodes, nodes if targets is None else targets
        elements.code = code
        elements.frames, elements.size = self._elements_like.frames, self._elements_like.size
        return elements

    def _nodes(self, nodes: wp.array, row: int, count: int) -> wp.array:
        """Nodes of the first subtrees of a class, from any array of the same layout."""
        begin, room = self._node_begin[row], self._room.subtrees[row]
        if self.is_grouped(row):
            return nodes[begin : begin + 5 * count].reshape((count // 8, GROUP_NODES))
        if self.batches.by_node:
            return _first(nodes[begin : begin + 10 * room].reshape((10, room)), count, axis=1)
        return nodes[begin : begin + 10 * count].reshape((count, 10))

    def _zeros(self, shape: int | tuple[int, int], dtype: type = wp.int32) -> wp.array:
        return wp.zeros(shape, dtype=dtype, device=self.device)

    def _empty(self, count: int, dtype: type = wp.int32) -> wp.array:
        return wp.empty(count, dtype=dtype, device=self.device)


def _rounded(count: int) -> int:
    return -(-count // GRANULE) * GRANULE


def _places(values: Sequence[int]) -> Any:
    """Three numbers as a vector for kernels."""
    return places_t(*values[:16], *[0] * (16 - len(values)))


def _first(array: wp.array, count: int, axis: int = 0) -> wp.array:
    """The first places of an array along an axis, which may have none."""
    if array.shape[axis] <= count:
        return array
    return array[:count] if axis == 0 else array[:, :count]
