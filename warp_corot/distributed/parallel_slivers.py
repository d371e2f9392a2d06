"""Nearly empty elements of a mesh in parts: all ranks choose together which are given up."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from warp_corot.mesh.growing.cut import face_pairs, linked
from warp_corot.mesh.growing.slivers import FEW_ELEMENTS, Filling, LumpedError, without_small
from warp_corot.mesh.growing.strays import strays_among

from .faces import Faces
from .root_cube_partition import RootCubePartition, places_of

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Ints = npt.NDArray[np.int32]
Longs = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Elements:
    """A rank's elements that hold some of a body.

    Attributes:
        tets: int32 [n, 4].
        keys: The nodes' keys, the same on all ranks, int64.
        held, volume: The volume of the body in each, and its own [n].
        faces: Their faces to other ranks' elements.
        firsts: The number of each rank's first element in the whole mesh, and that of all, int64 [ranks + 1].
    """

    tets: Ints
    keys: Longs
    held: Floats
    volume: Floats
    faces: Faces
    firsts: Longs


def without_slivers(
    elements: Elements, sliver: float, domain: Domain, partition: RootCubePartition
) -> tuple[Floats, Bools, str]:
    """What ``from_domain`` gives up of a whole mesh; all ranks must call this.

    Small elements, their neighbours and very small parts of the mesh stand for themselves. All ranks learn of these,
    and of how many other elements each connected rest has. So each finds the same choice, the one of the whole mesh.

    Returns:
        The new volumes of the body in this rank's elements; which of these are given up; and a sentence about pieces
        that are left out, empty if they hold next to nothing.
    """
    graph = _Graph(elements, sliver, partition)
    while True:
        filling = graph.filling()
        try:
            volumes, given_up = without_small(filling)
        except LumpedError as error:
            graph.resolve(filling, error.lumps)
        except _MissingError as error:
            graph.resolve_elements(error.elements)
        else:
            stray, said = strays_among(filling.pairs, volumes, given_up, filling.counts, domain)
            return *graph.here(volumes, given_up | stray), said


class _MissingError(Exception):
    """Elements that must stand for themselves."""

    def __init__(self, elements: Longs):
        super().__init__(f"{len(elements)} elements")
        self.elements = elements


class _Graph:
    """The elements that stand for themselves, and connected groups of the others."""

    def __init__(self, elements: Elements, sliver: float, partition: RootCubePartition):
        comm = partition.comm
        self._elements, self._comm = elements, comm
        self._first = int(elements.firsts[comm.rank])
        self._least = sliver * elements.volume
        self._pairs = face_pairs(elements.tets)
        self._total = float(comm.allreduce(float(elements.volume.sum())))
        small = elements.held < self._least
        near = small.copy()
        near[self._pairs[small[self._pairs].any(axis=1)]] = True
        faces = elements.faces
        near[self._told(faces.others[small[faces.own]])] = True
        self._single = near
        rest = self._lumps()
        self._single |= np.bincount(rest, ~near, len(near))[rest] <= FEW_ELEMENTS

    def filling(self) -> Filling:
        """The elements and groups of all ranks."""
        elements, comm, single = self._elements, self._comm, self._single
        lump, numbers = self._lumps(), self._first + np.arange(len(single))
        last = np.full(len(single), -1, np.int64)
        np.maximum.at(last, lump, numbers)
        #: What stands for each element: itself, or the last one of its group.
        self._number = np.where(single, numbers, last[lump])
        names, place = np.unique(self._number, return_inverse=True)
        place = place.ravel()
        held = np.bincount(place, elements.held, len(names))
        counts = np.bincount(place, minlength=len(names))
        least = np.zeros(len(names))
        least[place[single]] = self._least[single]
        faces = elements.faces
        owner = np.searchsorted(elements.firsts, faces.others, side="right") - 1
        later = owner > comm.rank
        asked = comm.alltoall([faces.others[owner == rank] for rank in range(comm.size)])
        told = comm.alltoall([self._number[each - self._first] for each in asked])
        across = np.full(len(faces.others), -1, np.int64)
        for rank, answer in enumerate(told):
            across[owner == rank] = answer
        links = np.concatenate([self._number[self._pairs], np.stack([self._number[faces.own], across], axis=1)[later]])
        links = np.unique(np.sort(links[links[:, 0] != links[:, 1]], axis=1), axis=0)
        given = comm.allgather((names, held, least, counts, links))
        self._names, held, least, counts, links = (np.concatenate(each) for each in zip(*given, strict=True))
        pairs = np.searchsorted(self._names, links)
        return Filling(pairs, held, least, counts, self._total, self._anchors)

    def resolve(self, filling: Filling, lumps: npt.NDArray[np.intp]) -> None:
        """Let the elements of some groups stand for themselves."""
        self._single |= np.isin(self._number, self._names[lumps])

    def resolve_elements(self, elements: Longs) -> None:
        """Let some elements of the whole mesh stand for themselves."""
        own = elements[(elements >= self._first) & (elements < self._elements.firsts[self._comm.rank + 1])]
        self._single[own - self._first] = True

    def here(self, volumes: Floats, given_up: Bools) -> tuple[Floats, Bools]:
        """What was found for this rank's elements."""
        place = np.searchsorted(self._names, self._number)
        return np.where(self._single, volumes[place], self._elements.held), given_up[place]

    def _lumps(self) -> npt.NDArray[np.intp]:
        """The connected group of each element; those that stand for themselves are groups, too."""
        rest = ~self._single
        found: npt.NDArray[np.intp] = linked(self._pairs[rest[self._pairs].all(axis=1)], len(rest))
        return found

    def _told(self, numbers: Longs) -> Longs:
        """This rank's elements among those that any rank names by their numbers in the whole mesh."""
        comm, firsts = self._comm, self._elements.firsts
        owner = np.searchsorted(firsts, numbers, side="right") - 1
        taken = comm.alltoall([numbers[owner == rank] for rank in range(comm.size)])
        return np.concatenate(taken) - self._first

    def _anchors(self, suspects: Bools) -> Longs:
        """See ``Filling``; all ranks must call this.

        Raises:
            _MissingError: Some of the elements found do not stand for themselves.
        """
        comm, elements = self._comm, self._elements
        # All suspects stand for themselves: their pieces are small, or have small elements only.
        names = self._names[suspects]
        here = places_of(names, self._number)
        own = np.flatnonzero(here >= 0)
        corners = np.full((len(names), 4), -1, np.int64)
        corners[own] = elements.keys[elements.tets[here[own]]]
        corners = comm.allreduce(corners, op=np.maximum)
        last = np.full(len(elements.keys), -1, np.int64)
        rest = np.flatnonzero(~np.isin(self._number, names))
        last[elements.tets[rest]] = (self._first + rest)[:, None]
        used = np.flatnonzero(last >= 0)
        place = places_of(corners.ravel(), elements.keys[used])
        at = np.append(last[used], -1)[place].reshape(-1, 4).max(axis=1)
        at = comm.allreduce(at, op=np.maximum)
        place = places_of(at, self._names)
        lumped = np.unique(at[(at >= 0) & ~self._stand_alone(at)])
        if len(lumped):
            raise _MissingError(lumped)
        return place

    def _stand_alone(self, numbers: Longs) -> Bools:
        """Which elements of the whole mesh stand for themselves; all ranks must call this."""
        own = (numbers >= self._first) & (numbers < self._elements.firsts[self._comm.rank + 1])
        found = np.zeros(len(numbers), bool)
        found[own] = self._single[numbers[own] - self._first]
        alone: Bools = self._comm.allreduce(found, op=np.maximum)
        return alone
