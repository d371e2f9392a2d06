"""The arrays of a forest of bisected tetrahedra, and properties that follow from them without a search; what meshes of
every kind have."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.inputs.checks import shown

from .lattice import LATTICE_BITS, checked_level, volume_shares
from .surfaces.bound import BoundPoints, bound
from .tree import Tree, UniformTree

if TYPE_CHECKING:
    from .surfaces.marching import Detail


class LabelledMesh:
    """Tetrahedra, each with a label or none; ``TetForest`` and ``TetMesh`` document the attributes."""

    points: np.ndarray
    tets: np.ndarray
    labels: np.ndarray | None
    label_names: tuple[str, ...]

    def elements_of(self, label: str) -> np.ndarray:
        """Tetrahedra with this label, bool [T].

        Raises:
            InputError: The mesh has no label of this name.
        """
        if label not in self.label_names or self.labels is None:
            raise InputError(f"there is no label {shown(label)}; there are: {', '.join(self.label_names) or 'none'}")
        return np.equal(self.labels, self.label_names.index(label) + 1)

    def nodes_of(self, label: str) -> np.ndarray:
        """Nodes of the tetrahedra with this label, bool [N]; nodes on a border belong to both sides.

        Raises:
            InputError: The mesh has no label of this name.
        """
        found = np.zeros(len(self.points), bool)
        found[self.tets[self.elements_of(label)]] = True
        return found

    def embed(self, points: npt.ArrayLike) -> tuple[np.ndarray, np.ndarray]:
        """The tetrahedron that holds each point, or the nearest one, and the point's weights in it.

        Args:
            points: [n, 3] [m].

        Returns:
            Tetrahedra int32 [n], and barycentric weights of their nodes float64 [n, 4]; some are negative if the point
            is outside.

        Raises:
            InputError: The points are not [n, 3], or not finite.
        """
        raise NotImplementedError

    def bind(self, points: npt.ArrayLike, triangles: npt.ArrayLike | None = None) -> BoundPoints:
        """Bind your own points, or with triangles [F, 3] a surface, to the mesh, so that they follow it.

        A closed surface is wound outwards, as `Domain.from_surface` winds it.

        Raises:
            InputError: As for `embed`, or triangles name points that do not exist.
        """
        elements, weights = self.embed(points)
        return bound(np.asarray(points), self.tets[elements], weights, triangles)


@dataclass(frozen=True, eq=False)
class ForestArrays(LabelledMesh):
    """The arrays that refinement, embedding and drawing use; ``TetForest``, which users hold, documents them."""

    cells: tuple[int, int, int]
    cell_size: float
    origin: tuple[float, float, float]
    lattice: np.ndarray
    node_ends: np.ndarray
    tree: Tree
    up_axis: str = "Y"
    phi: np.ndarray | None = None
    fill: np.ndarray | None = None
    labels: np.ndarray | None = None
    node_labels: np.ndarray | None = None
    label_names: tuple[str, ...] = ()
    detail: Detail | None = None
    snap: np.ndarray | None = None
    #: Groups of leaves that share a dilatation, int32 [T], if a larger forest gives them; None: they are found when
    #: needed.
    leaf_groups: np.ndarray | None = None

    @cached_property
    def points(self) -> np.ndarray:  # type: ignore[override]
        """Rest positions of the nodes [m], float64 [N, 3]."""
        return self.lattice_points[: self.node_count]

    @cached_property
    def lattice_points(self) -> np.ndarray:
        """Rest positions of all lattice points [m], the N nodes first, float64."""
        return np.asarray(self.origin) + self.lattice * (self.cell_size / 2**LATTICE_BITS)

    @cached_property
    def node_count(self) -> int:
        """Number of nodes N that leaves name."""
        return len(self.lattice) if isinstance(self.tree, UniformTree) else int(self.tets.max()) + 1

    @cached_property
    def tets(self) -> np.ndarray:  # type: ignore[override]
        """The leaves' nodes in Maubach order, in tree order, int32 [T, 4]."""
        return self.tree.leaf_tets

    @cached_property
    def levels(self) -> np.ndarray:
        """Level of each leaf, int32 [T]; for a uniform mesh a broadcast number, which takes no memory."""
        return self.tree.leaf_levels

    @cached_property
    def volumes(self) -> np.ndarray:
        """Rest volume of each leaf [m^3], float64 [T]; for a uniform mesh a broadcast number, like ``levels``."""
        if isinstance(self.tree, UniformTree):
            return np.broadcast_to(volume_shares(self.tree.depth) * self.cell_size**3, self.levels.shape)
        return volume_shares(self.levels) * self.cell_size**3

    def ancestors(self, level: int) -> np.ndarray:
        """For each leaf, its highest ancestor, or itself, that is not above ``level`` and whose corners are nodes.

        Except at the border of a body, this is the ancestor at ``level``. Returns indices into the tree, int32 [T].
        """
        level = checked_level(level, "level")
        if self.node_count == len(self.lattice):
            return self.tree.ancestors(self.tree.leaves, level)
        tree, found = self.tree, self.tree.leaves.copy()
        on_nodes = np.less(tree.tets.max(axis=1), self.node_count)
        below = np.flatnonzero(tree.level[found] > level)
        climbed = found[below]
        while len(below):
            climbed = tree.parent[climbed]
            real = on_nodes[climbed]
            found[below[real]] = climbed[real]
            further = tree.level[climbed] > level
            below, climbed = below[further], climbed[further]
        return found
