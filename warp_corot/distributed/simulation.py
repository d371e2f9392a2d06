"""Bodies in motion on several processes; each process computes its part of every body."""

from __future__ import annotations

import copy
import dataclasses
import functools
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from os import PathLike
from typing import Any, NamedTuple, NoReturn

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.options import SURFACE, TETRAHEDRA
from warp_corot.contact.shapes import Shape
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.cutting.blade import Blade
from warp_corot.elasticity import Corotated, ForceField, Linear, Model, NeoHookean, StVenantKirchhoff
from warp_corot.elasticity.dilatation import ELEMENT, SHARED, shares_dilatation
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_device
from warp_corot.mesh import TetForest
from warp_corot.mesh.uniform import SUBTREE_DEPTH
from warp_corot.remesh.remeshing import OnlineRemesh, Remeshing
from warp_corot.simulation import simulation as on_one
from warp_corot.simulation.energy import WorldEnergies
from warp_corot.simulation.parts import checked_bodies, checked_integrator, checked_models, chosen_worlds
from warp_corot.simulation.running import Hooks
from warp_corot.solvers import Integrator, SymplecticEuler
from warp_corot.solvers.pace import Pace
from warp_corot.solvers.stability import ANY_STEP

from . import checkpoint, mpi
from .divided_mesh import DividedForest, DividedMesh
from .halo import CommHalo, MpiHalo
from .part import Part, PartSync
from .partition import Partition

#: Models whose forces need only the elements around a node.
MODELS = (Corotated, Linear, NeoHookean, StVenantKirchhoff)
#: The preconditioner of linear solves with meshes that no rank holds whole.
DIAGONAL = "diagonal"


class Passes(NamedTuple):
    """Passes of remeshing over whole bodies, which go on from a checkpoint.

    Attributes:
        remeshing: The passes.
        fields: The force fields of the whole bodies.
    """

    remeshing: Remeshing
    fields: tuple[ForceField, ...]


def _refused(name: str) -> Callable[..., NoReturn]:
    """A method that does not work on several ranks."""

    def refused(*_: Any, **__: Any) -> NoReturn:
        raise InputError(f"{name} does not work on several ranks yet, only on one process")

    return refused


class _Hooks(Hooks):
    """Functions that every rank calls with the whole bodies, which they may change."""

    def _call(self, callback: Callable[[Any], None], sim: Simulation) -> None:
        with sim.shown():
            super()._call(callback, sim)


class Simulation(on_one.Simulation):
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
        parts: This rank's part of each.
        syncs: Copies between each body and its part.
        rank, size, comm: This rank's number, the number of ranks, and their MPI communicator.
        worlds, device, stable_dt, gravity: As for ``warp_corot.Simulation``.

    Raises:
        InputError: MPI is not installed, an argument does not work on several ranks, a body has fewer groups of
            elements than there are ranks, or as for ``warp_corot.Simulation``.
    """

    parts: tuple[Part, ...]
    ranks: MpiHalo
    cut, tear, forces, contacts, add_forces = map(_refused, ("cut", "tear", "forces", "contacts", "add_forces"))

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
        self.comm = comm = mpi.world()
        self.rank, self.size, self.is_root = comm.rank, comm.size, comm.rank == 0
        self.ranks = CommHalo(comm)  # type: ignore[assignment]
        wholes = checked_bodies(bodies, self.ranks)
        models = checked_models(Corotated() if model is None else model, len(wholes))
        integrator = checked_integrator(SymplecticEuler() if integrator is None else integrator)
        here = None if device is None else checked_device(device)
        cards = comm.size if deterministic and (here or wholes[0].device).is_cuda else 0
        check_supported(wholes, models, integrator, others, cards)
        models = tuple(_model_of_whole(m, body, comm) for m, body in zip(models, wholes, strict=True))
        self._costs, self._here, self.syncs = costs, here, list[PartSync]()
        options: dict[str, Any] = {"integrator": integrator, "gravity": gravity, "deterministic": deterministic}
        super().__init__(wholes, model=models, **options, **others)
        self.hooks = _Hooks()

    # --- parts -----------------------------------------------------------------------------------------------------

    def _found_device(self) -> wp.Device:
        return self._here or self.bodies[0].device

    def _made_passes(self, remesh: Any, blades: tuple[Blade, ...] | None) -> Remeshing:
        if not isinstance(remesh, Passes):
            made = super()._made_passes(remesh, blades)
            bound = zip(self.models, self.bodies, strict=True) if made.every else ()
            remesh = Passes(made, tuple(m.bind(body, deterministic=self.deterministic) for m, body in bound))
            if made.every:
                made.serve(remesh.fields)
        #: The force fields of whole bodies that are remeshed.
        self.whole_fields = remesh.fields
        return remesh.remeshing

    def _divided(self) -> tuple[Part, ...]:
        comm = self.comm
        parts = tuple(
            part_of(body, model, comm, self._costs, self._here)
            for body, model in zip(self.bodies, self.models, strict=True)
        )
        for part in parts:
            part.discretization.sums_by_subtrees = self.deterministic
        self.syncs = [PartSync(body, part, comm) for body, part in zip(self.bodies, parts, strict=True)]
        for each in self.syncs:
            each.take_over()
        self.ranks = MpiHalo(comm, self.bodies, parts, reproducible=self.deterministic)
        return parts

    def _divide_anew(self) -> None:
        """Go on with parts of the present meshes; the whole bodies have the state of all nodes."""
        for body in self.bodies:
            if body.state.is_touched:
                body.state.make_contact_forces()
                body.state.contact_forces.zero_()
        contact, stepper, touching = self.contact, self.stepper, None
        if contact is not None:
            contact.obstacles.let_go()
            touching = contact.obstacles.given, contact.options
        self.guard.forget()
        known, guard = self.pace.known, self.guard.state
        guard["counted"] = np.full_like(guard["counted"], np.nan)
        self.pace = Pace(ANY_STEP if self.integrator.dt is None else float(self.integrator.dt), self.device)
        self._make_steps(touching, None)
        if self.contact is not None and contact is not None:
            self.contact.continue_from(contact)
        self.stepper.continue_from(stepper)
        self.pace.put_back(known)
        if self.safe_step is not None:
            self.safe_step.find_rest(self.stable_steps)
        self.guard.resume(**guard)
        self.running.begin_again()

    def follow_motion(self) -> bool:
        """Make the passes that are due over the whole bodies, on all ranks alike, and divide the new meshes."""
        self._publish()
        self.collect()
        before = [body.version for body in self.bodies]
        self.remeshing.run(self.steps)
        self.remeshing.step_may_change()
        if before != [body.version for body in self.bodies]:
            self._divide_anew()
        return True

    def _take_over(self) -> None:
        for k, each in enumerate(self.syncs):
            each.take_over()
            self.ranks.exchange(k, each.part.state.displacements)
            each.part.state.publish_positions()

    def _publish(self) -> None:
        for each in self.syncs:
            each.publish()

    # --- stepping --------------------------------------------------------------------------------------------------

    @contextmanager
    def _led(self) -> Iterator[None]:
        """Take users' changes of the bodies to the parts, and steps of the parts to the bodies."""
        self._take_over()
        yield
        self._publish()

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Let the block see the bodies after the last step, and take its changes of them to the parts."""
        self._publish()
        yield
        self._take_over()

    def step(self) -> None:
        """Advance by one time step, like ``warp_corot.Simulation.step``. All ranks must call this."""
        with self._led():
            super().step()

    def advance_until(self, total_time: float) -> None:
        """Advance until ``total_time`` [s], like ``advance``; do nothing if that time is past."""
        with self._led():
            super().advance_until(total_time)

    def advance_steps(self, count: int) -> None:
        """Advance by ``count`` time steps, like ``advance``."""
        with self._led():
            super().advance_steps(count)

    def reset(self, worlds: npt.ArrayLike | wp.array | None = None) -> None:
        """Reset worlds to their initial state, like ``warp_corot.Simulation.reset``.

        The meshes to which bodies return that are remeshed are divided anew.
        """
        with self._led():
            if self.remeshing.every and chosen_worlds(worlds, self.worlds, self.device).numpy()[0]:
                self._publish()
                self.collect()
                for changing in self.remeshing.changed:
                    changing.restore()
                self._divide_anew()
            for each in self.syncs:
                each.take_initial()
            super().reset(worlds)

    # --- looking ---------------------------------------------------------------------------------------------------

    @property
    def elements_here(self) -> tuple[int, int]:
        """Elements that this rank computes in one world, over all bodies, and how many of these are copies of other
        ranks' elements."""
        counted = [part.numbers.counted for part in self.parts]
        return sum(map(len, counted)), sum(int((~each).sum()) for each in counted)

    def measured_costs(self, count: int = 20) -> list[float]:
        """The time that the forces of an element take on each rank [s], the median of ``count`` measurements.

        The result is meant for ``costs`` of another simulation of the same bodies. All ranks must call this.
        """
        self._take_over()
        times = []
        for _ in range(checked_count(count, "count", least=1) + 1):
            wp.synchronize_device(self.device)
            began = time.perf_counter()
            for part, field in zip(self.parts, self.fields, strict=True):
                with field.state_kept():
                    field.add_forces(part.state.displacements, part.state.forces)
            wp.synchronize_device(self.device)
            times.append(time.perf_counter() - began)
        for part in self.parts:
            part.state.forces.zero_()
        elements = sum(part.element_count for part in self.parts)
        # The first time may compile.
        return self.comm.allgather(statistics.median(times[1:]) / elements)

    def world_energies(self) -> WorldEnergies:
        """The energies of each world on all ranks [J], float64 [worlds]; all ranks must call this."""
        self._take_over()
        return super().world_energies()

    def von_mises(self, body: SoftBody | None = None) -> npt.NDArray[np.float32]:
        """Von Mises stress of each element in the present state [Pa], float32 [worlds * T]; if no rank holds the whole
        mesh, of those of this rank's part. All ranks must call this."""
        self._take_over()
        return self.syncs[self._index(body)].of_elements(super().von_mises(body))

    def collect(self) -> None:
        """Bring the state of all nodes into the bodies of all ranks; all ranks must call this.

        If no rank holds the whole mesh, these are the nodes of this rank's part.
        """
        for k, each in enumerate(self.syncs):
            each.collect(functools.partial(self.completed, k))

    def completed(self, k: int, name: str) -> wp.array:
        """A nodal array of the state of this rank's part of the k-th body, with the values of other ranks' nodes.

        It is valid until the next call. All ranks must call this.
        """
        return self.ranks.exchange(k, getattr(self.parts[k].state, name), copies=True)

    # --- keeping ---------------------------------------------------------------------------------------------------

    def save(self, path: str | PathLike[str]) -> None:
        """Write a checkpoint on rank 0, like ``warp_corot.Simulation.save``; all ranks must call this.

        One process, or any number of ranks, can resume from it. Afterwards the bodies of all ranks are up to date at
        all nodes that they have. Of bodies in parts, rank 0 needs memory for the whole bodies meanwhile.

        Raises:
            InputError: On all ranks, if rank 0 cannot write to the folder.
        """
        self._take_over()
        self.collect()
        checkpoint.save(path, self)

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
            path: The file, which every rank reads. Of bodies in parts each rank then keeps its part only.
            device: The device; None: the one on which it was saved, or the rank's own card.
            remesh: As for ``warp_corot.Simulation.load``.

        Raises:
            InputError: As for ``warp_corot.Simulation.load``, or a run that does not work on several ranks.
        """
        bodies, loaded = checkpoint.load(path, device, remesh, mpi.world())
        others: dict[str, Any] = {}
        if loaded.contact is not None:
            others = {"obstacles": of_their_own(loaded.obstacles), "contact": loaded.contact.options}
        if any(loaded.remesh):
            others["remesh"] = Passes(loaded.remeshing, loaded.fields)
        given = {name: getattr(loaded, name) for name in ("integrator", "gravity", "deterministic")}
        made = cls(bodies, model=loaded.models, **given, **others)
        checkpoint.resume(loaded, made)
        return made


# --- making ----------------------------------------------------------------------------------------------------------


def part_of(body: SoftBody, model: Model, comm: Any, costs: npt.ArrayLike | None, device: wp.Device | None) -> Part:
    """This rank's part of a body, on a device; None: where the body is.

    Raises:
        InputError: As ``Partition.of``, costs of a body that is in parts already, or rotations that are shared by
            elements of several ranks.
    """
    level = getattr(model, "level", None)
    if isinstance(body.mesh, DividedMesh):
        if costs is not None:
            raise InputError("the mesh is divided already; give costs to warp_corot.distributed.box or divided")
        if level is not None and not body.mesh.is_box:
            raise InputError(f"rotation_level is {level}; of a divided mesh it must be a tolerance or None")
        if level is not None and isinstance(body.mesh, DividedForest):
            least = int(body.mesh.tree.leaf_levels[0]) - SUBTREE_DEPTH
            if level < least:
                raise InputError(
                    f"rotation_level is {level}; of a box in parts it must be at least {least}, {SUBTREE_DEPTH} levels "
                    "above the elements"
                )
        return Part(body, None, comm.rank, device)
    grouped = getattr(model, "dilatation", ELEMENT) == SHARED
    partition = Partition.of(body.mesh, comm.size, costs, grouped=grouped, rotation_level=level)
    part = Part(body, partition, comm.rank, device)
    if level is not None and isinstance(part.mesh, TetForest) and isinstance(body.mesh, TetForest):
        everywhere = body.mesh.ancestors(level)[part.numbers.elements]
        if any(comm.allgather(not np.array_equal(part.mesh.ancestors(level), everywhere))):
            raise InputError(
                f"rotation_level {level} does not work on several ranks where elements above are cut by the surface; "
                "it must be a tolerance or None"
            )
    return part


def of_their_own(obstacles: Obstacle | Sequence[Obstacle]) -> list[Obstacle]:
    """The same obstacles for another simulation."""
    given = [obstacles] if isinstance(obstacles, Shape | Tool) else list(obstacles)
    return [each.released() if isinstance(each, Tool) else copy.copy(each) for each in given]


def _model_of_whole(model: Model, body: SoftBody, comm: Any) -> Model:
    """The model with the meaning of "auto" for the whole body, because a part may have other materials."""
    if not hasattr(model, "dilatation"):
        return model
    shares = any(comm.allgather(shares_dilatation(model.dilatation, body.discretization)))
    return dataclasses.replace(model, dilatation=SHARED if shares else ELEMENT)  # type: ignore[type-var]


def check_supported(
    bodies: Sequence[SoftBody], models: Sequence[Model], integrator: Integrator, others: dict[str, Any], cards: int = 0
) -> None:
    """Check that a simulation can be made on several ranks.

    Args:
        bodies, models, integrator: As for ``Simulation``.
        cards: The number of cards, if the run must give the same bits for any number of them; otherwise 0.
        others: Its other arguments, by name.

    Raises:
        InputError: It cannot.
    """
    in_parts = any(isinstance(body.mesh, DividedMesh) for body in bodies)
    if others.get("remesh") and in_parts:
        raise InputError(
            "remeshing of meshes that no rank holds whole does not work yet; leave remesh out, let every rank make the "
            "whole mesh, or run on one process"
        )
    if others.get("cuts") is not None:
        raise InputError("cutting does not work on several ranks; leave cuts out, or run on one process")
    contact = others.get("contact")
    meets = getattr(contact, "self_contact", False) or (len(bodies) > 1 and (contact or others.get("obstacles")))
    if meets and (in_parts or integrator.is_implicit):
        raise InputError(
            "contact of soft surfaces does not work on several ranks yet in implicit steps, or with meshes that no "
            "rank holds whole; use one body without self_contact, or explicit steps of whole meshes, or one process"
        )
    touches = bool(contact or others.get("obstacles"))
    embedded = any(isinstance(body.mesh, DividedMesh) and body.mesh.is_embedded for body in bodies)
    if touches and embedded and not integrator.is_implicit and getattr(contact, "on", SURFACE) == SURFACE:
        raise InputError(
            f"no rank has the surface of a divided mesh; contact must be Contact(on={TETRAHEDRA!r}), which touches the "
            "tetrahedra around it, or every rank must make the whole mesh"
        )
    if getattr(integrator, "preconditioner", None) not in (None, DIAGONAL) and in_parts:
        raise InputError(
            f"the preconditioner {integrator.preconditioner!r} does not work yet with meshes that no rank holds whole; "  # type: ignore[attr-defined]
            f"it must be None or {DIAGONAL!r}"
        )
    if cards > 1 and touches:
        raise InputError(
            "contact on several cards is not the same bit for bit as on one yet; deterministic must be False, or take "
            "ranks on the CPU, or one card"
        )
    for model in models:
        if not isinstance(model, MODELS):
            raise InputError(f"{type(model).__name__} does not work on several ranks yet; take a law of elements")
    for body in bodies:
        if body.changing is not None and not isinstance(others.get("remesh"), Passes):
            raise InputError("a body that is remeshed does not work on several ranks yet")
