"""One pass over a changing forest: mark, refine, simplify, sort the leaves; or a cut: faces that a surface crosses,
and the nodes that come apart with them. The host reads nothing.

Also checks of the options of remeshing, whose messages have one form, NAME is VALUE; it must be …, with Python's names
(``cli.bodies`` puts the options' names in their place); and the decision when the stable step must be found again."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.discretization.sizes import allocated
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_number, shown
from warp_corot.kernels.plan.changing import begin_counts
from warp_corot.kernels.remesh import cut as cut_kernels
from warp_corot.kernels.remesh import derived as kernels
from warp_corot.kernels.remesh import pools as pool_kernels
from warp_corot.kernels.remesh import refine, simplify
from warp_corot.kernels.remesh import split as split_kernels
from warp_corot.kernels.remesh.criteria import PARAMETER_COUNTS, Contents, elongation, marking_kernel
from warp_corot.kernels.remesh.cut_surface import Surface
from warp_corot.mesh.lattice import MAX_LEVEL, check_levels, lattice_spacing


def checked_thresholds(refine_above: Any, simplify_below: Any) -> tuple[float, float]:
    """Both thresholds, in the criterion's unit.

    Raises:
        InputError: One of them is not a finite number, or the second is not below the first.
    """
    above, below = (
        _finite(given, name) for name, given in (("refine_above", refine_above), ("simplify_below", simplify_below))
    )
    if below >= above:
        raise InputError(
            f"simplify_below is {below:g}; it must be below refine_above, which is {above:g}, "
            "or an element could be refined and simplified at once"
        )
    return above, below


def checked_capacity(capacity: int, count: int) -> int:
    """The largest number of elements, for a mesh that begins with ``count``.

    Raises:
        InputError: Fewer than that.
    """
    if capacity < count:
        raise InputError(f"capacity is {capacity}; it must be at least {count}, as many elements as the mesh has")
    return capacity


def checked_criterion(criterion: Any) -> Any:
    """A criterion: a Warp function of an ``ElementState`` and an array of numbers.

    Raises:
        InputError: It is something else, or takes another number of arguments.
    """
    if not isinstance(criterion, wp.Function) or criterion.func is None:
        raise InputError(f"criterion is {shown(criterion)}; it must be a Warp function (@wp.func) of an ElementState")
    count = len(inspect.signature(criterion.func).parameters)
    if count != 2:
        raise InputError(
            f"criterion is {criterion.func.__name__!r}, which takes {count} arguments; "
            "it must take two, an ElementState and an array of float32"
        )
    return criterion


def checked_parameters(parameters: Any, criterion: Any) -> wp.array | None:
    """The numbers that a criterion reads, float32 [n], or None.

    Args:
        parameters: The numbers.
        criterion: The criterion; the length is checked for the package's own criteria.

    Raises:
        InputError: They are something else, or too few.
    """
    is_array = isinstance(parameters, wp.array) and parameters.dtype == wp.float32 and parameters.ndim == 1
    if parameters is not None and not (is_array and len(parameters) > 0):
        raise InputError(f"parameters is {shown(parameters)}; it must be a Warp array of float32, [n], not empty")
    given, needed = 0 if parameters is None else len(parameters), PARAMETER_COUNTS.get(criterion, 0)
    if given < needed:
        name = criterion.func.__name__
        raise InputError(f"parameters has {given} numbers; it must have {needed}, which the criterion {name!r} reads")
    return parameters


def _finite(given: Any, name: str) -> float:
    number = checked_number(given, name)
    if not math.isfinite(number):
        raise InputError(f"{name} is {number:g}; it must be a finite number")
    return number


class _Launches:
    """Launches over a forest's pools."""

    def __init__(self, forest: DeviceForest):
        self.forest, self.device = forest, forest.device

    def _once(self, kernel: wp.Kernel, *arguments: Any) -> None:
        wp.launch(kernel, dim=1, inputs=list(arguments), device=self.device)

    def _many(self, kernel: wp.Kernel, *arguments: Any) -> None:
        """Launch a kernel in which each thread loops over a stretch of the items."""
        threads = self.forest.threads
        wp.launch(kernel, dim=threads, inputs=[threads, *arguments], device=self.device)


class RemeshPass(_Launches):
    """A criterion and two thresholds, turned into launches that can be recorded.

    A leaf is bisected if the criterion is above one threshold, and merged with its sibling if it is below the other.
    Between the two it stays. A pass bisects a leaf once; conformity may bisect larger neighbours too.

    Args:
        forest: The forest to change.
        criterion: A Warp function of a ``kernels.remesh.criteria.ElementState`` and an array of numbers; the elongation
            of the longest edge, deformed over rest, if none is given.
        refine_above, simplify_below: Thresholds, in the criterion's unit; the first is the larger one.
        min_level, max_level: Leaves of these levels are not simplified and not refined. Without a ``min_level``, the
            mesh is nowhere coarser than it was at the beginning.
        parameters: Numbers for the criterion, float32 [n] on the device, which may change between passes.
        lame: Lamé's parameters for the criterion [Pa], or the names under which elements carry them.

    Attributes:
        contents: The material of leaves, ``kernels.remesh.criteria.Contents``.

    Raises:
        InputError: The thresholds contradict each other, or the levels are out of order or beyond the lattice's depth.
    """

    def __init__(
        self,
        forest: DeviceForest,
        *,
        criterion: Any = elongation,
        refine_above: float = 1.25,
        simplify_below: float = 1.08,
        min_level: int | None = 0,
        max_level: int = MAX_LEVEL,
        parameters: wp.array | None = None,
        lame: tuple[float, float] | tuple[str, str] = (0.0, 0.0),
    ):
        self.thresholds = checked_thresholds(refine_above, simplify_below)
        check_levels(min_level, max_level)
        super().__init__(forest)
        self.levels = (int(min_level or 0), int(max_level))
        self._kept = forest.pools.roots if min_level is not None else forest.begun_with
        self.parameters = wp.zeros(1, dtype=wp.float32, device=self.device) if parameters is None else parameters
        self._mark = marking_kernel(checked_criterion(criterion))
        self._origin = wp.vec3d(*forest.source.origin)
        self._spacing = lattice_spacing(forest.source.cell_size)
        self.contents = self._make_contents(lame)
        nodes, device = forest.node_capacity, self.device
        size = 1 << (2 * (nodes + forest.threads)).bit_length()
        of_edges = [(size, "keys born ring agreed pairs head node wanted")]
        begin = {"keys": -1, "born": int(refine.NEVER), "head": -1, "node": -1}
        self._edges = allocated(refine.WantedEdges, device, of_edges, **begin)
        # Threads that add an edge at the same time may exceed the limit, but never fill the table.
        self._edges.most = size // 2
        self._removal = allocated(simplify.Removal, device, [(nodes, "willing head candidates")], head=-1)
        self._moves = allocated(simplify.Moves, device, [(nodes, "holes movers forward"), (2, "counts")])
        self._demand = wp.zeros(1, dtype=wp.int64, device=self.device)
        self._goes_on = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._sums, self._ends = (wp.zeros(forest.threads, dtype=wp.int32, device=self.device) for _ in range(2))

    def launch(self, *, marked: bool = False, goes_on: bool = False) -> None:
        """Launch a pass, or record it within the caller's capture.

        Args:
            marked: Whether the marks exist already.
            goes_on: Whether this pass and the last one count as one; neither may remove nodes.
        """
        forest = self.forest
        pools, carried, edges = forest.pools, forest.carriage.arrays, self._edges
        removal, moves = self._removal, self._moves
        self._once(pool_kernels.begin_pass, int(goes_on), pools)
        if not marked:
            refine_above, simplify_below = self.thresholds
            inputs = [refine_above, simplify_below, self._origin, self._spacing, carried.u, self.parameters]
            self._many(self._mark, *inputs, self.contents, pools)
        self._many(refine.want_marked, self.levels[1], pools, edges)
        self._once(refine.next_round, pools, self._demand, self._goes_on)
        wp.capture_while(self._goes_on, self._launch_round)
        self._many(simplify.offer_nodes, self.levels[0], self._kept, carried, pools, removal)
        self._many(simplify.remove_nodes, pools, carried, removal)
        self._many(pool_kernels.settle_ends, pools, carried)
        self._many(simplify.list_moves, pools, moves)
        self._many(simplify.move_nodes, pools, carried, moves)
        self._many(simplify.rename_nodes, moves, pools)
        self._many(pool_kernels.refresh_masses, pools, carried)
        self._many(simplify.count_leaves, pools, self._sums)
        wp.utils.array_scan(self._sums, self._ends, inclusive=True)
        self._many(simplify.list_leaves, self._sums, self._ends, pools)
        self._many(simplify.adopt_list, pools)
        self._many(refine.end_pass, pools, edges, moves.counts)

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _launch_round(self) -> None:
        pools, edges, carried = self.forest.pools, self._edges, self.forest.carriage.arrays
        self._many(refine.visit_leaves, pools, edges)
        self._many(refine.visit_fresh, pools, edges)
        self._many(refine.admit_edges, pools, edges, self._demand)
        self._many(refine.bisect_edges, pools, edges, carried)
        self._once(refine.next_round, pools, self._demand, self._goes_on)

    def _make_contents(self, lame: tuple[float, float] | tuple[str, str]) -> Contents:
        names = self.forest.carriage.names

        def column(name: float | str) -> int:
            return names.index(name) if name in names else -1

        contents = Contents()
        contents.values = self.forest.carriage.arrays.values
        contents.mu_column, contents.lam_column = column(lame[0]), column(lame[1])
        contents.mu, contents.lam = (0.0 if isinstance(value, str) else float(value) for value in lame)
        contents.fill_column = column("fill")
        return contents


#: Up to this many leaves there is room for all of them in one cut; of more, for a quarter.
ALL_LEAVES = 1 << 18


class CutPass(_Launches):
    """Launches that cut a forest along a surface. No array of the whole body goes to the host.

    Args:
        forest: The forest to cut.
        toughness: Energy of a cut [J/m^2], unless leaves carry "toughness".
    """

    def __init__(self, forest: DeviceForest, toughness: float = 0.0):
        super().__init__(forest)
        capacity, nodes = forest.capacity, forest.node_capacity
        room = max(capacity // 4, min(capacity, ALL_LEAVES))
        # Two leaves share a face; half of the table stays empty.
        table = 1 << (8 * room).bit_length()
        sizes = [(room, "stars fresh"), (4 * room, "slot other link copy pull"), (table, "keys owner")]
        sizes += [(nodes, "mark marked keeper former_mass"), (cut_kernels.COUNTS, "counts")]
        absent = dict.fromkeys(("slot", "other", "link", "copy", "keys", "owner"), -1)
        cuts = self._cuts = allocated(cut_kernels.Cuts, self.device, sizes, **absent)
        cuts.room = room
        names = forest.carriage.names
        cuts.toughness, cuts.toughness_column = toughness, names.index("toughness") if "toughness" in names else -1
        cuts.names = forest.pools.tets.view(wp.int32)

    def launch_cut(self, surface: Surface, *, goes_on: bool = False) -> None:
        """Launch a cut: which faces the surface crosses, and the separation of their nodes.

        Args:
            surface: A plane or triangles.
            goes_on: Whether it belongs to a pass that was just launched: then its counts are added to that pass's.
        """
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._once(cut_kernels.begin_cut, int(goes_on), pools, cuts)
        self._many(cut_kernels.list_near, surface, carried, pools, cuts)
        self._many(cut_kernels.cross_faces, surface, carried, pools, cuts)
        self._launch_end(surface)

    def launch_tear(self, stress: float, contents: Contents) -> None:
        """Launch a tear: the separation of faces across which the stress [Pa] is larger.

        Args:
            stress: The bound.
            contents: The material of leaves.
        """
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        surface = Surface()
        surface.stress = stress
        self._once(cut_kernels.begin_cut, 0, pools, cuts)
        self._many(cut_kernels.list_near, surface, carried, pools, cuts)
        self._many(cut_kernels.pull_faces, contents, carried, pools, cuts)
        self._many(cut_kernels.choose_faces, surface, pools, cuts)
        self._many(cut_kernels.tear_faces, pools, cuts)
        self._launch_end(surface)

    def launch_marks(self, surface: Surface) -> None:
        """Launch the marks of leaves at triangles that are to be refined to their levels."""
        self._many(cut_kernels.mark_near, surface, self.forest.carriage.arrays, self.forest.pools)

    def launch_after_pass(self) -> None:
        """Launch the separation of nodes that a pass has made on cut faces; may be recorded with the pass."""
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._once(cut_kernels.begin_cut, 1, pools, cuts)
        self._many(cut_kernels.mark_bisected, carried, pools, cuts)
        self._launch_split()

    @property
    def faces(self) -> int:
        """The number of faces that the last cut has separated."""
        return int(self._cuts.counts.numpy()[cut_kernels.FACES])

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _launch_end(self, surface: Surface) -> None:
        """Launch what follows when faces have been cut."""
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._many(cut_kernels.join_lone, pools, cuts)
        self._many(cut_kernels.count_faces, surface, carried, pools, cuts)
        self._launch_split()

    def _launch_split(self) -> None:
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        cuts.counts[: int(cut_kernels.STARS) + 1].zero_()
        self._many(split_kernels.list_stars, pools, cuts)
        self._many(split_kernels.unite_corners, pools, cuts)
        self._many(split_kernels.choose_keepers, pools, cuts)
        self._many(split_kernels.copy_nodes, pools, carried, cuts)
        self._many(split_kernels.rename_corners, pools, carried, cuts)
        self._many(split_kernels.settle_nodes, pools, carried, cuts)
        self._many(split_kernels.rename_ancestors, pools, cuts)
        self._many(split_kernels.tear_ancestors, pools, cuts)
        self._once(split_kernels.end_cut, pools, cuts)


def plane_surface(normal: npt.ArrayLike, offset: float, *, is_deformed: bool) -> Surface:
    """A plane of the points x with normal . x = offset [m]; normal of unit length."""
    surface = Surface()
    surface.is_deformed = float(is_deformed)
    surface.normal, surface.offset = wp.vec3d(*np.asarray(normal, dtype=float)), float(offset)
    return surface


#: A longer step is searched for only after the stiffest element has been softer for this many passes.
PATIENCE = 10
#: Growth of the number of finest elements, and number of passes with changes, after which the step is always found
#: again. An element among equal ones vibrates up to 1.5 times as fast as one among larger ones.
GROWTH = 1.5
MOST_CHANGES = 50
#: Stiffnesses with a smaller relative difference count as equal.
ALIKE = 1e-3
#: What a survey of the leaves finds.
SURVEY_PLACES = 1 + (MAX_LEVEL + 1) * int(kernels.PARTIAL_SUMS)


@dataclass
class Findings:
    """The mesh when its step was found last, and the passes since then.

    Attributes:
        stiffness: Of the stiffest element, (2 mu + lambda) / (density volume^(2/3)) [1/s^2].
        finest: Number of elements of the finest level.
        softer_for: Passes in which the stiffest element was softer.
        changes: Passes that changed something.
    """

    stiffness: float = 0.0
    finest: int = 0
    softer_for: int = 0
    changes: int = 0


class Survey:
    """Measures the elements after each pass.

    Args:
        forest: The pools.
        modulus: 2 mu + lambda [Pa], if all elements have the same; else elements carry "mu" and "lam".

    Attributes:
        found: The launches' results, int32, for ``read``.
        last: The mesh when its step was found last.
        finest_level: The finest level of the present mesh.
        stiffness: Of its stiffest element; see ``Findings``.
    """

    def __init__(self, forest: DeviceForest, modulus: float):
        self._forest = forest
        self._modulus = modulus
        self.found = wp.zeros(SURVEY_PLACES, dtype=wp.int32, device=forest.device)
        self.last = Findings()
        self.finest_level = 0
        self.stiffness, self._finest = 0.0, 0

    def launch(self, goes: wp.array) -> None:
        """Launch the measurement of the elements if ``goes`` [1] is not zero; may be recorded."""
        forest = self._forest
        device, threads = forest.device, forest.threads
        wp.launch(begin_counts, dim=SURVEY_PLACES, inputs=[goes], outputs=[self.found], device=device)
        inputs = [threads, goes, self._modulus, forest.pools, forest.carriage.arrays]
        wp.launch(kernels.survey_leaves, dim=threads, inputs=inputs, outputs=[self.found], device=device)

    def read(self, found: npt.NDArray[np.int32]) -> None:
        """Take a copy of ``found`` of a mesh that has changed."""
        self.stiffness = float(found[: int(kernels.STIFFEST) + 1].view(np.float32)[-1])
        of_levels = found[1:].reshape(-1, int(kernels.PARTIAL_SUMS)).sum(axis=1)
        self.finest_level = int(np.flatnonzero(of_levels).max(initial=0))
        self._finest = int(of_levels[self.finest_level])
        self.last.changes += 1

    def step_may_change(self) -> bool:
        """Whether the stable step must be found again; call it once a pass."""
        last = self.last
        softer = self.stiffness < (1.0 - ALIKE) * last.stiffness
        last.softer_for = last.softer_for + 1 if softer else 0
        stiffer = self.stiffness > (1.0 + ALIKE) * last.stiffness
        grown = not softer and self._finest > GROWTH * last.finest
        if not (stiffer or grown or last.softer_for > PATIENCE or last.changes > MOST_CHANGES):
            return False
        self.settle()
        return True

    def settle(self) -> None:
        """Record that the step has been found for the present mesh."""
        self.last = Findings(self.stiffness, self._finest)
