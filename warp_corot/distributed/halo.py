"""The halo of a run on several processes (``solvers.halo.Halo``)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.plan import Awaited
from warp_corot.kernels.distributed import exchange as kernels
from warp_corot.solvers.halo import Floats, Halo, Owned, V

from .divided_mesh import DividedMesh
from .exchange import (
    CardExchange,
    ExchangeLists,
    HostExchange,
    PeerExchange,
    are_peers,
    in_worlds,
    nccl_of,
    reduce_on_cards,
    reproducible_sums,
)
from .multigrid import MultigridOfParts, has_multigrid
from .part import Part


class CommHalo(Halo):
    """The processes of an MPI communicator before they have parts.

    Args:
        comm: The communicator.
    """

    is_alone = False

    def __init__(self, comm: Any):
        self.comm = comm

    def max(self, value: V) -> V:
        return self._reduced(value, np.max, "MAX")

    def sum(self, value: V, addends: npt.NDArray[np.float64] | None = None) -> V:
        if addends is None:
            return self._reduced(value, np.sum, "SUM")
        total = reproducible_sums(addends.reshape(len(addends), -1), self.comm)
        return total.reshape(value.shape) if isinstance(value, np.ndarray) else type(value)(total[0])

    def _reduced(self, value: V, combined: Callable[..., Any], operation: str) -> V:
        if isinstance(value, wp.array):
            if value.device.is_cuda:
                reduce_on_cards(value.view(wp.float64).flatten() if operation == "SUM" else value, operation)
            else:
                own = value.numpy()
                own[...] = combined(self.comm.allgather(own), axis=0)
            return value
        found = combined(self.comm.allgather(value), axis=0)
        return found if isinstance(value, np.ndarray) else type(value)(found)


class OwnedPart(Owned):
    """What of a body a rank moves and counts.

    Args:
        whole, part: The body, and this rank's part of it.
        ranks: The halo.
        k: The body's number.
    """

    def __init__(self, whole: SoftBody, part: Part, ranks: MpiHalo, k: int):
        self.whole, self._part = whole, part
        worlds, own = part.worlds, part.numbers
        self.numbers, self.node_count = own.in_worlds(worlds), worlds * own.node_count
        self.places, self.nodes = in_worlds(part.places, worlds, whole.world_node_count), part.is_own
        self._elements = np.tile(own.counted, worlds)
        self._ghosts, self._copies = (
            wp.array(np.flatnonzero(~each).astype(np.int32), dtype=wp.int32, device=part.device)
            for each in (self.nodes, self._elements)
        )
        self.has_multigrid = has_multigrid(whole, part)
        self.multigrid = lambda options: MultigridOfParts(ranks, k, part, **options)
        self._bulk = self._found_bulk(ranks)

    def clear_ghosts(self, vectors: wp.array) -> None:
        inputs = [self._ghosts]
        wp.launch(kernels.clear_values, len(self._ghosts), inputs, [vectors], device=vectors.device)

    def clear_copies(self, energies: wp.array) -> None:
        inputs = [self._copies]
        wp.launch(kernels.clear_values, len(self._copies), inputs, [energies], device=energies.device)

    @property
    def counted(self) -> wp.array:
        return wp.array(self._elements.astype(np.int32), dtype=wp.int32, device=self._part.device)

    @property
    def bounds(self) -> Floats:
        mesh = self.whole.mesh
        return mesh.bounds if isinstance(mesh, DividedMesh) else super().bounds

    @property
    def bulk(self) -> tuple[float, float]:
        return self._bulk

    def _found_bulk(self, ranks: MpiHalo) -> tuple[float, float]:
        """See ``bulk``; all ranks must call."""
        mesh, part = self.whole.mesh, self._part
        if not isinstance(mesh, DividedMesh):
            return super().bulk
        own = part.numbers.counted
        moduli = (2.0 * part.discretization.mu.numpy() + part.discretization.lam.numpy()).astype(np.float64)
        if part.discretization.material_stride:
            moduli = moduli.reshape(part.worlds, -1)[:, own]
        here = np.array([float(moduli.sum()), moduli.size, float(np.sum(mesh.volumes[own]))])
        stiffness, count, volume = ranks.sum(here)
        return float(stiffness / count), float(volume)


class MpiHalo(CommHalo):
    """All processes of an MPI communicator, each with its part of every body.

    Args:
        comm: The communicator.
        wholes: The bodies.
        parts: This rank's part of each.
        reproducible: Whether sums are the same bit for bit for any number of ranks.
    """

    def __init__(self, comm: Any, wholes: Sequence[SoftBody], parts: Sequence[Part], *, reproducible: bool):
        super().__init__(comm)
        self.is_reproducible, self._parts = reproducible, parts
        self.device = parts[0].device
        if self.device.is_cuda:
            # Sums and maxima are recorded; NCCL must have begun before.
            nccl_of(self.device.alias)
        self.lists = [ExchangeLists.of(p.numbers.nodes, p.numbers.owner, p.worlds, comm) for p in parts]
        self._exchanges = [self.exchange_of(lists, k) for k, lists in enumerate(self.lists)]
        self._connected = len(parts)
        for part, exchange in zip(parts, self._exchanges, strict=True):
            if isinstance(exchange, CardExchange) and comm.size > 1:
                part.discretization.awaited = Awaited(~part.is_own, exchange.later)
        self._copies = [wp.zeros_like(part.state.displacements) for part in parts]
        bound = enumerate(zip(wholes, parts, strict=True))
        self._owned: dict[SoftBody, OwnedPart] = {part: OwnedPart(whole, part, self, k) for k, (whole, part) in bound}

    def exchange_of(
        self, lists: ExchangeLists, tag: int, kinds: Sequence[Any] = kernels.EXCHANGED
    ) -> HostExchange | CardExchange:
        """The exchange for some lists of places on this rank's device, of values of these types; all ranks must
        call."""
        if not self.device.is_cuda:
            return HostExchange(lists, self.comm, tag)
        return (PeerExchange if are_peers(self.device.alias) else CardExchange)(lists, self.device, kinds)

    def owned(self, body: SoftBody) -> Owned:
        return self._owned[body]

    def exchange(self, k: int, vectors: wp.array, *, copies: bool = False, overlaps: bool = False) -> wp.array:
        if copies:
            wp.copy(self._copies[k], vectors)
            vectors = self._copies[k]
        exchange, awaited = self._exchanges[k], self._parts[k].discretization.awaited
        if overlaps and isinstance(exchange, CardExchange) and awaited is not None and awaited.is_used:
            exchange.begin(vectors)
        else:
            exchange.launch(vectors)
        return vectors

    def wait(self) -> None:
        for exchange in self._exchanges:
            if isinstance(exchange, CardExchange):
                exchange.end()

    def connect(self, numbers: npt.NDArray[np.integer], own: npt.NDArray[np.bool_]) -> Callable[[wp.array], None]:
        everybody = self.comm.allgather(numbers[own])
        given = np.concatenate(everybody)
        order = np.argsort(given, kind="stable")
        giver = np.repeat(np.arange(self.comm.size), [len(each) for each in everybody])[order]
        owner = np.full(len(numbers), self.comm.rank, np.int32)
        taken = np.flatnonzero(~own & np.isin(numbers, given))
        owner[taken] = giver[np.searchsorted(given[order], numbers[taken])]
        self._connected += 1
        return self.exchange_of(ExchangeLists.of(numbers, owner, 1, self.comm), self._connected).launch
