"""Checkpoints of a run on several ranks: the files that one process would write, from which any number of ranks can
resume, and one process."""

from __future__ import annotations

import json
from os import PathLike
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.io.checkpoint.archive import load_checkpoint, save_checkpoint
from warp_corot.io.checkpoint.contact import obstacles_of, pack_obstacles

from .contact_checkpoint import gathered_contact, packed, resume_contact
from .mpi import all_or_none
from .part_simulation import PartSimulation
from .part_sync import PartSync
from .scatter_bodies import gathered_body, handed_bodies

if TYPE_CHECKING:
    from warp_corot.simulation.simulation import Simulation

#: The beginnings of the names of kept nodal arrays; other kept arrays are the same on all ranks.
DIRECTIONS, VELOCITIES, HISTORY, MEETINGS, SETUP = "directions", "velocities.", "history.", "meetings.", "setup."
#: What a simulation is made with, and what else it continues from.
MADE_WITH = ("models", "integrator", "gravity", "deterministic")
RESUMED = ("stable_dt", "steps_before_reset", "time_before_reset")


def save(path: str | PathLike[str], parts: PartSimulation, syncs: list[PartSync], comm: Any) -> None:
    """Write a checkpoint on rank 0, which gets the whole bodies for that; all ranks must call this, with bodies in
    which all nodes are up to date if every rank holds them.

    Args:
        path: The file.
        parts: This rank's simulation of parts.
        syncs: The ``PartSync`` of each body.
        comm: The ranks.

    Raises:
        InputError: On all ranks, if rank 0 cannot write.
    """
    wholes = [gathered_body(each, comm) for each in syncs]
    kept = {}
    for name, array in parts.kept.items():
        k, values = body_of(name, parts), array.numpy()
        found = values if k is None else syncs[k].gather_part(values)
        if found is not None:
            kept[name] = wp.array(found, device="cpu")
    contact = None if parts.contact is None else gathered_contact(parts, syncs, wholes, comm)
    guard = parts.guard.state

    def write() -> None:
        if comm.rank != 0:
            return
        names = (*MADE_WITH, *RESUMED, "device", "worlds", "fields", "remeshing", "running")
        told = SimpleNamespace(
            **{name: getattr(parts, name) for name in names},
            bodies=wholes,
            kept=kept,
            guard=SimpleNamespace(state=guard),
            contact=contact,
            grasps=(),
        )
        save_checkpoint(told, path, in_parts=any(each.is_in_parts for each in syncs))  # type: ignore[arg-type]

    all_or_none(write, comm)


def device_of_parts(path: str | PathLike[str]) -> str | None:
    """The device of a checkpoint of bodies in parts, or this rank's card; None if the file is another one."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(archive["header"].tobytes())
    except Exception:  # whoever reads it as a checkpoint says what is wrong
        return None
    return ("cpu" if header["device"] == "cpu" else str(wp.get_device())) if header.get("in_parts") else None


def load_in_parts(path: str | PathLike[str], device: str | wp.Device, comm: Any) -> tuple[list[SoftBody], Any]:
    """This rank's parts of the bodies of a checkpoint that rank 0 reads, and what a simulation of them continues from;
    all ranks must call this.

    Raises:
        InputError: On all ranks, as ``load_checkpoint``.
    """
    sims: list[Simulation] = []

    def told(nodes: list[npt.NDArray[np.int64]]) -> SimpleNamespace:
        (sim,) = sims
        kept = {}
        for name, array in sim.kept.items():
            k, values = body_of(name, sim), array.numpy()
            kept[name] = values if k is None else values[nodes[k]]
        given = {name: getattr(sim, name) for name in (*MADE_WITH, *RESUMED)}
        here = SimpleNamespace(**given, kept=kept, contact=None, obstacles=None)
        here.guard, here.running = (SimpleNamespace(state=each.state) for each in (sim.guard, sim.running))
        if sim.contact is not None:
            here.obstacles = pack_obstacles(sim.contact)
            here.contact = packed(sim.contact).at(nodes[0])
        return here

    def bodies() -> list[SoftBody]:
        sims.append(load_checkpoint(path, "cpu"))
        return list(sims[0].bodies)

    parts, here, _ = handed_bodies(bodies, told, device, comm)
    here.touching = obstacles_of(here.obstacles)
    return parts, here


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
        loaded: The simulation that one process loads from the checkpoint, or what ``load_in_parts`` gives.
        parts: This rank's simulation of parts of the same bodies.
        syncs: The ``PartSync`` of each body.
    """
    for name, array in parts.kept.items():
        k, values = body_of(name, parts), loaded.kept[name]
        values = values if isinstance(values, np.ndarray) else values.numpy()
        array.assign(values if k is None else syncs[k].part_values(values))
    for name in RESUMED:
        setattr(parts, name, getattr(loaded, name))
    if loaded.contact is not None:
        resume_contact(loaded.contact, parts, syncs)
    parts.guard.resume(**loaded.guard.state)
    parts.running.resume(**loaded.running.state)
    wp.synchronize_device(parts.device)
