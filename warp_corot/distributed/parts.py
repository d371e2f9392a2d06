"""A rank's part of a body: its elements, copies of its neighbours', and their nodes."""

from __future__ import annotations

import dataclasses
import functools
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.elements import Mesh
from warp_corot.materials.isotropic import Material
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.numbering import in_order_of_leaves, live_or_void, renumbered, with_virtual

from .partition import Partition

Ints = npt.NDArray[np.int32]
M = TypeVar("M", bound=Material)


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers that a part's nodes and elements have in the whole mesh.

    Attributes:
        nodes, elements: int32 [n] and [t] of one world; elements ascend.
        owner: The rank that moves each of the nodes, int32 [n].
        counted: Whether this rank counts the element's energy, bool [t].
    """

    nodes: Ints
    elements: Ints
    owner: Ints
    counted: npt.NDArray[np.bool_]


class Part(SoftBody):
    """A rank's part of a body. Ghosts have no mass, so steps do not move them.

    Args:
        whole: The body.
        partition: The division of its mesh.
        rank: The rank of the part.
        device: Where it is computed; None: where the body is.
    """

    def __init__(self, whole: SoftBody, partition: Partition, rank: int, device: wp.Device | None = None):
        kept = partition.needed(whole.mesh, rank)
        mesh, nodes = part_of_mesh(whole.mesh, kept, partition)
        elements = np.flatnonzero(kept).astype(np.int32)
        self.numbers = Numbers(
            nodes, elements, partition.rank_of_node[nodes], partition.rank_of_element[elements] == rank
        )
        self._whole = whole
        self.is_own = np.tile(self.numbers.owner == rank, whole.worlds)
        material = part_of_material(whole.material, elements, len(whole.mesh.tets))
        super().__init__(mesh, material, worlds=whole.worlds, device=device or whole.device)
        self.discretization.smallest_volume = whole.discretization.smallest_volume

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped masses of the nodes that this rank moves [kg], float64 [worlds * n]; zero for ghosts."""
        return np.where(self.is_own, super().masses, 0.0)

    @property
    def surface_faces(self) -> tuple[Ints, Ints]:
        """The triangles of the whole body's surface around the nodes that this rank moves, int32 [f, 3], in the order
        that they have there; and the element of each, [f]."""
        return self._surface[1:]

    @property
    def surface_here(self) -> Ints:
        """Which triangles of the whole body's surface these are, int32 [f]."""
        return self._surface[0]

    @functools.cached_property
    def _surface(self) -> tuple[Ints, Ints, Ints]:
        triangles, parents = self._whole.surface_faces
        number = np.full(self._whole.world_node_count, -1, np.int32)
        own = self.is_own[: len(self.numbers.nodes)]
        number[self.numbers.nodes[own]] = 1
        here = np.flatnonzero((number[triangles] >= 0).any(axis=1)).astype(np.int32)
        number[self.numbers.nodes] = np.arange(len(self.numbers.nodes), dtype=np.int32)
        elements = np.searchsorted(self.numbers.elements, parents[here]).astype(np.int32)
        return here, number[triangles[here]], elements


def part_of_mesh(mesh: Mesh, kept: npt.NDArray[np.bool_], partition: Partition) -> tuple[Mesh, Ints]:
    """The mesh of some elements, bool [T], in their order; and its nodes' numbers in the whole mesh."""
    if isinstance(mesh, TetForest):
        return _part_of_forest(mesh, kept, partition.groups[kept])
    nodes = np.unique(mesh.tets[kept]).astype(np.int32)
    number = np.full(len(mesh.points), -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    part = TetMesh(mesh.points[nodes], number[mesh.tets[kept]], up_axis=mesh.up_axis)
    part.element_groups = partition.groups[kept]
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
