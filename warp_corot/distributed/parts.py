"""A rank's part of a body: its elements, copies of its neighbours' elements, and their nodes."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.materials.isotropic import Material
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.lattice import LATTICE_BITS
from warp_corot.mesh.numbering import in_order_of_leaves, live_or_void, renumbered, with_virtual

from .partition import Partition

Ints = npt.NDArray[np.int32]
M = TypeVar("M", bound=Material)


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers that a part's nodes and elements have in the whole mesh.

    Attributes:
        nodes, elements: int32 or int64 [n] and [t] of one world; elements ascend.
        owner: The rank that moves each of the nodes, int32 [n].
        counted: Whether this rank counts the element's energy, bool [t].
        node_count: Number of nodes of the whole mesh.
        places, element_places: Places of the nodes and elements in the body that this rank holds, int32 [n] and [t]:
            the same numbers, or those of its own part if no rank holds the whole mesh.
    """

    nodes: npt.NDArray[np.integer]
    elements: npt.NDArray[np.integer]
    owner: Ints
    counted: npt.NDArray[np.bool_]
    node_count: int
    places: Ints
    element_places: Ints

    def in_worlds(self, worlds: int) -> npt.NDArray[np.int64]:
        """The numbers of the nodes among those of all worlds of the whole mesh, int64 [worlds * n]."""
        return (self.nodes + self.node_count * np.arange(worlds, dtype=np.int64)[:, None]).ravel()


class ForestPart(TetForest):
    """A rank's part of a forest that no rank holds whole: the leaves around the nodes that the rank moves.

    Leaves and nodes are those of this part; some are copies of other ranks' leaves, and the nodes of these.

    Attributes:
        numbers: Their numbers in the whole forest.
        element_count: Number of leaves of the whole forest.
        bounds: Lowest and highest coordinates of the whole forest [m], float64 [2, 3].
        smallest_volume: Volume of the smallest element of the whole forest [m^3].
        outer: The triangles of the part's nodes on the surface of the whole forest, int32 [F, 3]; None: the forest is a
            box, uniformly bisected.
    """

    def __init__(
        self,
        *arrays: Any,
        numbers: Numbers,
        element_count: int,
        bounds: npt.NDArray[np.float64],
        smallest_volume: float | None = None,
        outer: Ints | None = None,
        **others: Any,
    ):
        super().__init__(*arrays, **others)
        smallest_volume = float(np.min(self.volumes)) if smallest_volume is None else smallest_volume
        self.__dict__.update(numbers=numbers, element_count=element_count, bounds=bounds)
        self.__dict__.update(smallest_volume=smallest_volume, outer=outer)

    numbers: Numbers
    element_count: int
    bounds: npt.NDArray[np.float64]
    smallest_volume: float
    outer: Ints | None

    @property
    def is_box(self) -> bool:
        """Whether the whole forest is a box, uniformly bisected."""
        return self.outer is None

    def refine(self, leaves: npt.ArrayLike) -> TetForest:
        """A forest in parts cannot be refined, because a rank would bisect without its neighbours.

        Raises:
            InputError: Always.
        """
        raise InputError("a forest in parts cannot be refined; make it finer")

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
        """Which triangles, int32 [F, 3], lie on the surface of the whole forest; others are faces to leaves
        elsewhere."""
        if self.outer is not None:
            base = np.array([len(self.points) ** 2, len(self.points), 1], np.int64)
            given, outer = (np.sort(each, axis=1).astype(np.int64) @ base for each in (triangles, self.outer))
            return np.isin(given, outer)
        corners = self.lattice[triangles]
        ends = np.array([np.zeros(3, np.int64), np.array(self.cells) << LATTICE_BITS])
        return np.any([(corners == end).all(axis=1).any(axis=1) for end in ends], axis=0)

    def check_expression(self, expression: str) -> None:
        """Check that an expression can be evaluated at the nodes of one part.

        Raises:
            InputError: It asks for nearest nodes.
        """
        if "nearest" in expression:
            raise InputError("nearest needs the whole mesh, and this rank holds a part; use sphere or box")


class Part(SoftBody):
    """A rank's part of a body. Ghosts have no mass, so steps do not move them.

    Args:
        whole: The body.
        partition: The division of its mesh; None if this rank holds only its part.
        rank: The rank of the part.
        device: The device of the part; None: that of the body.
    """

    def __init__(self, whole: SoftBody, partition: Partition | None, rank: int, device: wp.Device | None = None):
        self._whole = whole
        mesh, material = whole.mesh, whole.material
        if isinstance(mesh, ForestPart):
            self.numbers = mesh.numbers
        else:
            assert partition is not None
            kept = partition.needed(mesh, rank)
            mesh, nodes = part_of_mesh(mesh, kept, partition)
            elements = np.flatnonzero(kept).astype(np.int32)
            owner, counted = partition.rank_of_node[nodes], partition.rank_of_element[elements] == rank
            self.numbers = Numbers(nodes, elements, owner, counted, whole.world_node_count, nodes, elements)
            material = part_of_material(material, elements, len(whole.mesh.tets))
        self.is_own = np.tile(self.numbers.owner == rank, whole.worlds)
        super().__init__(mesh, material, worlds=whole.worlds, device=device or whole.device)
        of_whole = whole.mesh if isinstance(whole.mesh, ForestPart) else whole.discretization
        self.discretization.smallest_volume = of_whole.smallest_volume

    def _discretized(self, mesh: Mesh, material: Material) -> Discretization:
        shared = mesh is self._whole.mesh and self.device == self._whole.device
        return self._whole.discretization if shared else super()._discretized(mesh, material)

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped masses of the nodes that this rank moves [kg], float64 [worlds * n]; zero for ghosts."""
        return np.where(self.is_own, super().masses, 0.0)

    @property
    def surface_faces(self) -> tuple[Ints, Ints]:
        """The triangles of the whole body's surface around the nodes that this rank moves, int32 [f, 3], in the whole
        body's order; and the element of each, [f]."""
        return self._surface[1:]

    @property
    def surface_here(self) -> Ints:
        """The numbers of ``surface_faces`` among the triangles of the whole body's surface, int32 [f]."""
        return self._surface[0]

    @functools.cached_property
    def _surface(self) -> tuple[Ints, Ints, Ints]:
        triangles, parents = self._whole.surface_faces
        number = np.full(self._whole.world_node_count, -1, np.int32)
        own = self.is_own[: len(self.numbers.nodes)]
        number[self.numbers.places[own]] = 1
        here = np.flatnonzero((number[triangles] >= 0).any(axis=1)).astype(np.int32)
        number[self.numbers.places] = np.arange(len(self.numbers.nodes), dtype=np.int32)
        elements = np.searchsorted(self.numbers.element_places, parents[here]).astype(np.int32)
        return here, number[triangles[here]], elements


def part_of_mesh(mesh: Mesh, kept: npt.NDArray[np.bool_], partition: Partition) -> tuple[Mesh, Ints]:
    """The mesh of some elements, bool [T], in their order; and its nodes' numbers in the whole mesh."""
    if isinstance(mesh, TetForest):
        return _part_of_forest(mesh, kept, partition.sharing[kept])
    nodes = np.unique(mesh.tets[kept]).astype(np.int32)
    number = np.full(len(mesh.points), -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    part = TetMesh(mesh.points[nodes], number[mesh.tets[kept]], up_axis=mesh.up_axis)
    part.element_groups = partition.sharing[kept]
    return part, nodes


def _part_of_forest(forest: TetForest, kept: npt.NDArray[np.bool_], groups: Ints) -> tuple[TetForest, Ints]:
    live = np.zeros(len(forest.tree.level), bool)
    live[forest.tree.leaves[kept]] = True
    tree = live_or_void(forest.tree, live)
    real = in_order_of_leaves(tree)
    order = with_virtual(real, tree, forest.lattice)
    ends, tree = renumbered(order, forest.node_ends, tree)
    fill = None if forest.fill is None else forest.fill[kept]
    place = (forest.cells, forest.cell_size, forest.origin)
    made = TetForest(*place, forest.lattice[order], ends, tree, forest.up_axis, fill=fill, leaf_groups=groups)
    return made, real.astype(np.int32)


def part_of_material(material: M, elements: Ints, count: int) -> M:
    """The material of some of ``count`` elements."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(material):  # type: ignore[arg-type]
        values, tail = getattr(material, field.name), material.components.get(field.name, ())
        axis = np.ndim(values) - len(tail) - 1
        if axis >= 0 and np.shape(values)[axis] == count > 1:
            found[field.name] = np.take(values, elements, axis=axis)
    return dataclasses.replace(material, **found) if found else material  # type: ignore[type-var]
