"""The exchange between cards through NCCL, launched on Warp's stream and recorded with the launches around it.

NCCL is imported here only.
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.kernels.distributed import exchange as kernels

from . import mpi
from .exchange import ExchangeLists


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
    """The exchange of a part's nodal values between cards.

    Args:
        halo: The lists of nodes to send and to receive.
        device: The card.
        kinds: The types of values that it exchanges.
    """

    def __init__(self, halo: ExchangeLists, device: wp.Device, kinds: Sequence[Any] = kernels.EXCHANGED):
        self._nccl, self._device = nccl_of(device.alias), device
        self._sent, self._received = (_joined(lists, device) for lists in (halo.sent, halo.received))
        #: The stream on which it runs beside other launches, with a higher priority.
        self.aside = wp.Stream(device, priority=-1)
        self.is_under_way = False
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


def take_most(values: wp.array) -> None:
    """Replace the values of an array on a card by the largest ones of all ranks; may be recorded."""
    import nccl.core as nccl

    own, stream = nccl_of(values.device.alias), wp.get_stream(values.device)
    own.allreduce(values, values, nccl.MAX, stream=stream)


def add_up(values: wp.array) -> None:
    """Replace the values of an array on a card by the sums over all ranks; may be recorded."""
    import nccl.core as nccl

    own, stream = nccl_of(values.device.alias), wp.get_stream(values.device)
    own.allreduce(values, values, nccl.SUM, stream=stream)


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
