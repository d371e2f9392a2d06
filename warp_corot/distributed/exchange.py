"""Exchanges of arrays' entries between ranks, through the host's memory, cards' memory or NCCL, and between a body and
its part; and sums over ranks that are the same bit for bit for any number of ranks.

NCCL is imported here only.
"""

from __future__ import annotations

import functools
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.distributed import exchange as kernels
from warp_corot.kernels.distributed import peers

from . import mpi

Ints = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]
#: A buffer for each neighbour.
Room = dict[int, npt.NDArray[Any]]

#: Bits of the whole numbers into which addends are split, so that sums of 2**32 of them fit into int64; and the binary
#: logarithm of the smallest unit.
BITS, LEAST_POWER = 30, -1020
#: Words from whose multiples arrays begin in memory that cards share, and those that make an allocation of its own.
ALIGNED, OWN_WORDS = 32, 1 << 19


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


@functools.cache
def nccl_of(alias: str) -> Any:
    """NCCL's communicator of all ranks; this rank has the card of this name.

    Raises:
        InputError: ``nccl4py`` is not installed.
    """
    try:
        import nccl.core as nccl
    except ImportError as error:
        raise InputError(f'runs on several cards need nccl4py ({error}); pip install "warp-corot[cards]"') from None
    comm = mpi.world()
    with wp.ScopedDevice(alias):
        name = comm.bcast(nccl.get_unique_id() if comm.rank == 0 else None, root=0)
        comm.Barrier()
        return nccl.Communicator.init(nranks=comm.size, rank=comm.rank, unique_id=name)


class CardExchange:
    """The exchange of a part's nodal values between cards: through NCCL, or see ``PeerExchange``.

    Args:
        halo: The lists of nodes to send and to receive.
        device: The card.
        kinds: The types of values that it exchanges.
    """

    def __init__(self, halo: ExchangeLists, device: wp.Device, kinds: Sequence[Any]):
        self._device = device
        self._sent, self._received = (_joined(lists, device) for lists in (halo.sent, halo.received))
        #: The stream on which it runs beside other launches, with a higher priority.
        self.aside = wp.Stream(device, priority=-1)
        self.is_under_way = False
        self._prepare(kinds)

    def _prepare(self, kinds: Sequence[Any]) -> None:
        self._nccl = nccl_of(self._device.alias)
        self._rooms = {kind: self._room_for(kind) for kind in kinds}

    def launch(self, nodal: wp.array) -> None:
        """Launch the exchange that gives ghosts their values, in a nodal array of one of the kinds; may be
        recorded."""
        import nccl.core as nccl

        stream, (received, by), (nodes, to) = wp.get_stream(self._device), self._received, self._sent
        out, given = self._rooms[nodal.dtype]
        wp.launch(kernels.GATHER[nodal.dtype], len(nodes), [nodes, nodal], [out], device=self._device)
        with nccl.group():
            for rank, start, end in to:
                self._nccl.send(_floats(out, start, end), rank, stream=stream)
            for rank, start, end in by:
                self._nccl.recv(_floats(given, start, end), rank, stream=stream)
        wp.launch(kernels.SCATTER[nodal.dtype], len(received), [received, given], [nodal], device=self._device)

    def begin(self, nodal: wp.array) -> None:
        """Launch the exchange so that it runs beside the following launches."""
        with wp.ScopedStream(self.aside):
            self.launch(nodal)
        self.is_under_way = True

    def end(self) -> None:
        """Let the following launches wait for the exchange that was begun."""
        if self.is_under_way:
            wp.get_stream(self._device).wait_stream(self.aside)
            self.is_under_way = False

    @contextmanager
    def later(self) -> Iterator[None]:
        """Launches in the block run after the exchange that was begun, and before the launches after the block."""
        with wp.ScopedStream(self.aside, sync_enter=not self.is_under_way, sync_exit=True):
            yield
        self.is_under_way = False

    def _room_for(self, kind: Any) -> tuple[wp.array, wp.array]:
        """The buffers for sent and received values."""
        out, given = (
            wp.zeros(len(nodes), dtype=kind, device=self._device) for nodes in (self._sent[0], self._received[0])
        )
        return out, given


class PeerExchange(CardExchange):
    """The same between cards of one machine that reach one another's memory: one launch, ``kernels.distributed.peers``.

    All ranks must make it together. A rank that sends to another one also receives from it, if only the number of the
    exchange: then a card is never two exchanges ahead of a neighbour.
    """

    def _prepare(self, kinds: Sequence[Any]) -> None:
        comm, device = mpi.world(), self._device
        (nodes, by), (_, to) = self._received, self._sent
        neighbours = sorted({rank for rank, *_ in (*by, *to)})
        widths = {kind: wp.types.type_size_in_bytes(kind) // 4 for kind in kinds}
        # What neighbours write: their counts, then the values of each kind, twice.
        begins, end = {}, -(-len(neighbours) // ALIGNED) * ALIGNED
        for kind, width in widths.items():
            begins[kind], end = end, end + -(-2 * width * len(nodes) // ALIGNED) * ALIGNED
        with wp.ScopedMempool(device, False):
            # An allocation of its own, which the driver shares with no other.
            self._shared = wp.zeros(-(-max(end, 1) // OWN_WORDS) * OWN_WORDS, dtype=wp.uint32, device=device)
        wp.synchronize_device(device)
        places = {rank: (neighbours.index(rank), 0) for rank in neighbours}
        places |= {rank: (neighbours.index(rank), start) for rank, start, _ in by}
        everybody = comm.allgather((self._shared.ipc_handle(), places, list(begins.values()), len(nodes)))
        self._theirs = {
            rank: wp.from_ipc_handle(everybody[rank][0], wp.uint32, self._shared.shape, device=device)
            for rank in neighbours
        }
        signals = [self._theirs[rank].ptr + 4 * everybody[rank][1][comm.rank][0] for rank in neighbours]
        self._signals = wp.array(np.array(signals, np.uint64), dtype=wp.uint64, device=device)
        self._arrived = self._shared[: len(neighbours)]
        self._clock = wp.zeros(peers.CLOCK, dtype=wp.uint32, device=device)
        self._ways = {}
        for k, (kind, width) in enumerate(widths.items()):
            targets = [np.zeros((2, 0), np.int64)]
            for rank, start, end in to:
                _, their_places, their_begins, their_count = everybody[rank]
                first = their_begins[k] + width * (their_places[comm.rank][1] + np.arange(end - start))
                targets.append(self._theirs[rank].ptr + 4 * (first + width * their_count * np.arange(2)[:, None]))
            room = self._shared[begins[kind] : begins[kind] + 2 * width * len(nodes)].reshape((2, width * len(nodes)))
            addresses = np.concatenate(targets, axis=1).astype(np.uint64)
            self._ways[kind] = width, wp.array(addresses, dtype=wp.uint64, device=device), room
        most = max([len(self._sent[0]), len(nodes)]) * max(widths.values(), default=0)
        self._blocks = min(max(-(-most // peers.BLOCK), 1), peers.MOST_BLOCKS) if neighbours else 0
        # No card may write before all have cleared their memory.
        comm.Barrier()

    def launch(self, nodal: wp.array) -> None:
        width, targets, room = self._ways[nodal.dtype]
        words = wp.array(ptr=nodal.ptr, dtype=wp.uint32, shape=(nodal.size, width), device=self._device)
        (received, _), (sent, _) = self._received, self._sent
        inputs = [width, sent, targets, self._signals, received, room, self._arrived]
        threads = peers.BLOCK * self._blocks
        wp.launch(peers.exchange, threads, inputs, [self._clock, words], device=self._device, block_dim=peers.BLOCK)


@functools.cache
def are_peers(alias: str) -> bool:
    """Whether all ranks' cards, of which this one has this name, reach one another's memory; all ranks must ask."""
    comm, device = mpi.world(), wp.get_device(alias)
    cards = comm.allgather((socket.gethostname(), alias))
    mine = all(
        host == socket.gethostname() and (name == alias or wp.is_peer_access_supported(name, device))
        for host, name in cards
    )
    return all(comm.allgather(mine and device.is_ipc_supported is not False))


def reduce_on_cards(values: wp.array, operation: str) -> None:
    """Replace the values of an array on a card by their ``SUM`` or ``MAX`` over all ranks; may be recorded."""
    import nccl.core as nccl

    own, stream = nccl_of(values.device.alias), wp.get_stream(values.device)
    own.allreduce(values, values, getattr(nccl, operation), stream=stream)


def _joined(lists: dict[int, Any], device: wp.Device) -> tuple[wp.array, list[tuple[int, int, int]]]:
    """All lists in one array, and the begin and the end of each rank's list."""
    ends = np.cumsum([len(nodes) for nodes in lists.values()])
    nodes = np.concatenate([*lists.values(), np.zeros(0, np.int32)]).astype(np.int32)
    places = [(rank, int(end) - len(lists[rank]), int(end)) for rank, end in zip(lists, ends, strict=True)]
    return wp.array(nodes, dtype=wp.int32, device=device), places


def _floats(vectors: wp.array, start: int, end: int) -> wp.array:
    part = vectors[start:end]
    words = part.size * wp.types.type_size_in_bytes(part.dtype) // 4
    return wp.array(ptr=part.ptr, dtype=wp.float32, shape=(words,), device=part.device)


class Places:
    """The places of some values in arrays of the whole body, and in those of its part.

    Args:
        whole, part: The places, int32 [n] both.
        whole_device, part_device: The devices of the arrays.
        direct: Whether values go from one array to the other in one launch; None: if both are on one device.
    """

    def __init__(
        self, whole: Ints, part: Ints, whole_device: wp.Device, part_device: wp.Device, *, direct: bool | None = None
    ):
        self.whole, self.part = whole, part
        self._direct = whole_device == part_device if direct is None else direct
        self._in_whole = wp.array(whole, dtype=wp.int32, device=whole_device)
        self._in_part = wp.array(part, dtype=wp.int32, device=part_device)

    def to_part(self, whole: wp.array, part: wp.array) -> None:
        """Copy the values of an array of the whole body to one of the part."""
        self._copy(whole, self._in_whole, self.whole, part, self._in_part)

    def to_whole(self, part: wp.array, whole: wp.array) -> None:
        """Copy the values of an array of the part to one of the whole body."""
        self._copy(part, self._in_part, self.part, whole, self._in_whole)

    def _copy(self, source: wp.array, sources: wp.array, numbers: Ints, found: wp.array, targets: wp.array) -> None:
        if self._direct:
            inputs = [sources, targets, source]
            wp.launch(kernels.move_values, len(numbers), inputs, [found], device=found.device)
            return
        values = wp.array(source.numpy()[numbers], dtype=source.dtype, device=found.device)
        wp.launch(kernels.scatter_values, len(numbers), [targets, values], [found], device=found.device)


def reproducible_sums(addends: Floats, comm: Any) -> Floats:
    """The sums of all ranks' addends, [n, columns] -> [columns], the same in any order; NaN where any addend is not
    finite.

    Each addend is split into whole numbers of smaller and smaller units, the same powers of two on all ranks. Sums of
    whole numbers are exact.
    """
    columns = addends.shape[1]
    bad = ~np.isfinite(addends).all(axis=0)
    left = np.where(bad, 0.0, addends)
    first = power = BITS * (1 + int(np.frexp(np.abs(left).max(initial=0.0))[1]) // BITS)
    parts, is_left = [], left.any(axis=1)
    while is_left.any() and power > LEAST_POWER:
        if 4 * np.count_nonzero(is_left) < len(left):
            left = left[is_left]
        power -= BITS
        unit = np.ldexp(1.0, power)
        whole = np.rint(left * (1.0 / unit))
        left = left - whole * unit
        parts.append(whole.astype(np.int64).sum(axis=0))
        is_left = left.any(axis=1)
    sums: dict[int, Any] = {}
    everywhere = comm.allgather((bad, first, parts))
    for _, highest, of_rank in everywhere:
        for number, part in enumerate(of_rank, start=1):
            sums[highest - BITS * number] = sums.get(highest - BITS * number, 0) + part
    # Add the smallest units first.
    total = sum((np.ldexp(sums[power].astype(np.float64), power) for power in sorted(sums)), np.zeros(columns))
    return np.where(np.any([bad for bad, *_ in everywhere], axis=0), np.nan, total)
