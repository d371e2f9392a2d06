"""The choice of elements to bisect, by a body's surface, thickness and labels, and the user's functions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing import elements as kernels
from warp_corot.kernels.tables.shapes import CIRCUMRADIUS, EDGE_LENGTHS
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_LEVEL, lattice_spacing
from warp_corot.mesh.tree import LIVE

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.mesh.growing.growth import Growth

#: A user's function of points [n, 3] -> [n].
Field = Callable[[np.ndarray], np.ndarray]

#: The assumed error of an element where the body is thinner than its layers, as a fraction of its edge; and the number
#: of elements that must fit between pieces of the body so that these stay separate.
THIN_NEED, GAP_ELEMENTS = 0.4, 2.0
#: The need [m] of elements that are sampled finely only for thickness; it counts when the mesh is chosen.
LOOKED = 1.0e-12
#: Thickness is searched up to this multiple of the value it is compared with, because larger ones are cut off there.
FARTHER = 1.01
#: Elements with an error below this fraction of their edge need no finer sampling.
ROUGH = 0.03
#: The assumed error of an element with two labels, as a fraction of its edge.
LABEL_NEED = 0.05


@dataclass(frozen=True)
class Wishes:
    """The required fineness of a mesh.

    Attributes:
        surface_error: The largest distance of its surface from the domain's [m].
        min_level, max_level: The range of levels.
        refine_where: Function of points [n, 3] -> bool [n]: elements that have such a point are bisected.
        field: Function of points [n, 3] -> numbers [n]: elements in which it varies are bisected ...
        field_tolerance: ... by more than this.
        layers: Elements at the surface are bisected to level ``thin_level`` where the body is thinner than this many of
            them, or where its pieces are closer to each other.
    """

    surface_error: float
    min_level: int
    max_level: int
    refine_where: Field | None = None
    field: Field | None = None
    field_tolerance: float = 0.0
    layers: float = 0.0
    thin_level: int = 0


class Judge:
    """Evaluates new elements of a forest: which are outside, how large the others' errors are, and which must be
    bisected.

    Attributes:
        tolerances: The allowed error of each level [m], float32.
        closest: The values to which the tolerances may be lowered later [m], float32.
        max_level: The level below which nothing is bisected.
        limited: Whether the number of elements is limited, so that only errors above the tolerances count.
        closer: Whether the body is sampled more finely than the mesh follows it.
        thin_tolerance: Thin parts need no more bisection once their elements are off by less than this [m].
    """

    def __init__(self, domain: Domain, growth: Growth, cells: Any, origin: Any, cell_size: float, wishes: Wishes):
        self.domain, self.growth, self.wishes, self.device = domain, growth, wishes, growth.device
        self.top = wp.vec3i(*(n << LATTICE_BITS for n in cells))
        level = np.arange(MAX_LEVEL + 1)
        h = cell_size * 0.5 ** (level // 3)
        forest = self._forest = growth.forest
        forest.origin, forest.spacing = wp.vec3d(*origin), lattice_spacing(cell_size)
        forest.lipschitz = float(domain.lipschitz)
        forest.circumradius = self._on_device(h * np.array(CIRCUMRADIUS)[level % 3])
        forest.edges = self._on_device(h[:, None] * np.array(EDGE_LENGTHS)[level % 3])
        #: The uncertainty of a value from float32 coordinates.
        reach = float(np.abs(np.asarray(origin)).max() + max(cells) * cell_size)
        self.noise = float(domain.lipschitz) * reach * 2.0**-22
        self.evaluated = 0
        self.tolerances = np.full(MAX_LEVEL + 1, wishes.surface_error, np.float32)
        self.closest = self.tolerances
        self.lengths = h
        self.max_level = wishes.max_level
        self.limited = self.closer = False
        self.thin_tolerance = 0.0

    def evaluate(self) -> None:
        """Evaluate the function at new nodes."""
        growth, first = self.growth, self.evaluated
        count = growth.node_count - first
        if not count:
            return
        growth.make_room(growth.node_count, "phi")
        points = wp.empty(count, dtype=wp.vec3, device=self.device)
        growth.launch(kernels.node_points, count, first, self._forest, points)
        growth.launch(kernels.take_values, count, self.domain.phi(points), first, self.top, self.noise, self._forest)
        self.evaluated = growth.node_count

    def wished(self, first: int) -> wp.array:
        """Find out which elements from ``first`` on are outside, and which must be bisected."""
        growth, wishes = self.growth, self.wishes
        self.evaluate()
        growth.make_room(growth.element_count, "need")
        count = growth.element_count - first
        states = wp.empty(count, dtype=wp.int32, device=self.device)
        levels = wishes.min_level, self.max_level
        growth.launch(kernels.judge_by_corners, count, first, *levels, self._forest, states)
        self._judge_all(first, states)
        if not self.limited:
            self._forest.wished[first : growth.element_count].assign(states.numpy() == int(kernels.SPLIT))
        return self.of_state(states, kernels.SPLIT, first)

    def off(self) -> wp.array:
        """Leaves whose errors exceed the present tolerances."""
        level, leaf, need = self._now("level"), self._now("first_child"), self.needs()
        found = np.flatnonzero((leaf == LIVE) & (level < self.max_level) & (need > self.tolerances[level]))
        return wp.array(found, dtype=wp.int32, device=self.device)

    def unresolved(self, levels: int, error: float) -> wp.array:
        """Begin to sample more finely, by this many levels; return the leaves of the present deepest level that must be
        bisected.

        Args:
            levels: The number of levels.
            error: The smallest tolerance of the surface there, as a fraction of an element's edge.
        """
        before = self.max_level
        self.limited = self.closer = True
        self.max_level = min(before + levels, MAX_LEVEL)
        self.tolerances = np.maximum(self.tolerances, error * self.lengths).astype(np.float32)
        self.closest = self.tolerances
        level, parent = self._now("level"), self._now("parent")
        size = self._forest.circumradius.numpy()[level]
        rough = (parent < 0) | (self.needs()[parent] > np.float32(ROUGH) * size)
        chosen = np.flatnonzero((self._now("first_child") == LIVE) & (level >= before) & rough)
        highest = self._forest.phi.numpy()[self._now("tets")[chosen]].max(axis=1)
        states = np.full(len(level), kernels.LEFT, np.int32)
        states[chosen[highest >= np.float32(-self.domain.lipschitz) * size[chosen]]] = kernels.OPEN
        on_device = wp.array(states, dtype=wp.int32, device=self.device)
        self._judge_all(0, on_device)
        return self.of_state(on_device, kernels.SPLIT, 0)

    def holding(self) -> int:
        """Number of leaves with a corner inside."""
        tets = self._now("tets")[self._now("first_child") == LIVE]
        return int(np.count_nonzero((self._forest.phi.numpy()[tets] < 0).any(axis=1)))

    def of_state(self, states: wp.array, state: int, first: int) -> wp.array:
        """The elements, counted from ``first``, that have a state."""
        found = np.flatnonzero(states.numpy() == int(state)) + first
        return wp.array(found, dtype=wp.int32, device=self.device)

    def needs(self) -> np.ndarray:
        """The error of each element if it were not bisected [m], float32."""
        return self._now("need")

    def _now(self, name: str, first: int = 0) -> np.ndarray:
        """What elements from ``first`` on have in an array of the forest."""
        return getattr(self._forest, name)[first : self.growth.element_count].numpy()

    def _raise_needs(self, elements: np.ndarray, least: np.ndarray) -> None:
        """Let elements have at least these needs."""
        needs = self._forest.need.numpy()
        needs[elements] = np.maximum(needs[elements], least)
        self._forest.need.assign(needs)

    def _judge_all(self, first: int, states: wp.array) -> None:
        self.judge_surface(first, states)
        self.judge_thickness(first, states)
        self.judge_fields(first, states)

    def judge_surface(self, first: int, states: wp.array) -> None:
        """For elements that corners do not decide: compare with the linear interpolant at midpoints, then at one more
        point.
        """
        growth, forest = self.growth, self._forest
        forest.tolerances, forest.closest = self._on_device(self.tolerances), self._on_device(self.closest)
        elements = self.of_state(states, kernels.OPEN, first)
        count = len(elements)
        if not count:
            return
        slots = growth.insert_edges(elements, of_refinement=False)
        self.evaluate()
        unsure = wp.empty(count, dtype=wp.int32, device=self.device)
        probes = wp.empty(count, dtype=wp.vec3, device=self.device)
        expected, deviations = (wp.empty(count, dtype=wp.float32, device=self.device) for _ in range(2))
        outputs = [states, unsure, probes, expected, deviations]
        launch_side_by_side(
            kernels.judge_by_edges,
            count,
            lambda own: ([-own(0), elements, first, slots, forest], outputs),
            self.device,
        )
        chosen = growth.flagged(unsure)
        if len(chosen):
            found = self.domain.phi(probes[chosen].contiguous())
            inputs = [chosen, elements, first, found, expected, deviations, forest, states]
            growth.launch(kernels.judge_by_probes, len(chosen), *inputs)

    def judge_thickness(self, first: int, states: wp.array) -> None:
        """Mark elements where the body, or a gap between its pieces, is thinner than a few elements."""
        wishes, domain = self.wishes, self.domain
        if not wishes.layers or not len(states):
            return
        # Without a limit on their number, elements are not finer than the rest for this reason.
        state, chosen, level, tets = self._undecided(first, states, wishes.thin_level if self.closer else None)
        # Thickness is accurate at the surface; gaps are only estimated, so any ray will do.
        known = self._now("need", first)[chosen] <= self.closest[level]
        phi = self._forest.phi.numpy()[tets]
        crossed = (phi < 0).any(axis=1) & (phi >= 0).any(axis=1)
        crossed &= known | domain.has_pieces
        chosen, level, tets, phi, known = (each[crossed] for each in (chosen, level, tets, phi, known))
        if not len(chosen):
            return
        x, inward = surface_points(self._places(tets), phi)
        # By volume: a cube's edge halves in three levels.
        length = self.lengths[0] * 0.5 ** (level / 3.0)
        reach = FARTHER * wishes.layers * float(length.max())
        thin = known & (wishes.layers * length > domain.thickness(x, inward, reach))
        thin &= THIN_NEED * length > self.thin_tolerance
        need = np.where(thin, THIN_NEED * length, 0.0)
        limits = np.maximum(self.tolerances[level], self.thin_tolerance) if self.limited else 0.0
        wanted = THIN_NEED * length > limits
        split = thin & wanted
        if domain.has_pieces:
            # Whether this is a gap between pieces is known later; then its need counts.
            reach = FARTHER * GAP_ELEMENTS * float(length.max())
            near = GAP_ELEMENTS * length > domain.thickness(x, inward, reach, outside=True)
            need = np.where(near, np.maximum(need, LOOKED), need)
            split |= near & (wanted | (not self.closer))
        state[chosen[split]] = kernels.SPLIT
        states.assign(state)
        self._raise_needs(first + chosen, need)

    def judge_fields(self, first: int, states: wp.array) -> None:
        """Mark elements by labels and the user's fields, evaluated at corners and centroids."""
        wishes, domain = self.wishes, self.domain
        if not (domain.label_names or wishes.refine_where is not None or wishes.field is not None):
            return
        state, chosen, level, tets = self._undecided(first, states)
        if not len(chosen):
            return
        nodes, corners = np.unique(tets, return_inverse=True)
        corners = corners.reshape(-1, 4)
        at_nodes = self._places(nodes)
        at_middle = at_nodes[corners].mean(axis=1)

        def sampled(function: Callable[[np.ndarray], Any]) -> np.ndarray:
            return np.column_stack([_checked(function, at_nodes)[corners], _checked(function, at_middle)])

        must = np.zeros(len(chosen), bool)
        if wishes.refine_where is not None:
            must |= sampled(wishes.refine_where).astype(bool).any(axis=1)
        if wishes.field is not None:
            must |= np.ptp(sampled(wishes.field).astype(float), axis=1) > wishes.field_tolerance
        need = np.where(must, kernels.MUST, 0.0).astype(np.float32)
        if domain.label_names:
            mixed = np.ptp(sampled(lambda x: domain.labels_at(x, nearest=True)), axis=1) > 0
            need[mixed] = np.maximum(need[mixed], LABEL_NEED * self.lengths[level[mixed]])
        split = need > (self.tolerances[level] if self.limited else 0.0)
        self._raise_needs(first + chosen, need)
        state[chosen[split]] = kernels.SPLIT
        states.assign(state)

    def _undecided(
        self, first: int, states: wp.array, deepest: int | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """The states of elements from ``first`` on, the places of those leaves among them that are not bisected yet and
        may be, down to a level, and the levels and nodes of these."""
        state, level = states.numpy(), self._now("level", first)
        may = level < (self.wishes.max_level if deepest is None else deepest)
        chosen = np.flatnonzero((state == kernels.DONE) & (self._now("first_child", first) == LIVE) & may)
        return state, chosen, level[chosen], self._now("tets", first)[chosen]

    def _places(self, nodes: np.ndarray) -> np.ndarray:
        """The places of lattice points [m], float64 [..., 3]."""
        return np.asarray(self._forest.origin) + self._forest.lattice.numpy()[nodes] * self._forest.spacing

    def _on_device(self, numbers: np.ndarray) -> wp.array:
        return wp.array(numbers, dtype=wp.float32, device=self.device)


def surface_points(corners: np.ndarray, phi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A point where the linear interpolant is zero, or nearly, in elements, and the unit vector inwards there, float64
    [n, 3].

    The search goes from the middle along the gradient, but no farther than the longest edge at the first corner.

    Args:
        corners: Of the elements [m], [n, 4, 3].
        phi: Values there [n, 4].
    """
    values = phi.astype(np.float64)
    edges = corners[:, 1:] - corners[:, :1]
    gradient = np.linalg.solve(edges, (values[:, 1:] - values[:, :1])[..., None])[..., 0]
    slope, longest = np.linalg.norm(gradient, axis=1), np.linalg.norm(edges, axis=2).max(axis=1)
    along = -gradient / np.maximum(slope, 1e-30)[:, None]
    step = np.divide(values.mean(axis=1), slope, out=np.zeros(len(slope)), where=slope > 0.0)
    step = np.clip(step, -longest, longest)[:, None]
    return corners.mean(axis=1) + step * along, along


def _checked(function: Callable[[np.ndarray], Any], points: np.ndarray) -> np.ndarray:
    found = np.asarray(function(points))
    if found.dtype.kind not in "biuf":
        raise InputError(f"a field gave {found.dtype} for {len(points)} points; it must give numbers [{len(points)}]")
    if found.shape != (len(points),):
        raise InputError(f"a field gave the shape {found.shape} for {len(points)} points; it must give [{len(points)}]")
    if not np.isfinite(found).all():
        bad = int(np.flatnonzero(~np.isfinite(found))[0])
        raise InputError(f"a field is {found[bad]} at {points[bad].tolist()}; it must be finite")
    return found
