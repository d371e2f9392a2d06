"""The planner of a force plan on the device: its arrays, launches, and slots for forces; see ``kernels.plan``."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Elements, device_elements, device_frames, with_targets
from warp_corot.discretization.plan import GROUPED_LEAVES, Batch, FlatLeaves, Sharing, Slots, Units, check_slots
from warp_corot.errors import InputError
from warp_corot.kernels.elements.cpu import rest_matrices
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements, Subtrees
from warp_corot.kernels.plan import batches as batch_kernels
from warp_corot.kernels.plan import plan as lists
from warp_corot.kernels.plan import slots as kernels
from warp_corot.kernels.plan.plan import Plan, Tree, places_t
from warp_corot.kernels.tables.shapes import MIRROR_BIT
from warp_corot.kernels.tables.subtree import GROUP_NODES, LEAVES, group_leaves, group_nodes
from warp_corot.mesh import TetForest
from warp_corot.mesh.bisection import corner_leaves
from warp_corot.mesh.lattice import MAX_LEVEL
from warp_corot.mesh.tree import UniformTree


def tree_of(forest: TetForest, elements: ForestElements, rotation_level: int | None) -> Tree:
    """A forest that never changes, read in place if the device can.

    Args:
        elements: Its leaves on the device, in one world or more.
        rotation_level: Level at which rotations are shared; None: kernels read only the identity of elements above the
            leaves.
    """
    device, source = elements.nodes.device, forest.tree
    tree = Tree()
    counts = wp.array([len(forest.tets), forest.node_count], dtype=wp.int32, device=device)
    tree.leaf_count, tree.node_count = counts[:1], counts[1:]
    tree.named = int(forest.node_count == len(forest.lattice))
    tree.leaf_tets = elements.nodes
    tree.parent_code = device_frames(device)[1]
    if isinstance(source, UniformTree):
        tree.uniform = 1
        level = source.depth if rotation_level is None else min(rotation_level, source.depth)
        tree.corner_leaves, tree.corner_nodes = (
            wp.vec4i(*places) for places in zip(*corner_leaves(level, source.depth), strict=True)
        )
        return tree
    tree.roots = int(np.count_nonzero(source.parent < 0))
    tree.leaves, tree.parent = (_read(values, wp.int32, device) for values in (source.leaves, source.parent))
    if source.cut is not None:
        tree.cut = _read(source.cut, wp.int32, device)
    if rotation_level is not None:
        tree.tets = _read(source.tets, wp.vec4i, device)
    return tree


class Places(NamedTuple):
    """The leaf and the local node at each place, by shape; see ``kernels.tables.subtree``.

    Attributes:
        subtree, group: Leaf and its node for each node of a subtree or group, negative past the last, vec2i [3, 10] and
            [3, 40].
        leaves, group_leaves: The inverse tables, vec4i [3, 8] and [3, 64].
    """

    subtree: wp.array
    group: wp.array
    leaves: wp.array
    group_leaves: wp.array


@functools.cache
def places_on(alias: str) -> Places:
    """The tables on a device. All its plans share them."""
    group = np.full((3, GROUP_NODES, 2), -1)
    for shape in range(3):
        given = group_nodes(shape)
        group[shape, : len(given)] = given
    tables = (
        ([subtree_nodes(shape) for shape in range(3)], wp.vec2i),
        (group, wp.vec2i),
        (LEAVES, wp.vec4i),
        ([group_leaves(shape) for shape in range(3)], wp.vec4i),
    )
    return Places(*(wp.array(np.array(values), dtype=dtype, device=alias, ndim=2) for values, dtype in tables))


def subtree_nodes(shape: int) -> list[tuple[int, int]]:
    """Where to read a subtree's ten nodes: (leaf of 8, local node of 4) for each."""
    named = [(node, (at, n)) for at, leaf in enumerate(LEAVES[shape]) for n, node in enumerate(leaf)]
    return [next(place for other, place in named if other == node) for node in range(10)]


def _read(values: npt.NDArray[np.integer], dtype: type, device: wp.Device) -> wp.array:
    """An array of integers for launches that only read it; on the CPU it shares the given array's memory."""
    values = np.ascontiguousarray(values, dtype=np.int32)
    return wp.array(values, dtype=dtype, device=device, copy=not values.flags.writeable)


# --- the arrays of a plan, and the parts that launches of forces read ------------------------------------------------


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


#: Threads of a launch on CUDA for each multiprocessor.
THREADS_PER_PROCESSOR = 1024


def threads_on(device: wp.Device) -> int:
    """Number of threads of a launch in which each loops over a stretch of leaves."""
    return 1 if device.is_cpu else device.sm_count * THREADS_PER_PROCESSOR


class PlanArrays:
    """The arrays of a plan, at first without values, and the launches that derive it, which may be recorded.

    Args:
        tree: The tree that the plan is derived from.
        elements: The leaves, in one world or more. Other elements have the same frames and edge lengths.
        rotation_level: Level of the tree at which rotations are shared; None: not shared.
        subtrees: False: all leaves are computed one by one.
        grouped: Whether complete subtrees form groups where possible.
        threads: Threads of a launch.

    Attributes:
        kinds: Sharing and shape of the subtrees of one launch, grouped or not.
        tree: The argument.
        plan, batches, leaves: ``kernels.plan.plan.Plan``, ``kernels.plan.batches.Batches`` and ``FlatLeaves``.
    """

    def __init__(
        self,
        tree: Tree,
        elements: ForestElements,
        rotation_level: int | None,
        threads: int,
        *,
        subtrees: bool,
        grouped: bool,
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
        self._threads, self._rows = threads, plan.classes + 2
        self._sums, self._ends = self._empty(self._rows * threads), self._empty(self._rows * threads)

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
        if self.device.is_cpu and room.flat and plan.with_subtrees:
            # The CPU computes eight elements at a time, from rest matrices.
            leaves.nodes, leaves.rest_inverse = (self._empty(room.flat, kind) for kind in (wp.vec4i, wp.mat33))
            leaves.volume = self._empty(room.flat, wp.float32)
            codes = (np.arange(2 * len(self._elements_like.frames))[:, None] << MIRROR_BIT) + np.arange(3)
            leaves.inverse_of, _ = self._rest_matrices(codes.ravel())
            _, leaves.volume_of = self._rest_matrices(np.arange(MAX_LEVEL + 1))
        self._flagged = wp.zeros(begin[-1], dtype=wp.uint8, device=self.device)

    def is_grouped(self, row: int) -> bool:
        """Whether subtrees of a class are in groups."""
        return self.plan.members == 2 and row % 2 == 0

    @property
    def rotation_shared(self) -> bool:
        return bool(self.plan.rotation_level >= 0)

    # --- launches ----------------------------------------------------------------------------------------------------

    def find(self) -> None:
        """Find the leaves in complete subtrees and the units, and count them; this needs only ``plan.marks``."""
        self._launch(lists.mark_leaves, self._threads, self._threads, self.tree, self.plan, self._sums)
        wp.utils.array_scan(self._sums, self._ends, inclusive=True)
        self._launch(lists.count_rows, self._rows, self._threads, self._ends, self.plan)

    def list(self) -> None:
        """List the leaves and the units."""
        self._launch(lists.list_leaves, self._threads, self._threads, self.tree, self._ends, self.plan)

    def fill_batches(self) -> None:
        """Write the data of subtrees for launches."""
        inputs = self._threads, self.tree, self.plan, self.batches
        self._launch(batch_kernels.fill_batches, (self.plan.classes, self._threads), *inputs)

    def fill_flat(self) -> None:
        """Write the data of leaves outside subtrees for launches."""
        self._launch(batch_kernels.fill_flat, self._threads, self._threads, self.tree, self.plan, self.leaves)

    def pad_units(self) -> None:
        """Write padding before and after the units."""
        self._launch(lists.pad_units, self._threads, self._threads, self.tree, self.plan)

    def repeat_units(self) -> None:
        """Write the units of all worlds but the first."""
        self._launch(lists.repeat_units, (self.plan.worlds - 1, self.plan.world_leaves), self.plan)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, int], *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(arguments), device=self.device)

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
        unit = arrays.unit[here] if sharing is Sharing.ABOVE else None
        flagged = self._flagged[begin : begin + -(-count // 8) * 8]
        return Batch(shape, self.is_grouped(row), count, sharing, subtrees, unit, flagged)

    def flat(self, count: int) -> FlatLeaves:
        """The first leaves outside subtrees."""
        leaves, general = self.leaves, None
        if leaves.volume:
            general = GeneralElements()
            general.nodes = general.targets = _first(leaves.nodes, count)
            general.rest_inverse, general.volume = _first(leaves.rest_inverse, count), _first(leaves.volume, count)
            general.numbers = _first(self.plan.flat, count)
        return FlatLeaves(_first(self.plan.flat, count), general)

    def _rest_matrices(self, codes: npt.NDArray[np.integer]) -> tuple[wp.array, wp.array]:
        """Rest matrices and volumes of elements by their codes."""
        elements = self.elements(self.leaves.nodes, wp.array(codes, dtype=wp.int32, device=self.device))
        found = self._empty(len(codes), wp.mat33), self._empty(len(codes), wp.float32)
        wp.launch(rest_matrices, len(codes), [elements], list(found), device=self.device)
        return found

    def units(self, count: int) -> Units:
        """The first units."""
        return Units(self.elements(self.plan.unit_nodes, self.plan.unit_code), count, self.plan.unit)

    def elements(self, nodes: wp.array, code: wp.array) -> ForestElements:
        """Any elements of the forest."""
        elements = ForestElements()
        elements.nodes, elements.targets, elements.code = nodes, nodes, code
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


# --- slots for the forces of a plan's subtrees and single leaves; see ``kernels.plan.slots`` -------------------------


def slots_of(
    made: PlanArrays, subtrees: Sequence[int], flat: int, elements: Elements, worlds: int
) -> tuple[Slots, wp.array, wp.array]:
    """Slots for the forces of all subtrees, or groups of these, and single leaves.

    Args:
        made: The plan's arrays, filled.
        subtrees, flat: Numbers of a world's subtrees of each class, and of its leaves outside subtrees.
        elements: The leaves, in all worlds.

    Returns:
        The slots; the places to which forces of subtrees are added, in the layout of ``made.batches.nodes``; and those
        of all leaves, vec4i [worlds * T].

    Raises:
        InputError: There are more slots than can be numbered.
    """
    device, plan, nodes = made.device, made.plan, made.batches.nodes
    used = 4 * flat
    for row, count in enumerate(subtrees):
        shape = made.kinds[row // plan.members][1]
        used += count // 8 * len(group_nodes(shape)) if made.is_grouped(row) else 10 * count
    total, node_count = len(nodes) + 4 * worlds * flat, worlds * plan.world_nodes
    check_slots(total)
    tables, targets = places_on(device.alias), kernels.Targets()
    targets.leaf_places, targets.group_leaf_places = tables.leaves, tables.group_leaves
    # The second half is room for sorting.
    targets.nodes = wp.full(2 * total, node_count, dtype=wp.int32, device=device)
    targets.of_subtrees, targets.of_leaves = wp.full_like(nodes, -1), wp.empty_like(elements.nodes)
    if any(subtrees):
        inputs = [threads_on(device), plan, made.batches]
        wp.launch(kernels.target_subtrees, (plan.classes, threads_on(device)), inputs, [targets], device=device)
    if flat:
        wp.launch(kernels.target_flat, worlds * flat, [len(nodes), plan, made.tree], [targets], device=device)
    slots = Slots.of_nodes(targets.nodes, worlds * used, node_count)
    return slots, targets.of_subtrees, targets.of_leaves


@dataclass(frozen=True)
class ForcePlan:
    """The ``Plan`` of a mesh that never changes.

    Attributes:
        find_units: A function that makes ``all_units`` for a forest with shared rotations.
    """

    elements: Elements
    batches: tuple[Batch, ...]
    flat: FlatLeaves
    units: Units | None = None
    slots: Slots | None = None
    find_units: Callable[[], Units] | None = None
    counts: None = None

    @cached_property
    def all_units(self) -> Units:
        assert self.find_units is not None
        return self.units or self.find_units()

    @property
    def kinds(self) -> list[tuple[int, bool, Sharing]]:
        return [(batch.shape, batch.grouped, batch.sharing) for batch in self.batches]

    @classmethod
    def leaf_by_leaf(
        cls, elements: Elements, slots: Slots | None = None, find_units: Callable[[], Units] | None = None
    ) -> ForcePlan:
        """The plan of a field that computes the elements of a mesh one by one."""
        none = wp.empty(0, dtype=wp.int32, device=elements.nodes.device)
        return cls(elements, (), FlatLeaves(none), slots=slots, find_units=find_units)

    @classmethod
    def of_forest(
        cls,
        forest: TetForest,
        rotation_level: int | None,
        device: wp.Device,
        *,
        worlds: int = 1,
        elements: Elements | None = None,
        grouped: bool | None = None,
        deterministic: bool = False,
    ) -> ForcePlan:
        """The plan of a forest.

        Args:
            rotation_level: Level of the tree at which rotations are shared; None: not shared.
            worlds: Number of copies of the body.
            elements: All leaves, if they are on the device already.
            grouped: Whether complete subtrees form groups where possible; None: only on CUDA.
            deterministic: Whether every unit of work has separate slots for its forces.

        Raises:
            InputError: There are more slots, or nodes of subtrees, than can be numbered.
        """
        if elements is None:
            elements = device_elements(forest, device, worlds)
        grouped = device.is_cuda if grouped is None else grouped
        made, counts = _counted(forest, elements, rotation_level, worlds, grouped=grouped)
        *subtrees, flat, units = counts
        find_units = None if rotation_level is None else partial(units_of, forest, elements, rotation_level, worlds)
        above = any(n for row, n in enumerate(subtrees) if made.kinds[row // made.plan.members][0] is Sharing.ABOVE)
        has_units = rotation_level is not None and (flat > 0 or above)
        _fill(made, counts, with_units=has_units)
        slots = of_subtrees = None
        if deterministic:
            slots, of_subtrees, of_leaves = slots_of(made, subtrees, flat, elements, worlds)
            elements = with_targets(elements, of_leaves)
        return cls(
            elements,
            tuple(made.batch(row, worlds * n, of_subtrees) for row, n in enumerate(subtrees) if n),
            made.flat(worlds * flat),
            made.units(worlds * units) if has_units else None,
            slots,
            find_units,
        )


def units_of(forest: TetForest, elements: Elements, rotation_level: int, worlds: int) -> Units:
    """The highest tetrahedra that are not above a level and whose corners are nodes, each once; in tree order.

    Args:
        elements: The forest's leaves, in all worlds.
    """
    made, counts = _counted(forest, elements, rotation_level, worlds, subtrees=False)
    _fill(made, counts, with_units=True, with_lists=False)
    return made.units(worlds * counts[-1])


def pays_in_groups(forest: TetForest, elements: Elements, worlds: int) -> bool:
    """Whether enough leaves are in groups to make launches of subtrees faster than one of single elements (CUDA)."""
    *subtrees, _, _ = _counted(forest, elements, None, worlds, grouped=True)[1]
    return worlds * 8 * sum(subtrees[::2]) >= GROUPED_LEAVES


def _counted(
    forest: TetForest,
    elements: Elements,
    rotation_level: int | None,
    worlds: int,
    *,
    subtrees: bool = True,
    grouped: bool = False,
) -> tuple[PlanArrays, list[int]]:
    """A plan's arrays, and a world's numbers of subtrees of each class, of leaves outside subtrees, and of units."""
    device, leaves = elements.nodes.device, cast("ForestElements", elements)
    tree, threads = tree_of(forest, leaves, rotation_level), min(threads_on(device), len(forest.tets))
    made = PlanArrays(tree, leaves, rotation_level, threads, subtrees=subtrees, grouped=grouped)
    plan = made.plan
    plan.worlds, plan.world_nodes, plan.world_leaves = worlds, len(forest.points), len(forest.tets)
    plan.marks = wp.empty(plan.world_leaves, dtype=wp.int8, device=device)
    plan.goes = wp.ones(1, dtype=wp.int32, device=device)
    made.find()
    return made, plan.counts.numpy()[:-1].tolist()


def _fill(made: PlanArrays, counts: Sequence[int], *, with_units: bool, with_lists: bool = True) -> None:
    """Write subtrees and leaves outside them, units, or both, in all worlds."""
    *subtrees, flat, units = counts
    plan, worlds = made.plan, made.plan.worlds
    plan.world_units = units
    room = [worlds * n for n in subtrees], worlds * flat, worlds * units * with_units, worlds * plan.world_leaves
    made.make(Room(*room))
    made.list()
    if with_units and worlds > 1:
        made.repeat_units()
    if with_lists and any(subtrees):
        made.fill_batches()
    if with_lists and flat:
        made.fill_flat()
