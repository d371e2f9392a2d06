"""Bodies in motion on several processes; each process computes its part of every body."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.tool import Obstacle
from warp_corot.elasticity import Corotated, Model
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_path
from warp_corot.inputs.device import checked_device
from warp_corot.remesh.online import OnlineRemesh
from warp_corot.simulation import simulation as on_one
from warp_corot.simulation.clock import Clock
from warp_corot.simulation.energy import Energy, WorldEnergies
from warp_corot.simulation.parts import (
    checked_bodies,
    checked_gravity,
    checked_integrator,
    checked_models,
    chosen_worlds,
)
from warp_corot.simulation.solves import Solves
from warp_corot.solvers import Integrator, SymplecticEuler

from . import checkpoint, mpi
from .halo import CommHalo, MpiHalo
from .part_simulation import PartSimulation, Passes, compile_once, model_of_whole, of_their_own, part_of
from .part_sync import PartSync, forget, register
from .parts import Part
from .unsupported import check_supported


class Simulation(Clock):
    """One or several soft bodies, stepped together by all ranks of an MPI run.

    Every rank makes the same bodies and calls the same methods in the same order. A rank computes its part of every
    body. In the whole bodies, which users hold, only the nodes that the rank moves are up to date; ``gather`` collects
    an array on rank 0, and ``collect`` brings all nodes up to date on all ranks.

    Args:
        bodies, model, integrator, gravity: As for ``warp_corot.Simulation``.
        deterministic: Whether the run must be the same bit for bit for any number of ranks on the CPU. On several cards
            its last digits still differ.
        costs: The cost of an element on each rank, in any unit, [ranks]; None: the same everywhere.
        device: The device of this rank; None: that of the bodies. With bodies on the CPU and "cuda" here, a card holds
            only this rank's parts.
        others: ``obstacles``, ``contact`` and ``remesh`` as for ``warp_corot.Simulation``. After a pass of remeshing
            the meshes are divided anew.

    Attributes:
        bodies: Tuple of the whole bodies.
        rank, size, comm: This rank's number, the number of ranks, and their MPI communicator.
        worlds, device, stable_dt, gravity: As for ``warp_corot.Simulation``.

    Raises:
        InputError: MPI is not installed, an argument does not work on several ranks, a body has fewer groups of
            elements than there are ranks, or as for ``warp_corot.Simulation``.
    """

    def __init__(
        self,
        bodies: SoftBody | Sequence[SoftBody],
        *,
        model: Model | Sequence[Model] | None = None,
        integrator: Integrator | None = None,
        gravity: npt.ArrayLike | None = None,
        deterministic: bool = False,
        costs: npt.ArrayLike | None = None,
        device: str | wp.Device | None = None,
        **others: Any,
    ):
        self._comm = self.comm = comm = mpi.world()
        self.rank, self.size = comm.rank, comm.size
        self.bodies = checked_bodies(bodies, CommHalo(comm))
        models = checked_models(Corotated() if model is None else model, len(self.bodies))
        integrator = checked_integrator(SymplecticEuler() if integrator is None else integrator)
        here = None if device is None else checked_device(device)
        cards = comm.size if deterministic and (here or self.bodies[0].device).is_cuda else 0
        check_supported(self.bodies, models, integrator, others, cards)
        models = tuple(model_of_whole(m, body, comm) for m, body in zip(models, self.bodies, strict=True))
        self.gravity = checked_gravity(gravity, self.bodies[0].mesh.up_axis)
        self._division = costs, here
        self._passes: Passes | None = None
        if (remesh := others.pop("remesh", None)) is not None:
            self._passes = Passes.of(self.bodies, models, remesh, deterministic=deterministic)
        self._options: dict[str, Any] = {"model": models, "integrator": integrator, "gravity": self.gravity} | others
        self._options["deterministic"] = deterministic
        parts = self._divided(models, deterministic)
        compile_once(comm, parts, **{name: value for name, value in self._options.items() if name != "deterministic"})
        self._parts = self._made(parts)
        if self._passes is not None:
            self._parts.take_remeshing(self._passes.remeshing, self._remesh)
        register(self._syncs)

    def _divided(self, models: Sequence[Model], deterministic: bool) -> list[Part]:
        """This rank's parts of the bodies as they are now."""
        comm, (costs, here) = self._comm, self._division
        parts = [part_of(body, m, comm, costs, here) for body, m in zip(self.bodies, models, strict=True)]
        for part in parts:
            part.discretization.sums_by_subtrees = bool(deterministic)
        self._syncs = [PartSync(body, part, comm) for body, part in zip(self.bodies, parts, strict=True)]
        for each in self._syncs:
            each.take_over()
        return parts

    def _made(self, parts: list[Part]) -> PartSimulation:
        """The simulation of these parts."""
        for each in self._syncs:
            each.take_over()
        reproducible, records = bool(self._options["deterministic"]), not self._options["integrator"].is_implicit
        ranks = MpiHalo(self._comm, self.bodies, parts, reproducible=reproducible, records=records)
        return PartSimulation(ranks, parts, **self._options)

    def _remesh(self) -> None:
        """Make the passes that are due over the whole bodies, on all ranks alike, and divide the new meshes."""
        assert self._passes is not None
        remeshing = self._passes.remeshing
        self._publish()
        self.collect()
        before = [body.version for body in self.bodies]
        remeshing.run(self._parts.steps)
        remeshing.step_may_change()
        if before != [body.version for body in self.bodies]:
            self._divide_anew()

    def _divide_anew(self) -> None:
        """Go on with parts of the present meshes; the whole bodies have the state of all nodes."""
        forget(self._syncs)
        for body in self.bodies:
            if body.state.is_touched:
                body.state.make_contact_forces()
                body.state.contact_forces.zero_()
        parts = self._divided(self._options["model"], self._options["deterministic"])
        if self._parts.contact is not None:
            self._parts.contact.obstacles.let_go()
        self._parts.become(self._made(parts))
        register(self._syncs)

    def __getattr__(self, name: str) -> Any:
        if not name.startswith("_") and hasattr(on_one.Simulation, name):
            raise AttributeError(f"{name} does not work on several ranks yet, only on one process")
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    # --- stepping --------------------------------------------------------------------------------------------------

    def step(self) -> None:
        """Advance by one time step, like ``warp_corot.Simulation.step``. All ranks must call this."""
        self._lead(self._parts.step)

    def advance(self, seconds: float) -> None:
        """Advance by ``seconds``, like ``warp_corot.Simulation.advance``. All ranks must call this."""
        self._lead(self._parts.advance, seconds)

    def advance_until(self, total_time: float) -> None:
        """Advance until ``total_time`` [s], like ``advance``; do nothing if that time is past."""
        self._lead(self._parts.advance_until, total_time)

    def advance_steps(self, count: int) -> None:
        """Advance by ``count`` time steps, like ``advance``."""
        self._lead(self._parts.advance_steps, count)

    def _lead(self, act: Callable[..., None], *amount: float) -> None:
        self._take_over()
        act(*amount)
        self._publish()

    def on_step(self, callback: Callable[[Simulation], None], every: int = 1) -> None:
        """Call ``callback(sim)`` on every rank after every ``every``-th step, counted from the beginning.

        Raises:
            InputError: ``every`` is not a positive whole number, or the callback cannot be called.
        """
        if not callable(callback):
            raise InputError(f"callback is {callback!r}; it must be a function of the simulation")

        def called(_: object) -> None:
            self._publish()
            callback(self)
            self._take_over()

        self._parts.on_step(called, checked_count(every, "every", least=1))

    def reset(self, worlds: npt.ArrayLike | wp.array | None = None) -> None:
        """Reset worlds to their initial state, like ``warp_corot.Simulation.reset``.

        The meshes to which bodies return that are remeshed are divided anew.
        """
        self._take_over()
        if self._passes is not None:
            self._restore_meshes(worlds)
        for each in self._syncs:
            each.take_initial()
        self._parts.reset(worlds)
        self._publish()

    def _restore_meshes(self, worlds: npt.ArrayLike | wp.array | None) -> None:
        """Put the meshes of bodies that are remeshed back to those of their initial states, and divide these."""
        if not chosen_worlds(worlds, self.worlds, self.device).numpy()[0]:
            return
        self._publish()
        self.collect()
        for body in self.bodies:
            if body.changing is not None:
                body.changing.restore()
        self._divide_anew()

    # --- looking ---------------------------------------------------------------------------------------------------

    @property
    def body(self) -> SoftBody:
        """The first body."""
        return self.bodies[0]

    @property
    def clock(self) -> PartSimulation:
        """This rank's simulation of its parts."""
        return self._parts

    @property
    def worlds(self) -> int:
        """Number of copies of the bodies."""
        return self._parts.worlds

    @property
    def device(self) -> wp.Device:
        """The device of this rank."""
        return self._parts.device

    @property
    def stable_dt(self) -> float:
        """Largest linearly stable step at rest [s], estimated."""
        return self._parts.stable_dt

    @property
    def elements_here(self) -> tuple[int, int]:
        """Elements that this rank computes in one world, over all bodies, and how many of these are copies of other
        ranks' elements."""
        counted = [each.part.numbers.counted for each in self._syncs]
        return sum(map(len, counted)), sum(int((~each).sum()) for each in counted)

    @property
    def sent_bytes(self) -> int:
        """The bytes that this rank sends in one exchange."""
        return sum(each.sent_bytes for each in self._parts.ranks.lists)

    def exchange_seconds(self, count: int) -> float:
        """The mean time of one exchange alone, over ``count`` of them in a row [s]; all ranks must call this."""
        probes = [wp.zeros_like(each.part.state.displacements) for each in self._syncs]
        return self._parts.ranks.exchange_seconds(probes, checked_count(count, "count", least=1))

    def measured_costs(self, count: int = 20) -> list[float]:
        """The time that the forces of an element take on each rank [s], the median of ``count`` measurements.

        The result is meant for ``costs`` of another simulation of the same bodies. All ranks must call this.
        """
        self._take_over()
        return self._parts.measured_costs(checked_count(count, "count", least=1))

    def energy(self) -> Energy:
        """Kinetic, elastic and gravitational energy of all bodies on all ranks in the present state [J]."""
        return self.world_energies().together

    def world_energies(self) -> WorldEnergies:
        """The same energies of each world [J], float64 [worlds]."""
        self._take_over()
        own = self._parts.world_energies()
        return WorldEnergies(*np.sum(self._comm.allgather(np.array(own)), axis=0))

    def collect(self) -> None:
        """Bring the state of all nodes into the bodies of all ranks; all ranks must call this.

        If no rank holds the whole mesh, these are the nodes of this rank's part.
        """
        for k, each in enumerate(self._syncs):
            if each.is_in_parts:
                each.take_ghosts(functools.partial(self.completed, k))
                continue
            state = each.whole.state
            for array in (state.displacements, state.velocities, state.reactions):
                array.assign(self._comm.bcast(each.gather(array), root=0))
            state.publish_positions()
            each.collect_touch()

    def completed(self, k: int, name: str) -> wp.array:
        """A nodal array of the state of this rank's part of the k-th body, with the values of other ranks' nodes.

        It is valid until the next call. All ranks must call this.
        """
        return self._parts.ranks.exchange(k, getattr(self._syncs[k].part.state, name), copies=True)

    @property
    def syncs(self) -> list[PartSync]:
        """The bodies, each with this rank's part of it."""
        return self._syncs

    @property
    def remeshing(self) -> Passes | None:
        """The passes over the whole bodies, and the force fields of these; None without remeshing."""
        return self._passes

    def von_mises(self) -> list[npt.NDArray[np.float32]]:
        """Von Mises stress of each element of this rank's part of each body [Pa], float32 [worlds * t]."""
        self._take_over()
        return [self._parts.von_mises(each.part) for each in self._syncs]

    @property
    def solves(self) -> Solves | None:
        """The cost of an implicit integrator's solves so far, like ``warp_corot.Simulation.solves``."""
        return self._parts.solves

    @property
    def contact(self) -> Contacts | None:
        """The contact of this rank's parts; None without contact."""
        return self._parts.contact

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """Shapes and tools that bodies touch, as they were given."""
        return self._parts.obstacles

    # --- keeping ---------------------------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Write a checkpoint on rank 0, like ``warp_corot.Simulation.save``; all ranks must call this.

        One process, or any number of ranks, can resume from it. Afterwards the bodies of all ranks are up to date at
        all nodes that they have. Of bodies in parts, rank 0 needs memory for the whole bodies meanwhile.

        Raises:
            InputError: On all ranks, if rank 0 cannot write to the folder.
        """
        self._take_over()
        if not all(each.is_in_parts for each in self._syncs):
            self.collect()
        checkpoint.save(path, self._parts, self._syncs, self._comm)

    @classmethod
    def load(
        cls,
        path: str | PathLike[str],
        *,
        device: str | wp.Device | None = None,
        remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None = None,
    ) -> Simulation:
        """Resume from a checkpoint that ``save`` or one process wrote, on any number of ranks; all ranks must call
        this.

        A resumed deterministic run gives the same bits as an uninterrupted one.

        Args:
            path: The file, which every rank reads; of bodies in parts rank 0 alone, which hands out parts.
            device: The device; None: the one on which it was saved, or the rank's own card.
            remesh: As for ``warp_corot.Simulation.load``.

        Raises:
            InputError: As for ``warp_corot.Simulation.load``, or a run that does not work on several ranks.
        """
        loaded: Any
        where = checkpoint.device_of_parts(checked_path(path, "path"))
        if where is not None:
            bodies, loaded = checkpoint.load_in_parts(path, where if device is None else device, mpi.world())
            others = loaded.touching
        else:
            loaded, others = on_one.Simulation.load(path, device=device, remesh=remesh), {}
            bodies = loaded.bodies
            if loaded.contact is not None:
                given = of_their_own(loaded.contact.obstacles.given)
                others |= {"obstacles": given, "contact": loaded.contact.options}
            if any(loaded.remesh):
                others["remesh"] = Passes(loaded.remeshing, loaded.fields)
        made = cls(
            bodies,
            model=loaded.models,
            integrator=loaded.integrator,
            gravity=loaded.gravity,
            deterministic=loaded.deterministic,
            **others,
        )
        checkpoint.resume(loaded, made._parts, made._syncs)
        return made

    # --- pieces ----------------------------------------------------------------------------------------------------

    def _take_over(self) -> None:
        for k, each in enumerate(self._syncs):
            each.take_over()
            self._parts.ranks.exchange(k, each.part.state.displacements)
            each.part.state.publish_positions()

    def _publish(self) -> None:
        for each in self._syncs:
            each.publish()
