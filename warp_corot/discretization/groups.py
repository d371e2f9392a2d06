"""Groups of elements that share a dilatation: their nodes, groups of neighbours, groups of a forest's leaves."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.elements import mean_dilatation_rows as kernels
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.plan.plan import TORN
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.topology import face_pairs

#: Groups in the form of ``kernels.elements.dilatation.share_in_groups``: starts, members, the number of groups
#: if launches cover more, and the number in launches.
Batch = tuple[wp.array, wp.array, wp.array, int]


@dataclass(frozen=True, eq=False)
class Members:
    """Groups, their elements and their nodes.

    Attributes:
        count: Number of groups in launches; some may be empty.
        entries: Total number of nodes of all groups.
        arrays: The arrays on the device.
        law: The shared dilatation.
    """

    count: int
    entries: int
    arrays: kernels.GroupNodes
    law: Dilatation

    @classmethod
    def of(cls, law: Dilatation, batches: list[Batch], nodes: wp.array, below: int | None = None) -> Members:
        """The members of the present mesh; waits for the device.

        Args:
            law: The shared dilatation.
            batches: Groups.
            nodes: The nodes of all elements, vec4i.
            below: Groups of elements from this number on are left empty; None: all count.
        """
        device = nodes.device
        # Subtrees store only their first leaf.
        places = [len(members) or 8 * groups for _, members, _, groups in batches]
        count, room = sum(groups for *_, groups in batches), sum(places)
        found = kernels.GroupNodes()
        found.ranges = wp.zeros(count, dtype=wp.vec2i, device=device)
        found.members, found.corners = (wp.zeros(room, dtype=wp.int32, device=device) for _ in range(2))
        first_group = first_place = 0
        for (starts, members, live, groups), more in zip(batches, places, strict=True):
            inputs = [starts, members, live, first_group, first_place]
            inputs += [np.iinfo(np.int32).max if below is None else below]
            wp.launch(kernels.list_members, groups, inputs, [found.ranges, found.members], device=device)
            first_group, first_place = first_group + groups, first_place + more
        found.ends = wp.zeros(count, dtype=wp.int32, device=device)
        wp.launch(kernels.count_nodes, count, [found.ranges, found.members, nodes], [found.ends], device=device)
        wp.utils.array_scan(found.ends, found.ends, inclusive=True)
        entries = int(found.ends[-1:].numpy()[0]) if count else 0
        found.nodes = wp.zeros(entries, dtype=wp.int32, device=device)
        wp.launch(kernels.name_nodes, count, [nodes], [found], device=device)
        return cls(count, entries, found, law)


# --- groups of neighbours, by matching -------------------------------------------------------------------------------
#
# Groups of neighbouring elements of any mesh, by matching.
#
# Three times, each group joins the group with the nearest centre among those with which it shares a face. Two groups
# join if each is the other's nearest, and the remaining ones search again among themselves. So groups have eight
# neighbouring elements if the mesh has enough of them. Groups that stay small then join a neighbour that has room.


Integers = npt.NDArray[np.integer[Any]]
Numbers = npt.NDArray[np.floating[Any]]

#: Number of times that groups join in twos, and of searches of the remaining groups each time.
DOUBLINGS, LOOKS = 3, 8
#: Groups of fewer elements join a neighbour, which then has at most this many.
SMALL, MOST = 6, 14


def neighbour_groups(points: Numbers, tets: Integers) -> npt.NDArray[np.int32]:
    """The group of each element, from 0; int32 [T].

    Args:
        points: Rest positions, [N, 3].
        tets: Nodes of the elements, [T, 4].
    """
    group: Integers = np.arange(len(tets))
    centre: Numbers = np.asarray(points, np.float64)[tets].mean(axis=1)
    size: Numbers = np.ones(len(tets))
    pairs: Integers = face_pairs(tets)
    for _ in range(DOUBLINGS):
        open_pairs, joined = pairs, np.arange(len(size))
        for _ in range(LOOKS):
            first, second = mutual_neighbours(open_pairs, centre)
            joined[second] = first
            taken = np.zeros(len(size), bool)
            taken[first] = taken[second] = True
            open_pairs = open_pairs[~taken[open_pairs].any(axis=1)]
        group, centre, size, pairs = _joined(joined, group, centre, size, pairs)
    for _ in range(LOOKS):
        of_pairs = size[pairs]
        fit = (of_pairs.min(axis=1) < SMALL) & (of_pairs.sum(axis=1) <= MOST)
        first, second = mutual_neighbours(pairs[fit], centre)
        joined = np.arange(len(size))
        joined[second] = first
        group, centre, size, pairs = _joined(joined, group, centre, size, pairs)
    return group.astype(np.int32)


def mutual_neighbours(pairs: Integers, centre: Numbers) -> tuple[Integers, Integers]:
    """The pairs of groups in which each is the other's nearest by its centre: the first and the second groups."""
    far = np.linalg.norm(centre[pairs[:, 0]] - centre[pairs[:, 1]], axis=1)
    both = pairs[np.argsort(-far, kind="stable")]
    nearest = np.full(len(centre), -1)
    # The last value written to a place stays: the nearest one.
    nearest[both.ravel()] = both[:, ::-1].ravel()
    first = np.flatnonzero(nearest >= 0)
    first = first[(nearest[nearest[first]] == first) & (first < nearest[first])]
    return first, nearest[first]


def _joined(
    joined: Integers, group: Integers, centre: Numbers, size: Numbers, pairs: Integers
) -> tuple[Integers, Numbers, Numbers, Integers]:
    """Groups of elements, with centres, sizes and pairs of neighbours, after some groups have joined."""
    kept, number = np.unique(joined, return_inverse=True)
    sizes = np.bincount(number, size).astype(np.float64)
    centres: Numbers = np.stack([np.bincount(number, size * x) for x in centre.T], axis=1) / sizes[:, None]
    low, high = np.sort(number[pairs], axis=1).T
    keys = np.unique((low * len(kept) + high)[low != high])
    left: Integers = np.stack(np.divmod(keys, len(kept)), axis=1)
    of_elements: Integers = number[group]
    return of_elements, centres, sizes, left


# --- groups of a forest's leaves -------------------------------------------------------------------------------------
#
# Groups of leaves that share a dilatation, in a forest whose leaves are not all in complete subtrees.
#
# Groups are found from the bottom of the tree upwards. When eight or more leaves below an element are in no group yet
# (there are at most 14), they form one. So a complete subtree of three levels is always a group. Fewer than eight
# leaves of a root remain: four or more form a group; fewer join the remaining leaves of the other roots of their
# cube. No group goes across a cut: what is left below a child of a torn element is one.


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
