"""Parts of general meshes from elements that ranks have in any order: no rank ever holds the whole mesh.

Every node has a home, the rank that keeps what is known of it. Nodes are divided among homes by their numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.surfaces.boundary import boundary_faces, signed_volumes

from .divided_mesh import DividedTetMesh, Numbers, of_whole
from .partition import along_curve

Longs = npt.NDArray[np.int64]
Ints = npt.NDArray[np.int32]

#: Keys along the curve that each rank gives to divide it among ranks.
SAMPLES = 4096


class Homes:
    """The homes of nodes, each with the coordinates of its own.

    Attributes:
        ends: As given.

    Args:
        points: The coordinates of this rank's nodes [m], float64 [n, 3], those of the numbers ``ends[rank]`` to
            ``ends[rank + 1]``.
        ends: The first number of each home, and the number of all nodes, int64 [ranks + 1].
        comm: The ranks.
    """

    def __init__(self, points: npt.NDArray[np.float64], ends: Longs, comm: Any):
        self._points, self.ends, self._comm = points, ends, comm

    def coordinates(self, nodes: Longs) -> npt.NDArray[np.float64]:
        """The coordinates of ascending nodes [m], float64 [n, 3]; all ranks must call this."""
        return fetched(self._points, self.ends, nodes, self._comm)

    def owners(self, nodes: Longs, others: Longs) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
        """The ranks that move nodes, the lowest of all that have elements around each; all ranks must call this.

        Args:
            nodes: The nodes of this rank's own elements, ascending.
            others: Other nodes of which it asks, ascending.
        """
        comm, first = self._comm, self.ends[self._comm.rank]
        lowest = np.full(len(self._points), comm.size, np.int32)
        given = comm.alltoall(self._by_home(nodes))
        for rank in reversed(range(comm.size)):
            lowest[given[rank] - first] = rank
        asked = comm.alltoall(self._by_home(others))
        answers = [comm.alltoall([lowest[each - first] for each in wanted]) for wanted in (given, asked)]
        found = np.concatenate(answers[0]), np.concatenate(answers[1])
        return found

    def _by_home(self, nodes: Longs) -> list[Longs]:
        return np.split(nodes, np.searchsorted(nodes, self.ends[1:-1]))


def fetched(values: npt.NDArray[Any], ends: Longs, wanted: Longs, comm: Any) -> npt.NDArray[Any]:
    """Values by number, each from the rank that keeps it; all ranks must call this.

    Args:
        values: Those of this rank, of the numbers ``ends[rank]`` to ``ends[rank + 1]``.
        ends: The first number of each rank, and the number of all, int64 [ranks + 1].
        wanted: The numbers, ascending.
        comm: The ranks.
    """
    asked = comm.alltoall(np.split(wanted, np.searchsorted(wanted, ends[1:-1])))
    return np.concatenate(comm.alltoall([values[each - ends[comm.rank]] for each in asked]))


def moved_along_curve(tets: Longs, elements: Longs, homes: Homes, comm: Any) -> tuple[Longs, Longs]:
    """The same elements, each on the rank whose piece of the curve through all elements' centres has it; all ranks must
    call this.

    Args:
        tets: The nodes of this rank's elements [n, 4].
        elements: The numbers of these [n].
        homes: The homes of the nodes.
        comm: The ranks.
    """
    nodes, corners = np.unique(tets, return_inverse=True)
    centre = homes.coordinates(nodes)[corners.reshape(-1, 4)].mean(axis=1)
    ends = np.array([centre.min(axis=0, initial=np.inf), -centre.max(axis=0, initial=-np.inf)])
    low, high = np.min(comm.allgather(ends), axis=0) * [[1.0], [-1.0]]
    keys = along_curve(centre, low, max(float((high - low).max()), 1e-300))
    order = np.argsort(keys, kind="stable")
    count = min(SAMPLES, len(keys))
    places = (np.arange(count) * len(keys)) // max(count, 1)
    given = comm.allgather((keys[order][places], len(keys) / max(count, 1)))
    samples = np.concatenate([each for each, _ in given])
    weights = np.concatenate([np.full(len(each), weight) for each, weight in given])
    turn = np.argsort(samples, kind="stable")
    shares = np.cumsum(weights[turn]) / weights.sum()
    splits = samples[turn][np.searchsorted(shares, np.arange(1, comm.size) / comm.size)]
    pieces = np.split(order, np.searchsorted(keys[order], splits))
    parts = [comm.alltoall([values[piece] for piece in pieces]) for values in (tets, elements)]
    tets, elements = (np.concatenate(part) for part in parts)
    ascending = np.argsort(elements)
    return tets[ascending], elements[ascending]


def assembled(
    tets: Longs,
    elements: Longs,
    node_count: int,
    homes: Homes,
    comm: Any,
    described: Callable[[Longs, Longs], dict[str, Any]],
    **options: Any,
) -> DividedTetMesh:
    """This rank's part of a mesh, from the elements that it counts; all ranks must call this.

    Args:
        tets: The nodes of these elements in the whole mesh, int64 [n, 4].
        elements: The numbers of these elements in the whole mesh, ascending, int64 [n].
        node_count: Number of nodes of the whole mesh.
        homes: The homes of the nodes.
        comm: The ranks.
        described: Gives options of ``TetMesh`` for the part's nodes and elements, by their ascending numbers in the
            whole mesh; all ranks call it.
        options: Further options.
    """
    none = np.zeros(0, np.int64)
    owner, _ = homes.owners(np.unique(tets), none)
    nodes, corners = np.unique(tets, return_inverse=True)
    of_element = owner[corners.reshape(-1, 4)]
    wanted = [np.flatnonzero((of_element == rank).any(axis=1) & (rank != comm.rank)) for rank in range(comm.size)]
    copies = [np.concatenate(comm.alltoall([values[each] for each in wanted])) for values in (tets, elements)]
    all_tets, all_elements = np.concatenate([tets, copies[0]]), np.concatenate([elements, copies[1]])
    order = np.argsort(all_elements)
    all_tets, counted = all_tets[order], order < len(elements)
    here, corners = np.unique(all_tets, return_inverse=True)
    places: Ints = corners.reshape(-1, 4).astype(np.int32)
    points = homes.coordinates(here)
    owners = np.zeros(len(here), np.int32)
    is_own = np.isin(here, nodes, assume_unique=True)
    owners[is_own], owners[~is_own] = homes.owners(nodes, here[~is_own])
    numbers = Numbers(
        here,
        all_elements[order],
        owners,
        counted,
        node_count,
        *(np.arange(count, dtype=np.int32) for count in (len(here), len(places))),
    )
    return DividedTetMesh(
        points,
        places,
        numbers=numbers,
        **of_whole(points, np.abs(signed_volumes(points, places[counted])), comm),
        outer=_outer(tets, here, homes, comm),
        **described(here, all_elements[order]),
        **options,
    )


def _outer(tets: Longs, here: Longs, homes: Homes, comm: Any) -> Ints:
    """The triangles of counted elements that belong to one element of the whole mesh, by places in ``here``."""
    once = np.sort(here[boundary_faces(np.searchsorted(here, tets))[0]], axis=1)
    once = once[np.argsort(once[:, 0], kind="stable")]
    # The home of its first node sees every triangle that only one element of a rank has.
    places = np.split(np.arange(len(once)), np.searchsorted(once[:, 0], homes.ends[1:-1]))
    given = comm.alltoall([once[each] for each in places])
    _, inverse, count = np.unique(np.concatenate(given), axis=0, return_inverse=True, return_counts=True)
    single = np.split((count == 1)[inverse.ravel()], np.cumsum([len(each) for each in given])[:-1])
    mine = np.concatenate(comm.alltoall(single))
    return np.searchsorted(here, once[mine]).astype(np.int32)
