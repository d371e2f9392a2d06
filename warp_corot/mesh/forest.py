"""The forest of bisected tetrahedra: a grid of cubes with six path tetrahedra each, each the root of a binary tree.

Tetrahedra are bisected by Maubach's rule (``bisection``; Maubach 1995; Tagawa et al. 2013). Vertices lie on an integer
lattice. The tree has every ancestor; the leaves are the mesh. Everything is built with array operations.
"""

from __future__ import annotations

import math
from dataclasses import replace
from os import PathLike
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_indices, shown

from .forest_arrays import ForestArrays
from .lattice import LATTICE_BITS, checked_box
from .surfaces.bodies import largest_piece, separating_surface, summary, surface
from .surfaces.bound import SurfaceMesh, embed
from .topology import pieces_of
from .tree import VOID, Tree, UniformTree, at_midpoints, renumbered, with_virtual
from .uniform import halvings, uniform_leaves

if TYPE_CHECKING:
    from warp_corot.domain import Domain

    from .growing.refinement_criteria import Field

#: Leaves are numbered in 32 bits.
MAX_LEAVES = 2**31 - 1


class TetForest(ForestArrays):
    """A conforming mesh of right-angled tetrahedra of three shapes, the leaves of a forest of binary trees.

    Attributes:
        cells: Number of root cubes along x, y, z.
        cell_size: Edge length of a root cube [m].
        origin: Position of the lattice point (0, 0, 0) [m].
        lattice: Lattice coordinates of the nodes, 2**16 intervals per cube edge, int32 [N, 3]. If parts of the forest
            are void, corners of void or coarser tetrahedra that no leaf names follow the N nodes.
        node_ends: The two ends of the edge whose midpoint a node is, the lower number first; -1, -1 for corners of
            cubes; int32, as many as there are lattice points.
        tree: All tetrahedra of all levels.
        up_axis: "X", "Y" or "Z".
        phi: The body's signed function at all lattice points [m], negative inside, float32; None for a box.
        fill: Share of each leaf's volume that is inside the body, float64 [T]; None: all of it. It is above one if a
            leaf took over the share of a neighbour that was left out.
        labels: Each leaf's label, its place in ``label_names`` plus one, 0 for none, int32 [T]; None: no labels.
        node_labels: Labels at all lattice points; points outside have the label of the nearest part of the body.
        label_names: Names of the labels.
        snap: From each node on a cut to the surface that cut there [m], float32 [N, 3]; None: nothing was cut.
        detail: The parts of the body's surface that were resolved more finely than the mesh; None: there are none.
    """

    def __repr__(self) -> str:
        return f"<TetForest of {len(self.levels)} tetrahedra and {self.node_count} nodes>"

    @classmethod
    def box(
        cls,
        cells: tuple[int, int, int] = (1, 1, 1),
        cell_size: float = 1.0,
        level: int = 0,
        *,
        origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
        up_axis: str = "Y",
    ) -> TetForest:
        """A box of root cubes, uniformly bisected.

        Args:
            cells: Number of root cubes along x, y, z, each at least 1.
            cell_size: Edge length of a root cube [m].
            level: How often every root is bisected, 0 to 48; three levels halve the edge length.
            origin: Lower corner of the box [m].
            up_axis: The axis that points up in drawings.

        Raises:
            InputError: An argument is out of its range, or the mesh would have 2**31 tetrahedra or more.
        """
        cells, cell_size, level, origin = checked_box(cells, cell_size, level, origin, up_axis)
        count = 6 * math.prod(cells) << level
        if count > MAX_LEAVES:
            raise InputError(f"level is {level}, which gives {count} tetrahedra; there must be at most {MAX_LEAVES}")
        lattice, ends, tets = uniform_leaves(cells, level)
        lattice <<= LATTICE_BITS - halvings(level)
        return cls(cells, cell_size, origin, lattice, ends, UniformTree(tets, level), up_axis)

    @classmethod
    def from_domain(
        cls,
        domain: Domain,
        cell_size: float | None = None,
        *,
        max_level: int | None = None,
        surface_error: float | None = None,
        min_level: int = 0,
        refine_where: Field | None = None,
        field: Field | None = None,
        field_tolerance: float = 0.0,
        target_elements: int | None = None,
        min_layers: float = 2,
        detail: int = 0,
        sliver: float = 0.02,
        device: str | wp.Device | None = None,
    ) -> TetForest:
        """A forest that follows a domain: fine where its surface is curved, empty outside.

        A tetrahedron is bisected in three cases. First, while the surface inside it deviates from the linear
        interpolant by more than ``surface_error``. That is measured at its edges' midpoints and at one more point,
        unless the domain's Lipschitz constant excludes a surface. Second, where labels vary in it. Third, where the
        user's functions ask for it. Labels and functions are evaluated at corners and centroids: smaller details need a
        ``min_level``.

        Args:
            domain: The body.
            cell_size: Edge length of a root cube [m]; None: chosen for ``target_elements``.
            max_level: The most bisections of a root, up to 48; three levels halve the edge length. None: 12, or chosen
                for ``target_elements``.
            surface_error: The largest distance between the mesh's surface and the domain's [m]; None: the whole surface
                is at ``max_level``.
            min_level: The fewest bisections of every root.
            refine_where: Points [n, 3] [m] -> bool [n]: tetrahedra at these points are bisected to ``max_level``.
            field: Points [n, 3] [m] -> numbers [n]: tetrahedra in which it varies by more than ``field_tolerance`` are
                bisected.
            field_tolerance: In the field's unit.
            target_elements: The most tetrahedra; the mesh has nearly that number. The body is sampled in a finer
                forest, and the mesh is the one with this number that follows it best. Its tetrahedra know their volume
                inside the body from that forest, so parts thinner than a tetrahedron are not lost.
            min_layers: With ``target_elements``: the fewest elements through the body's thickness, if the number
                allows.
            detail: Without ``target_elements``: how many levels below ``max_level`` the body is sampled where the
                surface differs from the tetrahedra's. 0: details between the mesh's nodes are lost.
            sliver: Tetrahedra with less than this share inside the body are left out, and their volume is added to a
                neighbour's, so that no node has almost no stiffness.
            device: The device that does the work; None: the domain's.

        Raises:
            InputError: An argument is out of its range, no tetrahedron holds any of the body, or even the coarsest mesh
                has more elements.

        Warns:
            UserWarning: The mesh leaves out tips of the body that no face of an element joins to the rest.
        """
        from warp_corot.domain import Domain
        from warp_corot.mesh.growing.from_domain import Budget, checked_wishes, mesh_domain

        if not isinstance(domain, Domain):
            cure = f"Domain.from_surface({str(domain)!r}) makes one" if isinstance(domain, str | PathLike) else ""
            raise InputError(f"domain is {shown(domain)}; it must be a Domain{cure and ': ' + cure}")
        wishes = checked_wishes(max_level, surface_error, min_level, refine_where, field, field_tolerance)
        target = 0 if target_elements is None else checked_count(target_elements, "target_elements", 1)
        return mesh_domain(domain, Budget(target, cell_size, max_level, min_layers, wishes), detail, sliver, device)

    def refine(self, leaves: npt.ArrayLike) -> TetForest:
        """A forest in which the chosen leaves are bisected, and as many others as conformity needs.

        A leaf with an active midpoint on any edge is bisected, too, until no leaf has one (the closure of the set of
        midpoints). Nodes keep their numbers; new ones are appended. Void tetrahedra stay void, the surface does not
        change, and both halves of a leaf have its filled share and its label; for more detail, mesh the domain again.

        Args:
            leaves: Mask bool [T] or indices into the leaves.

        Raises:
            InputError: The argument is not a mask or list of leaves, or a leaf is already at the deepest level.
        """
        chosen = checked_indices(leaves, len(self.tets), "leaf")
        return refined(self, chosen)

    def embed(self, points: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        return embed(self, points)

    def surface(self) -> SurfaceMesh:
        """The closed marched surface of a mesh made from a domain; the boundary of any other mesh.

        Points are on edges between nodes inside and outside. If the outer end belonged to an element that was left out,
        the point is bound to the nodes of the nearest element.
        """
        return surface(self)

    def separating_surface(self) -> SurfaceMesh:
        """The surfaces between labels and around them, with ``sides``; `SurfaceMesh.of_label` gives a single label's.

        Raises:
            InputError: The mesh has no labels, or it is cut.
        """
        return separating_surface(self)

    def pieces(self) -> np.ndarray:
        """The piece of each leaf, int32 [T]: leaves connected by faces are one piece; the largest is 0."""
        return pieces_of(self.tets)

    def largest_piece(self) -> TetForest:
        """The mesh, with its surface, without leaves that no faces connect to the largest piece."""
        return largest_piece(self)

    def summary(self) -> list[str]:
        """A summary of the mesh, line by line: counts, levels, volume, labels, pieces."""
        return summary(self)


def refined(forest: TetForest, leaves: np.ndarray) -> TetForest:
    """See `TetForest.refine`; leaves by their indices."""
    from .growing.growth import Growth

    tree = forest.tree
    growth = Growth(forest.lattice, forest.node_ends, tree, wp.get_device("cpu"))
    wished = np.zeros(growth.element_count, np.uint8)
    wished[tree.leaves[leaves]] = 1
    growth.forest.wished.assign(wished)
    if forest.phi is not None:
        # Leaves that were given up as nearly empty still contain a part of the surface.
        growth.forest.bound.assign((tree.first_child == VOID) & (forest.phi[tree.tets] < 0).any(axis=1))
    growth.close()
    lattice, ends = growth.nodes()
    grown = growth.tree()
    named = np.zeros(len(lattice), bool)
    named[grown.leaf_tets] = True
    named[: forest.node_count] = False
    real = np.concatenate([np.arange(forest.node_count), np.flatnonzero(named)])
    order = with_virtual(real, grown, lattice)
    new_ends, new_tree = renumbered(order, ends, grown)
    whose = _leaves_before(forest.tree, grown)
    known = np.where(np.arange(len(lattice)) < len(forest.lattice), np.arange(len(lattice)), -1)
    labels = at_midpoints(forest.node_labels, known, ends, first=True)
    return replace(
        forest,
        lattice=lattice[order],
        node_ends=new_ends,
        tree=new_tree,
        phi=None if forest.phi is None else at_midpoints(forest.phi, known, ends)[order],
        node_labels=None if labels is None else labels[order],
        fill=None if forest.fill is None else forest.fill[whose],
        labels=None if forest.labels is None else forest.labels[whose],
    )


def _leaves_before(before: Tree, after: Tree) -> np.ndarray:
    """For each leaf, the leaf of the former tree that it is or comes from."""
    found = after.leaves.copy()
    while (new := found >= len(before.level)).any():
        found[new] = after.parent[found[new]]
    number = np.full(len(before.level), -1, np.int32)
    number[before.leaves] = np.arange(len(before.leaves), dtype=np.int32)
    return number[found]
