"""From a domain to the forest that follows its surface: bisect where it is not flat enough, until nothing hangs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.meshing import elements as kernels
from warp_corot.kernels.tables.shapes import CIRCUMRADIUS, EDGE_LENGTHS
from warp_corot.mesh.bisection import path_tetrahedra
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_CELLS, MAX_LEVEL
from warp_corot.mesh.tree import LIVE, Tree

from .growth import Growth, lattice_spacing, with_room

if TYPE_CHECKING:
    from warp_corot.domain import Domain
    from warp_corot.mesh.forest import Field

#: What an element counts as being off by where the body is thinner than its layers, as a share of its edge, and so many
#: elements have room between pieces of the body that are not to grow together.
THIN_NEED, GAP_ELEMENTS = 0.4, 2.0
#: The need [m] of what is looked at closely for its thickness alone, which counts when the mesh is chosen.
LOOKED = 1.0e-12
#: What an element that holds two labels counts as being off by, as a share of its edge.
LABEL_NEED = 0.05


@dataclass(frozen=True)
class Wishes:
    """How fine a mesh is to be.

    Attributes:
        surface_error: How far its surface may be from the domain's [m].
        min_level, max_level: Between which levels.
        refine_where: Function of points [n, 3] -> bool [n]: elements that have such a point are bisected.
        field: Function of points [n, 3] -> numbers [n]: elements in which it varies are bisected ...
        field_tolerance: ... by more than this.
        layers: Elements at the surface are bisected to level ``thin_level`` where the body is thinner than so many of
            them, and where pieces of it are nearer to one another.
    """

    surface_error: float
    min_level: int
    max_level: int
    refine_where: Field | None = None
    field: Field | None = None
    field_tolerance: float = 0.0
    layers: float = 0.0
    thin_level: int = 0


@dataclass(frozen=True)
class Closer:
    """How much closer a body is looked at than its mesh is to follow it.

    Attributes:
        levels: To how many levels below the mesh's deepest.
        error: How far the surface may be from the domain's then, as a share of an element's edge there.
        most_elements: About so many tetrahedra, of all levels, are enough: the neediest of a level are bisected then.
    """

    levels: int
    error: float
    most_elements: int


@dataclass(frozen=True)
class Grown:
    """A forest as it was grown: all lattice points that were looked at, and what was found there.

    Attributes:
        cells, origin: The grid.
        lattice, ends, phi: Of the lattice points.
        tree: Of all that was bisected.
        need: How far off an element's piece of the surface would be, were it not bisected [m], float32 [M].
        wished: The mesh in it, as the first child of each tetrahedron there was before the body was looked at more
            closely, int32 [m]; it is all of the tree where it was not.
        growth: On the device.
    """

    cells: tuple[int, int, int]
    origin: tuple[float, float, float]
    lattice: np.ndarray
    ends: np.ndarray
    tree: Tree
    phi: np.ndarray
    need: np.ndarray
    wished: np.ndarray
    growth: Growth


def grid_around(bounds: np.ndarray, cell_size: float) -> tuple[tuple[int, int, int], tuple[float, float, float]]:
    """Root cubes along each axis and the lower corner of the grid that holds a box, the box in its middle."""
    bounds = np.asarray(bounds, dtype=float)
    cells = np.maximum(np.ceil((bounds[1] - bounds[0]) / cell_size - 1e-6), 1.0)
    if cells.max() > MAX_CELLS or cells.prod() * 6 > 2**27:
        raise InputError(
            f"cell_size is {cell_size:g} m: that is {' x '.join(f'{c:.0f}' for c in cells)} root cubes; "
            "make it larger and max_level higher"
        )
    x, y, z = (float(c) for c in bounds.mean(axis=0) - 0.5 * cells * cell_size)
    a, b, c = (int(n) for n in cells)
    return (a, b, c), (x, y, z)


def grow(domain: Domain, cell_size: float, wishes: Wishes, device: wp.Device, closer: Closer | None = None) -> Grown:
    """Bisect the grid around a domain as wished, and as conformity asks for; then, if asked, look at it closely."""
    cells, origin = grid_around(domain.bounds, cell_size)
    adaptation = _Adaptation(domain, cells, origin, cell_size, wishes, device)
    growth = adaptation.growth
    adaptation.run()
    wished = growth.first_child[: growth.element_count].numpy().copy()
    if closer is not None:
        adaptation.look_closer(closer)
    lattice, ends = growth.nodes()
    phi, need = adaptation.phi[: growth.node_count].numpy(), adaptation.need[: growth.element_count].numpy()
    return Grown(cells, origin, lattice, ends, growth.tree(), phi, need, wished, growth)


class _Adaptation:
    """A forest that grows after a domain."""

    def __init__(self, domain: Domain, cells: Any, origin: Any, cell_size: float, wishes: Wishes, device: wp.Device):
        self.domain = domain
        self.wishes = wishes
        self.device = device
        points = tuple(n + 1 for n in cells)
        lattice = np.indices(points, dtype=np.int32).reshape(3, -1).T << LATTICE_BITS
        tets = path_tetrahedra(cells, points)
        roots = len(tets)
        leaf = np.full(roots, LIVE, np.int32)
        tree = Tree(tets, np.zeros(roots, np.int32), np.full(roots, -1, np.int32), leaf)
        self.growth = Growth(lattice, np.full((len(lattice), 2), -1, np.int32), tree, device)
        self.top = wp.vec3i(*(n << LATTICE_BITS for n in cells))
        self.origin = wp.vec3d(*origin)
        self.spacing = lattice_spacing(cell_size)
        level = np.arange(MAX_LEVEL + 1)
        h = cell_size * 0.5 ** (level // 3)
        self.circumradius = wp.array(h * np.array(CIRCUMRADIUS)[level % 3], dtype=wp.float32, device=device)
        self.edges = wp.array(h[:, None] * np.array(EDGE_LENGTHS)[level % 3], dtype=wp.float32, device=device)
        #: What float32 coordinates leave open of a value.
        reach = float(np.abs(np.asarray(origin)).max() + max(cells) * cell_size)
        self.noise = float(domain.lipschitz) * reach * 2.0**-22
        self.phi = wp.empty(0, dtype=wp.float32, device=device)
        self.evaluated = 0
        #: How far off each element would be, and may be at each level [m].
        self.need = wp.empty(0, dtype=wp.float32, device=device)
        self.tolerances = np.full(MAX_LEVEL + 1, wishes.surface_error, np.float32)
        self.lengths = h
        self.max_level = wishes.max_level
        self.most_elements: int | None = None

    def run(self, first: int = 0) -> None:
        # First from the top down, each level from the one above alone, then what conformity asks for.
        growth = self.growth
        while first < growth.element_count:
            wished = self.chosen(self.of_state(self.judge(first), kernels.SPLIT, first))
            first = growth.element_count
            if len(wished):
                growth.bisect(wished)
        growth.close(self.judge)
        self.evaluate()

    def look_closer(self, closer: Closer) -> None:
        """Go on where the surface is not what its elements say."""
        growth = self.growth
        self.max_level = min(self.max_level + closer.levels, MAX_LEVEL)
        self.most_elements = closer.most_elements
        self.tolerances = np.maximum(self.tolerances, closer.error * self.lengths).astype(np.float32)
        states = self.judge(0)
        inner = growth.first_child[: growth.element_count].numpy() >= 0
        state = states.numpy()
        state[inner] = kernels.DONE
        states.assign(state)
        first = growth.element_count
        growth.bisect(self.chosen(self.of_state(states, kernels.SPLIT, 0)))
        self.run(first)

    def chosen(self, wished: wp.array) -> wp.array:
        """Those of the elements that are to be bisected for which there is room, the neediest."""
        growth = self.growth
        if self.most_elements is None:
            return wished
        room = max((self.most_elements - growth.element_count) // 2, 0)
        if len(wished) <= room:
            return wished
        need = self.need[: growth.element_count].numpy()[wished.numpy()]
        least = np.partition(need, len(need) - room - 1)[len(need) - room - 1]
        self.tolerances = np.maximum(self.tolerances, least)
        growth.wished.zero_()
        kept = wished.numpy()[need > least]
        return wp.array(kept, dtype=wp.int32, device=self.device)

    def evaluate(self) -> None:
        """Values at the nodes that are new."""
        growth, first = self.growth, self.evaluated
        count = growth.node_count - first
        if not count:
            return
        self.phi = with_room(self.phi, growth.node_count)
        points = wp.empty(count, dtype=wp.vec3, device=self.device)
        self.growth.launch(kernels.node_points, count, [growth.lattice, first, self.origin, self.spacing], [points])
        found = self.domain.phi(points)
        self.growth.launch(kernels.take_values, count, [found, growth.lattice, first, self.top, self.noise], [self.phi])
        self.evaluated = growth.node_count

    def judge(self, first: int) -> wp.array:
        """Find out of all elements from ``first`` on whether they are outside, and which are to be bisected.

        Returns:
            Their states, int32, SPLIT where they are.
        """
        growth, wishes, lipschitz = self.growth, self.wishes, float(self.domain.lipschitz)
        self.evaluate()
        self.need = with_room(self.need, growth.element_count)
        count = growth.element_count - first
        states = wp.empty(count, dtype=wp.int32, device=self.device)
        inputs = [first, growth.tets, growth.level, self.phi, self.circumradius, self.edges]
        inputs += [lipschitz, wishes.min_level, self.max_level]
        growth.launch(kernels.judge_by_corners, count, inputs, [growth.first_child, states, self.need])
        self.judge_surface(first, states)
        self.judge_thickness(first, states)
        self.judge_fields(first, states)
        growth.launch(kernels.take_wishes, count, [states, first], [growth.wished])
        return states

    def judge_surface(self, first: int, states: wp.array) -> None:
        """Where corners leave it open: compare with the linear interpolant at midpoints, then at one point more."""
        growth, lipschitz = self.growth, float(self.domain.lipschitz)
        tolerances = wp.array(self.tolerances, dtype=wp.float32, device=self.device)
        elements = self.of_state(states, kernels.OPEN, first)
        count = len(elements)
        if not count:
            return
        slots = growth.insert_edges(elements, of_refinement=False)
        self.evaluate()
        unsure = wp.empty(count, dtype=wp.int32, device=self.device)
        probes = wp.empty(count, dtype=wp.vec3, device=self.device)
        expected, deviations = (wp.empty(count, dtype=wp.float32, device=self.device) for _ in range(2))
        inputs = [elements, first, *growth.midpoints(slots), growth.tets, growth.level, self.phi, growth.lattice]
        inputs += [self.origin, self.spacing, self.circumradius, lipschitz, tolerances]
        outputs = [growth.first_child, states, self.need, unsure, probes, expected, deviations]
        growth.launch(kernels.judge_by_edges, count, inputs, outputs)
        chosen = growth.flagged(unsure)
        if len(chosen):
            found = self.domain.phi(probes[chosen].contiguous())
            inputs = [chosen, elements, first, found, expected, deviations, growth.tets, growth.level, self.phi]
            inputs += [growth.lattice, self.spacing, lipschitz, tolerances]
            growth.launch(kernels.judge_by_probes, len(chosen), inputs, [states, self.need])

    def judge_thickness(self, first: int, states: wp.array) -> None:
        """Bisect where the body is thinner than a few elements, or gaps between its pieces are."""
        wishes, growth, domain = self.wishes, self.growth, self.domain
        if not wishes.layers or not len(states):
            return
        state = states.numpy()
        level = growth.level[first : growth.element_count].numpy()
        leaf = growth.first_child[first : growth.element_count].numpy()
        # Without a limit to their number elements are no finer for it than the rest.
        deepest = wishes.max_level if self.most_elements is None else wishes.thin_level
        chosen = np.flatnonzero((state == kernels.DONE) & (leaf == LIVE) & (level < deepest))
        tets = growth.tets[first : growth.element_count].numpy()[chosen]
        phi = self.phi.numpy()[tets]
        crossed = (phi < 0).any(axis=1) & (phi >= 0).any(axis=1)
        chosen, tets = chosen[crossed], tets[crossed]
        if not len(chosen):
            return
        x, inward = surface_points(growth.lattice.numpy(), self.phi.numpy(), tets, self.origin, self.spacing)
        # By volume: a cube's edge halves in three levels.
        length = self.lengths[0] * 0.5 ** (level[chosen] / 3.0)
        reach = wishes.layers * float(length.max())
        need = np.where(wishes.layers * length > domain.thickness(x, inward, reach), THIN_NEED * length, 0.0)
        if domain.has_pieces:
            # Whether it is a gap between pieces is known later; the need of it is counted then.
            reach = GAP_ELEMENTS * float(length.max())
            near = GAP_ELEMENTS * length > domain.thickness(x, inward, reach, outside=True)
            need = np.where(near, np.maximum(need, LOOKED), need)
        split = need > 0.0
        if self.most_elements is not None:
            split &= THIN_NEED * length > self.tolerances[level[chosen]]
        state[chosen[split]] = kernels.SPLIT
        states.assign(state)
        needs = self.need.numpy()
        needs[first + chosen] = np.maximum(needs[first + chosen], need)
        self.need.assign(needs)

    def judge_fields(self, first: int, states: wp.array) -> None:
        """Bisect where labels or the user's fields ask for it, seen at corners and centroids."""
        wishes, domain = self.wishes, self.domain
        if not (domain.label_names or wishes.refine_where or wishes.field):
            return
        growth = self.growth
        state = states.numpy()
        leaf = growth.first_child[first : growth.element_count].numpy()
        level = growth.level[first : growth.element_count].numpy()
        chosen = np.flatnonzero((state == kernels.DONE) & (leaf == LIVE) & (level < wishes.max_level))
        if not len(chosen):
            return
        tets = growth.tets[first : growth.element_count].numpy()[chosen]
        nodes, corners = np.unique(tets, return_inverse=True)
        corners = corners.reshape(-1, 4)
        at_nodes = np.asarray(self.origin) + growth.lattice[: growth.node_count].numpy()[nodes] * self.spacing
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
            need[mixed] = np.maximum(need[mixed], LABEL_NEED * self.lengths[level[chosen[mixed]]])
        split = need > (0.0 if self.most_elements is None else self.tolerances[level[chosen]])
        needs = self.need.numpy()
        needs[first + chosen] = np.maximum(needs[first + chosen], need)
        self.need.assign(needs)
        state[chosen[split]] = kernels.SPLIT
        states.assign(state)

    def of_state(self, states: wp.array, state: int, first: int) -> wp.array:
        flags = wp.empty(len(states), dtype=wp.int32, device=self.device)
        self.growth.launch(kernels.flag_equal, len(states), [states, state], [flags])
        return self.growth.flagged(flags, first)


def surface_points(
    lattice: np.ndarray, phi: np.ndarray, tets: np.ndarray, origin: Any, spacing: float
) -> tuple[np.ndarray, np.ndarray]:
    """A point on the surface, or nearly, in each element that it cuts, and the direction inwards there [n, 3]."""
    x = np.asarray(origin, dtype=np.float64) + lattice[tets] * float(spacing)
    values = phi[tets].astype(np.float64)
    edges = x[:, 1:] - x[:, :1]
    gradient = np.linalg.solve(edges, (values[:, 1:] - values[:, :1])[..., None])[..., 0]
    slope = np.linalg.norm(gradient, axis=1)
    inward = -gradient / np.maximum(slope, 1e-30)[:, None]
    # From the middle along the gradient to where the interpolant is zero, but no farther than the element is long.
    size = np.linalg.norm(edges, axis=2).max(axis=1)
    step = np.divide(values.mean(axis=1), slope, out=np.zeros(len(x)), where=slope > 0)
    return x.mean(axis=1) + np.clip(step, -size, size)[:, None] * inward, inward


def _checked(function: Callable[[np.ndarray], Any], points: np.ndarray) -> np.ndarray:
    found = np.asarray(function(points))
    if found.shape != (len(points),):
        raise InputError(f"a field gave the shape {found.shape} for {len(points)} points; it must give [{len(points)}]")
    if not np.isfinite(found).all():
        bad = int(np.flatnonzero(~np.isfinite(found))[0])
        raise InputError(f"a field is {found[bad]} at {points[bad].tolist()}; it must be finite")
    return found
