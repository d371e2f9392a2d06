"""The forest that follows a domain's surface: bisect elements in which the surface is not flat enough, until the mesh
is conforming.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.mesh.bisection import path_tetrahedra
from warp_corot.mesh.lattice import LATTICE_BITS, MAX_CELLS, MAX_LEVEL, volume_shares
from warp_corot.mesh.surfaces.embedding import leaves_at
from warp_corot.mesh.tree import LIVE, Tree

from .growth import Growth
from .judging import Judge, Wishes

if TYPE_CHECKING:
    from warp_corot.domain import Domain

#: The tetrahedra of a root cube.
TETS_OF_CUBE = 6
#: Each time a surface error is lowered to at least ``STEEPEST`` and at most ``FLATTEST`` of itself.
STEEPEST, FLATTEST = 0.2, 0.7
#: This fraction of the elements may remain as conformity made them.
LEFT_OVER = 2.0e-3


@dataclass(frozen=True)
class Closer:
    """How much more finely a body is sampled than its mesh follows it.

    Attributes:
        levels: Number of levels below the mesh's deepest.
        error: The largest distance of the sampled surface from the domain's, as a fraction of an element's edge there.
        most_elements: The approximate largest number of tetrahedra of all levels: beyond it only the neediest of a
            level are bisected.
    """

    levels: int
    error: float
    most_elements: int


@dataclass(frozen=True)
class Enough:
    """The state in which a forest is fine enough for a mesh with a number of elements.

    Attributes:
        elements: The number of leaves that contain a part of the body.
        first_error: The first surface error [m].
    """

    elements: int
    first_error: float


@dataclass(frozen=True)
class Grown:
    """A grown forest: all lattice points that were evaluated, and the results.

    Attributes:
        cells, origin: The grid.
        lattice, ends, phi: Coordinates, edge ends and signed function of the lattice points.
        tree: The tree of all bisections.
        need: The error of an element's piece of the surface if the element were not bisected [m], float32 [M].
        wished: The mesh before the body was sampled more finely, as the first child of each tetrahedron, int32 [m];
            without finer sampling it is the whole tree.
        growth: The same on the device.
        deepest: The level from which elements were not compared with the surface.
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
    deepest: int


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


def grow(
    domain: Domain,
    cell_size: float,
    wishes: Wishes,
    device: wp.Device,
    closer: Closer | None = None,
) -> Grown:
    """Bisect the grid around a domain by the wishes and for conformity; then, if requested, sample the body more
    finely.

    Args:
        domain: The body.
        cell_size: Edge of a root cube [m].
        wishes: The required fineness.
        device: The device of the computation.
        closer: How finely to sample the body afterwards.
    """
    growing = Growing(domain, cell_size, wishes, device)
    growing.run()
    wished = growing.growth.first_child[: growing.growth.element_count].numpy().copy()
    if closer is not None:
        growing.look_closer(closer)
    return growing.grown(wished)


class Growing:
    """A forest that grows to follow a domain.

    Args:
        domain: The body.
        cell_size: Edge of a root cube [m].
        wishes: The required fineness.
        device: The device of the computation.
        cubes: The root cubes that are bisected, in the order of `path_tetrahedra`: the first one, and the one after the
            last; None: all.
    """

    def __init__(
        self,
        domain: Domain,
        cell_size: float,
        wishes: Wishes,
        device: wp.Device,
        cubes: tuple[int, int] | None = None,
    ):
        self.cells, self.origin = grid_around(domain.bounds, cell_size)
        a, b, c = self.cells
        points = (a + 1, b + 1, c + 1)
        lattice = np.indices(points, dtype=np.int32).reshape(3, -1).T << LATTICE_BITS
        tets = path_tetrahedra(self.cells, points)
        if cubes is not None:
            tets = tets[TETS_OF_CUBE * cubes[0] : TETS_OF_CUBE * cubes[1]]
        roots = len(tets)
        leaf = np.full(roots, LIVE, np.int32)
        tree = Tree(tets, np.zeros(roots, np.int32), np.full(roots, -1, np.int32), leaf)
        self.growth = Growth(lattice, np.full((len(lattice), 2), -1, np.int32), tree, device)
        self.judge = Judge(domain, self.growth, self.cells, self.origin, cell_size, wishes)
        self.room: int | None = None

    def run(self, first: int = 0) -> None:
        """Bisect elements from ``first`` on by the wishes, then for conformity.

        If the number of elements is limited, a few of the elements that conformity made may remain too coarse, because
        refining all of them would take a round for every few elements.
        """
        growth, judge = self.growth, self.judge
        while True:
            self.run_down(first)
            if not judge.limited or len(left := judge.off()) <= LEFT_OVER * growth.element_count:
                break
            first = growth.element_count
            growth.bisect(self.chosen(left))
        judge.evaluate()

    def run_down(self, first: int) -> None:
        """Bisect from the top down, each level from only the one above, then for conformity."""
        growth, start = self.growth, first
        while first < growth.element_count:
            wished = self.chosen(self.judge.wished(first))
            first = growth.element_count
            growth.bisect(wished)
        growth.close(self.judge.wished, start)

    def run_until(self, enough: Enough) -> None:
        """Lower the surface error until there are enough elements."""
        judge = self.judge
        least = float(judge.closest[0])
        error, judge.limited = max(enough.first_error, least), True
        judge.tolerances = np.full(MAX_LEVEL + 1, error, np.float32)
        self.run()
        while error > least and (share := judge.holding() / enough.elements) < 1.0:
            error = max(error * min(max(share, STEEPEST), FLATTEST), least)
            self.lower(error)

    def run_finer(self, share: float, thin_share: float) -> None:
        """Lower the surface error once more, to a fraction of itself, for the drawn surface, and the error of thin
        parts to another.
        """
        error, least = float(self.judge.tolerances.max()), float(self.judge.closest[0])
        self.judge.thin_tolerance = thin_share * error
        if error > least and share < 1.0:
            self.lower(max(share * error, least))

    def lower(self, error: float) -> None:
        """Bisect elements whose error exceeds a smaller limit than before, and then their children."""
        self.judge.tolerances = np.full(MAX_LEVEL + 1, error, np.float32)
        first = self.growth.element_count
        self.growth.bisect(self.judge.off())
        self.run(first)

    def run_around(self, points: np.ndarray, largest: np.ndarray) -> None:
        """Bisect elements that hold points [n, 3] [m] until each is at most as large as its limit [m^3]."""
        growth, judge = self.growth, self.judge
        cell_size = float(judge.lengths[0])
        while True:
            tree = growth.tree()
            leaves = leaves_at(tree, self.cells, self.origin, cell_size, points)
            large = (leaves >= 0) & (cell_size**3 * volume_shares(tree.level[leaves]) > largest)
            if not large.any():
                break
            first = growth.element_count
            growth.bisect(wp.array(np.unique(leaves[large]), dtype=wp.int32, device=growth.device))
            self.run(first)

    def look_closer(self, closer: Closer) -> None:
        """Continue in elements that do not represent the surface well."""
        growth, judge = self.growth, self.judge
        self.room = closer.most_elements
        first = growth.element_count
        growth.bisect(self.chosen(judge.unresolved(closer.levels, closer.error)))
        self.run(first)

    def grown(self, wished: np.ndarray | None = None) -> Grown:
        """The present forest.

        Args:
            wished: See `Grown`; None: the whole tree.
        """
        growth, judge = self.growth, self.judge
        lattice, ends = growth.nodes()
        phi, need = judge.phi[: growth.node_count].numpy(), judge.need[: growth.element_count].numpy()
        tree = growth.tree()
        wished = tree.first_child if wished is None else wished
        return Grown(self.cells, self.origin, lattice, ends, tree, phi, need, wished, growth, judge.max_level)

    def chosen(self, wished: wp.array) -> wp.array:
        """The elements with the largest need, as many as there is room for."""
        growth, judge = self.growth, self.judge
        if self.room is None:
            return wished
        room = max((self.room - growth.element_count) // 2, 0)
        if len(wished) <= room:
            return wished
        need = judge.need[: growth.element_count].numpy()[wished.numpy()]
        least = np.partition(need, len(need) - room - 1)[len(need) - room - 1]
        judge.tolerances = np.maximum(judge.tolerances, least)
        growth.wished.zero_()
        kept = wished.numpy()[need > least]
        return wp.array(kept, dtype=wp.int32, device=growth.device)
