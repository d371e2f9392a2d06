"""The ranks of a run on several processes, in the form for steps and checks (``solvers.ranks.Ranks``)."""

from __future__ import annotations

import functools
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.awaited import Awaited
from warp_corot.kernels.distributed import exchange as kernels
from warp_corot.kernels.stepping import balance
from warp_corot.kernels.stepping import pace as clock
from warp_corot.kernels.stepping.pace import Pace
from warp_corot.solvers.ranks import Floats, Ints, Ranks

from .cards import CardExchange, add_up, take_most
from .directions import normal_numbers
from .divided_mesh import DividedMesh
from .graphs import keep_priorities
from .halo import Halo, HostExchange
from .multigrid import MultigridOfParts, has_multigrid
from .parts import Part
from .reproducible_sums import reproducible_sums
from .surfaces import SurfacePlaces

#: Number of times that a row of exchanges is timed.
TIMED = 5


class Together(Ranks):
    """The processes of an MPI communicator before they have parts."""

    def __init__(self, comm: Any):
        self._comm = comm

    def most(self, value: float) -> float:
        return max(self._comm.allgather(value))


class MpiRanks(Ranks):
    """All processes of an MPI communicator, each with its part of every body.

    Args:
        comm: The communicator.
        wholes: The bodies.
        parts: This rank's part of each.
        settled: Whether sums are the same bit for bit for any number of ranks.
        records: Whether steps can be recorded on cards; they cannot if the number of iterations is not known.
    """

    is_alone = False

    def __init__(self, comm: Any, wholes: Sequence[SoftBody], parts: Sequence[Part], *, settled: bool, records: bool):
        self.comm, self.is_settled = comm, settled
        self.speaks = comm.rank == 0
        self.device = parts[0].device
        self.can_record = self.device.is_cuda and records
        self._wholes = dict(zip(parts, wholes, strict=True))
        self._parts = parts
        self._bulks: dict[SoftBody, tuple[float, float]] = {part: self._bulk(part) for part in parts}
        self.halos = halos = [Halo.of(part.numbers.nodes, part.numbers.owner, part.worlds, comm) for part in parts]
        self._exchanges = [self.exchange_of(halo, k) for k, halo in enumerate(halos)]
        for part, exchange in zip(parts, self._exchanges, strict=True):
            if isinstance(exchange, CardExchange) and comm.size > 1:
                ghosts = np.tile(part.numbers.owner != comm.rank, part.worlds)
                part.discretization.awaited = Awaited(ghosts, exchange.later)
        self._copies = [wp.zeros_like(part.state.displacements) for part in parts]
        self._ghosts = [self._places_of_ghosts(part) for part in parts]
        self._copied_energies = [self._places_of_copies(part) for part in parts]

    def exchange_of(
        self, halo: Halo, tag: int, kinds: Sequence[Any] = kernels.EXCHANGED
    ) -> HostExchange | CardExchange:
        """The exchange for some lists of places on this rank's device, of values of these types."""
        return CardExchange(halo, self.device, kinds) if self.device.is_cuda else HostExchange(halo, self.comm, tag)

    def _places_of_ghosts(self, part: Part) -> wp.array:
        """Nodes that other ranks move, in all worlds, int32."""
        ghosts = np.tile(part.numbers.owner != self.comm.rank, part.worlds)
        return wp.array(np.flatnonzero(ghosts).astype(np.int32), dtype=wp.int32, device=self.device)

    def _places_of_copies(self, part: Part) -> wp.array:
        """Elements that other ranks count, in all worlds, int32."""
        own = np.tile(part.numbers.counted, part.worlds)
        return wp.array(np.flatnonzero(~own).astype(np.int32), dtype=wp.int32, device=self.device)

    # --- launches --------------------------------------------------------------------------------------------------

    def take_graph(self, graph: wp.Graph) -> None:
        if self.device.is_cuda and self.comm.size > 1:
            keep_priorities(graph)

    def complete(self, k: int, vectors: wp.array) -> None:
        self._exchanges[k].launch(vectors)

    def begin_completion(self, k: int, vectors: wp.array) -> None:
        exchange, awaited = self._exchanges[k], self._parts[k].discretization.awaited
        if isinstance(exchange, CardExchange) and awaited is not None and awaited.is_used:
            exchange.begin(vectors)
        else:
            exchange.launch(vectors)

    def end_completion(self) -> None:
        for exchange in self._exchanges:
            if isinstance(exchange, CardExchange):
                exchange.end()

    def completed(self, k: int, vectors: wp.array) -> wp.array:
        wp.copy(self._copies[k], vectors)
        self.complete(k, self._copies[k])
        return self._copies[k]

    def take_most(self, values: wp.array) -> None:
        if self.device.is_cuda:
            take_most(values)
        else:
            own = values.numpy()
            own[...] = np.max(self.comm.allgather(own), axis=0)

    def agree_on_changes(self, changed: wp.array, clock_now: Pace) -> None:
        self.take_most(changed)
        place = int(clock.BEFORE)
        before = clock_now.seconds[place : place + 1]
        wp.launch(kernels.forget_length, 1, [changed], [before], device=self.device)

    def leave_own(self, k: int, energies: wp.array) -> None:
        places = self._copied_energies[k]
        wp.launch(kernels.clear_energies, len(places), [places], [energies], device=self.device)

    def number_directions(self, k: int, directions: wp.array) -> None:
        found = np.zeros((len(directions), 4), np.float32)
        count = self._parts[k].node_count
        numbers = normal_numbers(self._numbers(k), 20130705)
        found[:count, :3] = numbers / np.linalg.norm(numbers, axis=1, keepdims=True)
        directions.assign(found)

    def number_motion(self, k: int, inverse_mass: wp.array, motion: wp.array) -> None:
        found = np.zeros((len(motion), 4), np.float32)
        count = self._parts[k].node_count
        found[:count, :3] = normal_numbers(self._numbers(k), 0)
        found[inverse_mass.numpy()[: len(motion)] == 0.0] = 0.0
        motion.assign(found)

    def add_up(self, parts: wp.array, sums: wp.array) -> None:
        if self.is_settled:
            total = reproducible_sums(parts.numpy().reshape(-1, 1), self.comm)[0]
        else:
            total = float(np.sum(self.comm.allgather(float(sums.numpy().sum()))))
        found = np.zeros(len(sums))
        found[0] = total
        sums.assign(found)

    # --- implicit steps --------------------------------------------------------------------------------------------

    def take_in_parts(self, parts: wp.array, columns: Sequence[int], most: bool) -> None:
        chosen = list(columns)
        values = parts.numpy()
        own = values[:, :, chosen]
        if most:
            total = np.max(self.comm.allgather(own.max(axis=1)), axis=0)
        elif self.is_settled:
            addends = np.moveaxis(own, 0, 1).reshape(own.shape[1], -1)
            total = reproducible_sums(addends, self.comm).reshape(len(own), -1)
        else:
            total = np.sum(self.comm.allgather(own.sum(axis=1)), axis=0)
        values[:, :, chosen] = 0.0
        values[:, 0, chosen] = total
        if self.device.is_cuda:
            parts.assign(values)

    def has_multigrid(self, k: int) -> bool:
        return has_multigrid(self.whole(self._parts[k]), self._parts[k])

    def multigrid(self, k: int, options: dict[str, Any]) -> MultigridOfParts:
        return MultigridOfParts(self, k, self._parts[k], **options)

    def clear_ghosts(self, k: int, vectors: wp.array) -> None:
        places = self._ghosts[k]
        wp.launch(kernels.clear_vectors, len(places), [places], [vectors], device=self.device)

    # --- contact ---------------------------------------------------------------------------------------------------

    def take_surface(self, nodes: wp.array, places: Sequence[slice]) -> None:
        sizes = [part.worlds * part.numbers.node_count for part in self._parts]
        starts = [int(start) for start in np.cumsum([0, *sizes[:-1]])]
        numbers = [self._numbers(k) for k in range(len(self._parts))]
        self._places = SurfacePlaces(nodes, places, self._parts, starts, numbers, self.comm)
        self._on_surface = self.exchange_of(self._places.halo, len(self._parts))
        self._yielding = wp.zeros(len(nodes), dtype=wp.float32, device=self.device)

    def take_whole_surface(self, own: Ints, bearers: Ints) -> None:
        tag = len(self._parts)
        self._on_whole_surface = [self.exchange_of(Halo.to_all(each, self.comm), tag) for each in (own, bearers)]

    def complete_whole_surface(self, of_places: Sequence[wp.array], of_bearers: Sequence[wp.array]) -> None:
        for exchange, arrays in zip(self._on_whole_surface, (of_places, of_bearers), strict=True):
            for values in arrays:
                if len(values):
                    exchange.launch(values)

    def numbers(self, k: int) -> tuple[Ints, npt.NDArray[np.bool_]]:
        part = self._parts[k]
        shift = self.whole(part).world_node_count * np.arange(part.worlds, dtype=np.int32)[:, None]
        return (part.numbers.places + shift).ravel(), part.is_own

    def complete_surface(self, values: wp.array) -> None:
        self._on_surface.launch(values)

    def completed_yielding(self, yielding: wp.array) -> wp.array:
        wp.copy(self._yielding, yielding)
        self.complete_surface(self._yielding)
        return self._yielding

    def clear_surface(self, forces: wp.array) -> None:
        places = self._places.ghosts
        wp.launch(kernels.clear_forces, len(places), [places], [forces], device=self.device)

    def add_up_wrenches(self, parts: wp.array) -> None:
        if self.device.is_cuda:
            add_up(parts.view(wp.float64).flatten())
            return
        own = parts.numpy()
        own[...] = np.sum(self.comm.allgather(own), axis=0)

    def counted(self, k: int) -> wp.array:
        part = self._parts[k]
        own = np.tile(part.numbers.counted, part.worlds).astype(np.int32)
        return wp.array(own, dtype=wp.int32, device=self.device)

    # --- numbers ---------------------------------------------------------------------------------------------------

    def most(self, value: float) -> float:
        return max(self.comm.allgather(value))

    def least(self, value: int) -> int:
        return min(self.comm.allgather(value))

    def anywhere(self, mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        return np.any(self.comm.allgather(mask), axis=0)

    def together(self, value: float) -> float:
        return sum(self.comm.allgather(value))

    def totals(self, totals: Floats, addends: Floats | None) -> Floats:
        everybody = np.array(self.comm.allgather(totals))
        found = everybody.sum(axis=0)
        reach = int(balance.REACH)
        if addends is not None:
            worlds, _, columns = addends.shape
            by_world = np.moveaxis(addends, 0, 1).reshape(-1, worlds * columns)
            found = reproducible_sums(by_world, self.comm).reshape(worlds, columns)
        found[:, reach] = everybody[..., reach].max(axis=0)
        return found

    def exchange_seconds(self, vectors: Sequence[wp.array], count: int) -> float:
        """The mean time of an exchange of a nodal array of each body, over ``count`` of them in a row [s]; on cards
        they
        are recorded."""

        def exchange() -> None:
            for _ in range(count):
                for k, each in enumerate(vectors):
                    self.complete(k, each)

        made = exchange
        if self.can_record:
            exchange()
            with wp.ScopedCapture(device=self.device) as capture:
                exchange()
            made = functools.partial(wp.capture_launch, capture.graph)
        times = []
        for _ in range(TIMED):
            wp.synchronize_device(self.device)
            self.comm.Barrier()
            began = time.perf_counter()
            made()
            wp.synchronize_device(self.device)
            times.append(time.perf_counter() - began)
        return sorted(times)[TIMED // 2] / count

    def bounds(self, body: SoftBody) -> Floats:
        mesh = self.whole(body).mesh
        return mesh.bounds if isinstance(mesh, DividedMesh) else super().bounds(self.whole(body))

    def bulk(self, body: SoftBody) -> tuple[float, float]:
        return self._bulks[body]

    def _bulk(self, part: Part) -> tuple[float, float]:
        """See ``bulk``; all ranks must call."""
        mesh = self._wholes[part].mesh
        if not isinstance(mesh, DividedMesh):
            return super().bulk(self._wholes[part])
        own = part.numbers.counted
        moduli = (2.0 * part.discretization.mu.numpy() + part.discretization.lam.numpy()).astype(np.float64)
        if part.discretization.material_stride:
            moduli = moduli.reshape(part.worlds, -1)[:, own]
        here = (float(moduli.sum()), moduli.size, float(np.sum(mesh.volumes[own])))
        stiffness, count, volume = np.sum(self.comm.allgather(here), axis=0)
        return float(stiffness / count), float(volume)

    def whole(self, body: SoftBody) -> SoftBody:
        return self._wholes[body]  # type: ignore[index]

    def _numbers(self, k: int) -> npt.NDArray[np.int64]:
        """The numbers of a part's nodes among those of all worlds of the whole body, int64 [worlds * n]."""
        part = self._parts[k]
        return part.numbers.in_worlds(part.worlds)
