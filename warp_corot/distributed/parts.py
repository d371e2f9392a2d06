"""A rank's part of a body: its elements, copies of its neighbours' elements, and their nodes."""

from __future__ import annotations

import dataclasses
import functools
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.elements import Mesh
from warp_corot.materials.isotropic import Material
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.numbering import in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual
from warp_corot.mesh.tree import VOID

from .divided_mesh import DividedMesh, Numbers
from .partition import Partition

Ints = npt.NDArray[np.int32]
M = TypeVar("M", bound=Material)


class Part(SoftBody):
    """A rank's part of a body. Ghosts have no mass, so steps do not move them.

    Args:
        whole: The body.
        partition: The division of its mesh; None if this rank holds only its part.
        rank: The rank of the part.
        device: The device of the part; None: that of the body.

    Attributes:
        numbers: The numbers of its nodes and elements in the whole mesh.
        places, element_places: Their places in ``whole``, int32 [n] and [t].
        is_own: Whether this rank moves each node, bool [worlds * n].
    """

    def __init__(self, whole: SoftBody, partition: Partition | None, rank: int, device: wp.Device | None = None):
        self._whole = whole
        mesh, material = whole.mesh, whole.material
        if isinstance(mesh, DividedMesh):
            self.numbers = mesh.numbers
        else:
            assert partition is not None
            count = len(mesh.tets)
            mesh, self.numbers = numbered_part(mesh, partition, rank)
            material = part_of_material(material, self.numbers.elements, count)
        numbers = self.numbers.nodes, self.numbers.elements
        is_whole = mesh is not whole.mesh
        self.places, self.element_places = (
            (each if is_whole else np.arange(len(each))).astype(np.int32) for each in numbers
        )
        self.is_own = np.tile(self.numbers.owner == rank, whole.worlds)
        super().__init__(mesh, material, worlds=whole.worlds, device=device or whole.device, threads=1)
        self.threads = whole.threads  # for checkpoints
        of_whole = whole.mesh if isinstance(whole.mesh, DividedMesh) else whole.discretization
        self.discretization.smallest_volume = of_whole.smallest_volume

    def _discretized(self, mesh: Mesh, material: Material) -> Discretization:
        shared = mesh is self._whole.mesh and self.device == self._whole.device
        return self._whole.discretization if shared else super()._discretized(mesh, material)

    @property
    def masses(self) -> npt.NDArray[np.float64]:
        """Lumped masses of the nodes that this rank moves [kg], float64 [worlds * n]; zero for ghosts."""
        if isinstance(self._whole.mesh, DividedMesh):
            return np.where(self.is_own, super().masses, 0.0)
        # Nodes of a remeshed body have what they carry.
        return np.where(self.is_own, self._whole.masses[self.numbers.in_worlds(self._whole.worlds)], 0.0)

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
        number[self.places[own]] = 1
        here = np.flatnonzero((number[triangles] >= 0).any(axis=1)).astype(np.int32)
        number[self.places] = np.arange(len(self.numbers.nodes), dtype=np.int32)
        elements = np.searchsorted(self.element_places, parents[here]).astype(np.int32)
        return here, number[triangles[here]], elements


def numbered_part(mesh: Mesh, division: Partition, rank: int, *, prunes: bool = False) -> tuple[Mesh, Numbers]:
    """A rank's part of a mesh: the elements that it needs, in their order; and the numbers in the whole mesh.
    ``prunes``: see ``part_of_forest``."""
    kept = division.needed(mesh, rank)
    elements = np.flatnonzero(kept).astype(np.int32)
    others: dict[str, Ints] = {}
    part: Mesh
    if isinstance(mesh, TetForest):
        forest, order, stays = part_of_forest(mesh, kept, division.sharing[kept], prunes)
        part, nodes, others = forest, order[: forest.node_count], {"tree": stays, "lattice": order}
    else:
        nodes = np.unique(mesh.tets[kept]).astype(np.int32)
        number = np.full(len(mesh.points), -1, np.int32)
        number[nodes] = np.arange(len(nodes), dtype=np.int32)
        part = TetMesh(mesh.points[nodes], number[mesh.tets[kept]], up_axis=mesh.up_axis)
        part.element_groups = division.sharing[kept]
    counted = division.rank_of_element[elements] == rank
    return part, Numbers(nodes, elements, division.rank_of_node[nodes], counted, len(mesh.points), **others)


def part_of_forest(
    forest: TetForest, kept: npt.NDArray[np.bool_], groups: Ints, prunes: bool
) -> tuple[TetForest, Ints, Ints]:
    """The forest of some leaves; and the numbers of its lattice points and of its tetrahedra of all levels in the whole
    one.

    Args:
        forest: The whole one.
        kept: The leaves, bool [T].
        groups: The groups in which these may share their dilatation.
        prunes: Whether the tree loses tetrahedra of which the part has no leaf; otherwise they stay as void ones.
    """
    live = np.zeros(len(forest.tree.level), bool)
    live[forest.tree.leaves[kept]] = True
    tree, stays = live_or_void(forest.tree, live), np.arange(len(live))
    if prunes:
        tree, stays = pruned(tree, tree.first_child == VOID)
    real = in_order_of_leaves(tree)
    order = with_virtual(real, tree, forest.lattice)
    ends, tree = renumbered(order, forest.node_ends, tree)
    fill, labels = (None if each is None else each[kept] for each in (forest.fill, forest.labels))
    made = TetForest(
        forest.cells,
        forest.cell_size,
        forest.origin,
        forest.lattice[order],
        ends,
        tree,
        forest.up_axis,
        fill=fill,
        labels=labels,
        label_names=forest.label_names,
        leaf_groups=groups,
    )
    return made, order.astype(np.int32), stays.astype(np.int32)


def part_of_material(material: M, elements: npt.NDArray[np.integer], count: int) -> M:
    """The material of some of ``count`` elements."""
    found: dict[str, Any] = {}
    for field in dataclasses.fields(material):  # type: ignore[arg-type]
        values, tail = getattr(material, field.name), material.components.get(field.name, ())
        axis = np.ndim(values) - len(tail) - 1
        if axis >= 0 and np.shape(values)[axis] == count > 1:
            found[field.name] = np.take(values, elements, axis=axis)
    return dataclasses.replace(material, **found) if found else material  # type: ignore[type-var]
