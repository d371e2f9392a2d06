"""Groups of neighbouring elements of any mesh, by matching.

Three times, each group joins the group with the nearest centre among those with which it shares a face. Two groups join
if each is the other's nearest, and the remaining ones search again among themselves. So groups have eight neighbouring
elements if the mesh has enough of them. Groups that stay small then join a neighbour that has room.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

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


def face_pairs(tets: Integers) -> npt.NDArray[np.int64]:
    """Pairs of elements that share a face, int64 [P, 2]."""
    corners = np.sort(np.asarray(tets, np.int64), axis=1)
    faces = corners[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3)
    order = np.lexsort(faces.T)
    same = (faces[order[1:]] == faces[order[:-1]]).all(axis=1)
    return np.stack([order[:-1][same] // 4, order[1:][same] // 4], axis=1)


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
