"""Groups of leaves that share a dilatation, in a forest whose leaves are not all in complete subtrees.

Groups are found from the bottom of the tree upwards. When eight or more leaves below an element are in no group yet
(there are at most 14), they form one. So a complete subtree of three levels is always a group. Fewer than eight leaves
of a root remain: four or more form a group; fewer join the remaining leaves of the other roots of their cube. No group
goes across a cut: what is left below a child of a torn element is one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.plan.tree import TORN
from warp_corot.mesh import TetForest, TetMesh

from .matching import neighbour_groups

#: Least number of leaves in a group below an element of the tree, and among the remaining leaves of a root.
LEAST, LEAST_OF_ROOT = 8, 4
#: Lattice intervals of a cube's edge are two to this power.
CUBE_BITS = 16


@dataclass(frozen=True)
class Groups:
    """Groups of a mesh's elements on the device, world after world.

    Attributes:
        starts: The place in ``members`` at which each group begins, and at which the last one ends, int32 [count + 1].
        members: The elements, group after group, int32.
    """

    starts: wp.array
    members: wp.array

    def __len__(self) -> int:
        return len(self.starts) - 1

    @classmethod
    def of_leaves(cls, forest: TetForest, leaves: npt.NDArray[np.integer], device: wp.Device, worlds: int) -> Groups:
        """The groups of some leaves of a forest, int [n], in each world."""
        return cls._of(group_numbers(forest, leaves), np.asarray(leaves), len(forest.tets), device, worlds)

    @classmethod
    def of_elements(cls, mesh: TetMesh, device: wp.Device, worlds: int) -> Groups:
        """The groups of all elements of a general mesh, in each world."""
        given = mesh.element_groups
        group = neighbour_groups(mesh.points, mesh.tets) if given is None else np.unique(given, return_inverse=True)[1]
        return cls._of(group, np.arange(len(mesh.tets)), len(mesh.tets), device, worlds)

    @classmethod
    def _of(
        cls,
        group: npt.NDArray[np.integer],
        elements: npt.NDArray[np.integer],
        in_world: int,
        device: wp.Device,
        worlds: int,
    ) -> Groups:
        """The groups from the elements and their group numbers, both int [n], of a world with this many elements."""
        # In the order of their first elements, so that a part has its groups in the order of the whole.
        _, first, group = np.unique(group, return_index=True, return_inverse=True)
        group = np.argsort(np.argsort(first))[group.ravel()]
        order = np.argsort(group, kind="stable")
        sizes = np.tile(np.bincount(group), worlds)
        members = elements[order] + in_world * np.arange(worlds)[:, None]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        return cls(*(wp.array(values.ravel(), dtype=wp.int32, device=device) for values in (starts, members)))


def group_numbers(forest: TetForest, leaves: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
    """The group of each given leaf of a forest, from 0; int32 [n]."""
    if forest.leaf_groups is not None:
        return np.unique(forest.leaf_groups[leaves], return_inverse=True)[1].astype(np.int32)
    group = np.full(len(leaves), -1, np.int32)
    above = forest.tree.leaves[leaves]
    level = np.array(forest.levels, dtype=np.int32)[leaves]
    count = 0
    for depth in range(int(level.max(initial=0)), -1, -1):
        here = np.flatnonzero((level == depth) & (group < 0))
        elements, element, sizes = np.unique(above[here], return_inverse=True, return_counts=True)
        makes_one = sizes >= (LEAST if depth else LEAST_OF_ROOT)
        if depth and forest.tree.cut is not None:
            makes_one |= forest.tree.cut[forest.tree.above(elements, 1)] >= int(TORN)
        number = np.cumsum(makes_one, dtype=np.int32) - 1 + count
        grouped = makes_one[element]
        group[here[grouped]] = number[element[grouped]]
        count += int(makes_one.sum())
        if depth:
            rest = here[~grouped]
            above[rest] = forest.tree.above(above[rest], 1)
            level[rest] = depth - 1
    rest = np.flatnonzero(group < 0)
    if len(rest):
        corners, _ = forest.tree.rows(above[rest])
        _, of_cube = np.unique(cubes_of(forest, corners), axis=0, return_inverse=True)
        group[rest] = count + of_cube.ravel()
    return group


def cubes_of(forest: TetForest, roots: npt.NDArray[np.integer]) -> npt.NDArray[np.int32]:
    """The cubes of roots that are given by their nodes, int [n, 4]: their numbers along x, y and z, int32 [n, 3]."""
    corners: npt.NDArray[np.int32] = np.asarray(forest.lattice)[roots].min(axis=1) >> CUBE_BITS
    return corners
