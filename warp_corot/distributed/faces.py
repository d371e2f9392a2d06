"""Faces between elements of different ranks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.boundary import boundary_faces

from .root_cube_partition import RootCubePartition, places_of

Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Faces:
    """The faces of a rank's elements that belong to one of them only.

    Attributes:
        outer: Those on the surface of the whole mesh, int32 [F, 3].
        own, others: Pairs of one of this rank's elements and one of another rank, which share a face; the other's
            number in the whole mesh; int64 [m] both.
    """

    outer: Ints
    own: Longs
    others: Longs


def faces_of(tets: Ints, lattice: Ints, first: int, partition: RootCubePartition) -> Faces:
    """Find out which faces of ranks' elements are the same; all ranks must call this.

    Args:
        tets: The nodes of this rank's elements [n, 4].
        lattice: Lattice points of the nodes.
        first: The number of the first element in the whole mesh.
        partition: The cubes of each rank.
    """
    comm = partition.comm
    triangles, parents = boundary_faces(tets)
    # The corners in one order name a face on all ranks.
    keys = np.sort(partition.keys(lattice[triangles.ravel()]).reshape(-1, 3), axis=1)
    own, others = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    inner = np.zeros(len(triangles), bool)
    places = partition.across(lattice[triangles])
    taken = comm.alltoall([(keys[each], first + parents[each].astype(np.int64)) for each in places])
    for mine, (their_keys, elements) in zip(places, taken, strict=True):
        found = places_of(*_numbers(keys[mine], their_keys))
        both = found >= 0
        inner[mine[both]] = True
        own.append(parents[mine[both]].astype(np.int64))
        others.append(elements[found[both]])
    return Faces(triangles[~inner], np.concatenate(own), np.concatenate(others))


def _numbers(one: Longs, other: Longs) -> tuple[Longs, Longs]:
    """Numbers that are the same for the same rows of both [n, 3], [m, 3]."""
    _, number = np.unique(np.concatenate([one, other]), axis=0, return_inverse=True)
    number = number.ravel()
    return number[: len(one)], number[len(one) :]
