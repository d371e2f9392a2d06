"""A rank's part of a mesh that no rank holds whole."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.errors import InputError
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.lattice import LATTICE_BITS

Ints = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers that a part's nodes and elements have in the whole mesh.

    Attributes:
        nodes, elements: int32 or int64 [n] and [t] of one world; elements ascend.
        owner: The rank that moves each of the nodes, int32 [n].
        counted: Whether this rank counts the element's energy, bool [t].
        node_count: Number of nodes of the whole mesh.
        tree, lattice: The numbers that the tetrahedra of all levels and the lattice points of a forest have in the
            whole one, int32; None: they are not known.
    """

    nodes: npt.NDArray[Any]
    elements: npt.NDArray[Any]
    owner: Ints
    counted: npt.NDArray[np.bool_]
    node_count: int
    tree: Ints | None = None
    lattice: Ints | None = None

    def in_worlds(self, worlds: int) -> npt.NDArray[np.int64]:
        """The numbers of the nodes among those of all worlds of the whole mesh, int64 [worlds * n]."""
        return (self.nodes + self.node_count * np.arange(worlds, dtype=np.int64)[:, None]).ravel()


class DividedMesh:
    """A rank's part of a mesh: the elements around the nodes that the rank moves.

    Elements and nodes are those of this part; some are copies of other ranks' elements, and the nodes of these.

    Attributes:
        numbers: Their numbers in the whole mesh.
        element_count: Number of elements of the whole mesh.
        bounds: Lowest and highest coordinates of the whole mesh [m], float64 [2, 3].
        smallest_volume: Volume of the smallest element of the whole mesh [m^3].
        outer: The triangles of the part's nodes on the surface of the whole mesh, int32 [F, 3]; None: the mesh is a
            box, uniformly bisected.
        is_embedded: Whether the whole mesh was made from a domain, whose surface lies within the tetrahedra.
    """

    numbers: Numbers
    element_count: int
    bounds: npt.NDArray[np.float64]
    smallest_volume: float
    outer: Ints | None
    is_embedded: bool = False
    points: npt.NDArray[np.float64]
    tets: Ints
    volumes: npt.NDArray[np.float64]

    def _belong(self, of_whole: dict[str, Any]) -> None:
        """Set this part's place in the whole mesh: the attributes above."""
        self.__dict__.update({"outer": None} | of_whole)
        if "smallest_volume" not in of_whole:
            self.__dict__["smallest_volume"] = float(np.min(self.volumes))

    @property
    def is_box(self) -> bool:
        """Whether the whole mesh is a box, uniformly bisected."""
        return self.outer is None

    def check_whole(self) -> None:
        """Check that this part is the whole, as on one rank.

        Raises:
            InputError: It is not.
        """
        if len(self.tets) < self.element_count:
            raise InputError(
                f"the mesh is a part, {len(self.tets)} of {self.element_count} elements, of a mesh that several ranks "
                "hold; only warp_corot.distributed.Simulation can compute it"
            )

    def are_outer(self, triangles: Ints) -> npt.NDArray[np.bool_]:
        """Which triangles, int32 [F, 3], lie on the surface of the whole mesh; others are faces to elements
        elsewhere."""
        assert self.outer is not None
        base = np.array([len(self.points) ** 2, len(self.points), 1], np.int64)
        given, outer = (np.sort(each, axis=1).astype(np.int64) @ base for each in (triangles, self.outer))
        return np.isin(given, outer)

    def check_expression(self, expression: str) -> None:
        """Check that an expression can be evaluated at the nodes of one part.

        Raises:
            InputError: It asks for nearest nodes.
        """
        if "nearest" in expression:
            raise InputError("nearest needs the whole mesh, and this rank holds a part; use sphere or box")


class DividedForest(DividedMesh, TetForest):
    """A rank's part of a forest."""

    def __init__(self, *arrays: Any, of_whole: dict[str, Any], **others: Any):
        TetForest.__init__(self, *arrays, **others)
        self._belong(of_whole)

    def refine(self, leaves: npt.ArrayLike) -> TetForest:
        """A forest in parts cannot be refined, because a rank would bisect without its neighbours.

        Raises:
            InputError: Always.
        """
        raise InputError("a forest in parts cannot be refined; make it finer")

    def are_outer(self, triangles: Ints) -> npt.NDArray[np.bool_]:
        if self.outer is not None:
            return super().are_outer(triangles)
        corners = self.lattice[triangles]
        ends = np.array([np.zeros(3, np.int64), np.array(self.cells) << LATTICE_BITS])
        return np.any([(corners == end).all(axis=1).any(axis=1) for end in ends], axis=0)


class DividedTetMesh(DividedMesh, TetMesh):
    """A rank's part of a general mesh."""

    def __init__(self, *arrays: Any, of_whole: dict[str, Any], element_groups: Ints, **others: Any):
        TetMesh.__init__(self, *arrays, **others)
        self.element_groups = element_groups
        self._belong(of_whole)
