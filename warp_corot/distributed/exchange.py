"""Lists of the nodes whose values are sent to each neighbour, and the exchange through the host's memory."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

Ints = npt.NDArray[np.int32]
#: A buffer for each neighbour.
Room = dict[int, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class ExchangeLists:
    """The values that a part sends and receives, neighbour by neighbour in ascending order of ranks.

    Attributes:
        sent: Neighbours, and the nodes whose values each gets, as numbers within the part, int32.
        received: Neighbours, and the ghosts whose values each sends.
    """

    sent: dict[int, Ints]
    received: dict[int, Ints]

    @classmethod
    def of(cls, nodes: npt.NDArray[np.integer], owner: Ints, worlds: int, comm: Any) -> ExchangeLists:
        """Make the lists; all ranks must call this.

        Args:
            nodes: The numbers of the part's nodes in the whole mesh, [n].
            owner: The rank that moves each of them, int32 [n].
            worlds: Number of copies of the body.
            comm: The ranks.
        """
        wanted: list[npt.NDArray[np.integer]] = []
        received = {}
        for rank in range(comm.size):
            ghosts = np.flatnonzero(owner == rank).astype(np.int32)
            # Both sides use the order of the numbers in the whole mesh.
            ghosts = ghosts[np.argsort(nodes[ghosts])] if rank != comm.rank else ghosts[:0]
            wanted.append(nodes[ghosts])
            if len(ghosts):
                received[rank] = in_worlds(ghosts, worlds, len(nodes))
        place = np.argsort(nodes)
        sent = {}
        for rank, asked in enumerate(comm.alltoall(wanted)):
            if len(asked):
                own = place[np.searchsorted(nodes[place], asked)].astype(np.int32)
                sent[rank] = in_worlds(own, worlds, len(nodes))
        return cls(sent, received)

    @classmethod
    def to_all(cls, own: Ints, comm: Any) -> ExchangeLists:
        """The lists with which every rank gets all values of an array whose places all ranks number alike.

        All ranks must call this.

        Args:
            own: The places of this rank's values, int32.
            comm: The ranks.
        """
        everybody = comm.allgather(own)
        received = {r: places for r, places in enumerate(everybody) if r != comm.rank and len(places)}
        sent = {r: own for r in range(comm.size) if r != comm.rank and len(own)}
        return cls(sent, received)

    @property
    def sent_bytes(self) -> int:
        """Bytes that one exchange of nodal vectors sends."""
        return 16 * sum(map(len, self.sent.values()))


class HostExchange:
    """The exchange of a part's nodal values through MPI, on the CPU.

    Args:
        halo: The lists of nodes to send and to receive.
        comm: The ranks.
        tag: The tag of its messages.
    """

    def __init__(self, halo: ExchangeLists, comm: Any, tag: int):
        self._halo, self._comm, self._tag = halo, comm, tag
        self._rooms: dict[tuple[Any, ...], tuple[Room, Room]] = {}

    def launch(self, nodal: wp.array) -> None:
        """Give ghosts their values, in a nodal array of any numbers or vectors."""
        comm, halo = self._comm, self._halo
        values = nodal.numpy()
        out, received = self._room_for(values)
        asked = [comm.Irecv(buffer, rank, self._tag) for rank, buffer in received.items()]
        for rank, nodes in halo.sent.items():
            np.take(values, nodes, axis=0, out=out[rank])
            asked.append(comm.Isend(out[rank], rank, self._tag))
        with comm.waiting("an exchange"):
            for request in asked:
                request.Wait()
        for rank, nodes in halo.received.items():
            values[nodes] = received[rank]

    def _room_for(self, values: npt.NDArray[Any]) -> tuple[Room, Room]:
        """The buffers for sent and received values."""
        kind = (values.dtype, *values.shape[1:])
        if kind not in self._rooms:
            out, received = (
                {rank: np.zeros((len(nodes), *values.shape[1:]), values.dtype) for rank, nodes in lists.items()}
                for lists in (self._halo.sent, self._halo.received)
            )
            self._rooms[kind] = out, received
        return self._rooms[kind]


def in_worlds(places: Ints, worlds: int, count: int) -> Ints:
    """Places of one world, of ``count``, in all worlds, int32 [worlds * n]."""
    return (places + count * np.arange(worlds, dtype=np.int32)[:, None]).ravel()
