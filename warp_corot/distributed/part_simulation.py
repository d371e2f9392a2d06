"""A rank's own simulation of its parts, and the functions that make it."""

from __future__ import annotations

import copy
import dataclasses
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.shapes import Shape
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.elasticity import ForceField, Model
from warp_corot.elasticity.dilatation import ELEMENT, SHARED, shares_dilatation
from warp_corot.errors import InputError, UnstableError
from warp_corot.mesh import TetForest
from warp_corot.mesh.uniform_part import SUBTREE_DEPTH
from warp_corot.remesh.remeshing import Remeshing
from warp_corot.simulation import simulation as on_one
from warp_corot.simulation.energy import WorldEnergies
from warp_corot.solvers.halo import Halo

from . import mpi
from .divided_mesh import DividedForest, DividedMesh
from .halo import MpiHalo
from .partition import Partition
from .parts import Part

#: The attributes of a simulation that belong to its parts.
CHANGED = (
    *("ranks", "bodies", "fields", "pace", "system", "contact", "stable_dt", "safe_step", "guard", "stepper"),
    "recorded",
)
#: If parts have at most this many elements, one rank tries its own first; larger ones take longer than compiling on
#: several ranks.
FEW_ELEMENTS = 200_000
TRIED_STEPS = 10


class Passes(NamedTuple):
    """Passes over whole bodies; of a checkpoint, they go on from one process's simulation.

    Attributes:
        remeshing: The passes.
        fields: The force fields of the whole bodies.
    """

    remeshing: Remeshing
    fields: tuple[ForceField, ...]

    @classmethod
    def of(cls, bodies: Sequence[SoftBody], models: Sequence[Model], asked: Any, *, deterministic: bool) -> Passes:
        """The passes that a user asks for.

        Args:
            bodies, models, deterministic: The simulation's.
            asked: As for ``Remeshing``; or passes, which go on.

        Raises:
            InputError: As ``Remeshing``.
        """
        if isinstance(asked, Passes):
            return asked
        remeshing = Remeshing(bodies, models, asked, deterministic=deterministic)
        bound = zip(models, bodies, strict=True)
        fields = tuple(model.bind(body, deterministic=deterministic) for model, body in bound)
        remeshing.serve(fields)
        return cls(remeshing, fields)


class PartSimulation(on_one.Simulation):
    """A rank's own simulation of parts, which exchanges data with other ranks."""

    def __init__(self, ranks: MpiHalo, parts: Sequence[Part], **options: Any):
        self.ranks: MpiHalo = ranks
        self.is_root = ranks.comm.rank == 0
        super().__init__(parts, **options)

    def take_remeshing(self, remeshing: Remeshing, after: Callable[[], None]) -> None:
        """Take passes over the whole bodies.

        Args:
            remeshing: The passes.
            after: Is called when a pass is due; it makes the pass, and calls ``become`` if the meshes have changed.
        """
        self.remeshing, self._pass = remeshing, after

    def follow_motion(self) -> bool:
        self._pass()
        return True

    def become(self, other: PartSimulation) -> None:
        """Go on with the parts of another simulation, at the same time and with the same hooks."""
        self.guard.forget()
        if self.contact is not None:
            assert other.contact is not None
            other.contact.continue_from(self.contact)
        other.stepper.continue_from(self.stepper)
        known, guard = self.pace.known, self.guard.state
        guard["counted"] = np.full_like(guard["counted"], np.nan)
        for name in CHANGED:
            setattr(self, name, getattr(other, name))
        self.pace.put_back(known)
        if self.safe_step is not None:
            self.safe_step.find_rest(other.stable_steps)
        self.guard.resume(**guard)
        self.running.begin_again()

    def measured_costs(self, count: int) -> list[float]:
        """``Simulation.measured_costs``, for displacements that are up to date."""
        times = []
        for _ in range(count + 1):
            wp.synchronize_device(self.device)
            began = time.perf_counter()
            for part, field in zip(self.bodies, self.fields, strict=True):
                with field.state_kept():
                    field.add_forces(part.state.displacements, part.state.forces)
            wp.synchronize_device(self.device)
            times.append(time.perf_counter() - began)
        for part in self.bodies:
            part.state.forces.zero_()
        elements = sum(part.element_count for part in self.bodies)
        # The first time may compile.
        return self.ranks.comm.allgather(statistics.median(times[1:]) / elements)

    def world_energies(self) -> WorldEnergies:
        """This rank's share of the energies."""
        found = super().world_energies()
        elastic = np.zeros(self.worlds)
        for part, field in zip(self.bodies, self.fields, strict=True):
            energies = wp.zeros(field.energy_count, dtype=wp.float64, device=self.device)
            with field.state_kept():
                field.write_energies(part.state.displacements, energies)
            self.ranks.owned(part).clear_copies(energies)
            elastic += energies.numpy().reshape(self.worlds, -1).sum(axis=1)
        return found._replace(elastic=elastic)


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


class _Tried(on_one.Simulation):
    """A simulation of one rank's parts that exchanges nothing."""

    ranks = Halo()


def compile_once(comm: Any, parts: Sequence[Part], **options: Any) -> None:
    """Let one rank of each machine compile the kernels in some steps of its parts; the others wait and then find them
    in the cache.
    """
    if comm.size == 1 or comm.allreduce(max(part.element_count for part in parts), op=max) > FEW_ELEMENTS:
        return
    here = comm.Split_type(mpi.library().COMM_TYPE_SHARED)
    free = all((part.conditions.inverse_mass.numpy() > 0.0).any() for part in parts)
    if here.rank == 0 and free:
        with warnings.catch_warnings(), suppress(UnstableError, InputError):
            warnings.simplefilter("ignore")
            tried = _Tried(parts, **(options | {"obstacles": of_their_own(options.get("obstacles", ()))}))
            tried.advance_steps(1 if tried.integrator.is_implicit else TRIED_STEPS)
            tried.energy()
        for part in parts:
            part.state.reactions.zero_()
    mpi.meet(here)
    here.Free()


def of_their_own(obstacles: Obstacle | Sequence[Obstacle]) -> list[Obstacle]:
    """The same obstacles for another simulation."""
    given = [obstacles] if isinstance(obstacles, Shape | Tool) else list(obstacles)
    return [each.released() if isinstance(each, Tool) else copy.copy(each) for each in given]


def model_of_whole(model: Model, body: SoftBody, comm: Any) -> Model:
    """The model with the meaning of "auto" for the whole body, because a part may have other materials."""
    if not hasattr(model, "dilatation"):
        return model
    shares = any(comm.allgather(shares_dilatation(model.dilatation, body.discretization)))
    return dataclasses.replace(model, dilatation=SHARED if shares else ELEMENT)  # type: ignore[type-var]
