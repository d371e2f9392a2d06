"""Checkpoints of a run on several ranks: the files that one process would write, from which any number of ranks can
resume."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.io.checkpoint.archive import save_checkpoint

from .contact_checkpoint import gathered_contact, resume_contact
from .mpi import all_or_none
from .part_simulation import PartSimulation
from .part_sync import PartSync

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

#: The beginnings of the names of kept nodal arrays; other kept arrays are the same on all ranks.
DIRECTIONS, VELOCITIES, HISTORY, MEETINGS, SETUP = "directions", "velocities.", "history.", "meetings.", "setup."


@dataclass(frozen=True, eq=False)
class Values:
    """Numbers in place of an array on a device."""

    values: np.ndarray

    def numpy(self) -> np.ndarray:
        return self.values


def save(
    path: str | PathLike[str],
    bodies: tuple[SoftBody, ...],
    parts: PartSimulation,
    syncs: list[PartSync],
    comm: Any,
) -> None:
    """Write a checkpoint on rank 0; all ranks must call this, with bodies in which all nodes are up to date.

    Args:
        path: The file.
        bodies: The whole bodies.
        parts: This rank's simulation of parts.
        syncs: The ``PartSync`` of each body.
        comm: The ranks.

    Raises:
        InputError: On all ranks, if rank 0 cannot write.
    """
    kept = {}
    for name, array in parts.kept.items():
        values = array.numpy()
        k = body_of(name, parts)
        if k is not None:
            values = syncs[k].whole_values(values)
        kept[name] = Values(values)
    contact = None
    if parts.contact is not None:
        contact = gathered_contact(parts, syncs, comm)
    guard = parts.guard.state

    def write() -> None:
        if comm.rank != 0:
            return
        told = SimpleNamespace(
            **{name: getattr(parts, name) for name in ("stable_dt", "steps_before_reset", "time_before_reset")},
            **{name: getattr(parts, name) for name in ("device", "gravity", "integrator", "deterministic", "worlds")},
            **{name: getattr(parts, name) for name in ("models", "fields", "remeshing")},
            bodies=bodies,
            kept=kept,
            guard=SimpleNamespace(state=guard),
            running=parts.running,
            contact=contact,
            grasps=(),
        )
        save_checkpoint(told, path)  # type: ignore[arg-type]

    all_or_none(write, comm)


def body_of(name: str, parts: Simulation) -> int | None:
    """The body to which a kept array belongs, if it has an entry for each node; otherwise None."""
    if name.startswith(HISTORY):
        count = sum(each.startswith(HISTORY) for each in parts.kept)
        return int(name.removeprefix(HISTORY)) * len(parts.bodies) // count
    for first in (DIRECTIONS, VELOCITIES, MEETINGS):
        if name.startswith(first):
            return int(name.removeprefix(first))
    if name.startswith(SETUP) and name.endswith(".at"):
        return int(name.removeprefix(SETUP).removesuffix(".at"))
    return None


def resume(loaded: Simulation | SimpleNamespace, parts: PartSimulation, syncs: list[PartSync]) -> None:
    """Resume a simulation of parts from a saved one.

    Args:
        loaded: The simulation that one process loads from the checkpoint.
        parts: This rank's simulation of parts of the same bodies.
        syncs: The ``PartSync`` of each body.
    """
    for name, array in parts.kept.items():
        values = loaded.kept[name].numpy()
        k = body_of(name, parts)
        if k is not None:
            values = syncs[k].part_values(values)
        array.assign(values)
    parts.steps_before_reset, parts.time_before_reset = loaded.steps_before_reset, loaded.time_before_reset
    parts.stable_dt = loaded.stable_dt
    if loaded.contact is not None:
        resume_contact(loaded.contact, parts, syncs)
    parts.guard.resume(**loaded.guard.state)
    parts.running.resume(**loaded.running.state)
    wp.synchronize_device(parts.device)
