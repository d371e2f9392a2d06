"""Checkpoints of bodies in parts: a file for each rank, and one that names them; any number of ranks can load them."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Sequence
from os import PathLike
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import MODELS, ForceField, Model
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_path
from warp_corot.io.checkpoint.archive import (
    FORMAT_IN_PARTS,
    GUARDED,
    VERSION,
    check_version,
    described_of,
    pack_body,
    rebuilt,
    rebuilt_body,
    write_archive,
)
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.solvers import INTEGRATORS

from .boxes import box
from .checkpoint import Values, body_of
from .contact_checkpoint import obstacles_in, pack_touch, resume_touch
from .divided_mesh import DividedForest, DividedTetMesh
from .mpi import all_or_none
from .part_simulation import PartSimulation
from .part_sync import PartSync
from .rejoining import pack_part, rejoined
from .scatter_mesh import divided

Arrays = dict[str, npt.NDArray[Any]]

#: Nodal arrays of a body, by the ends of their names.
NODAL = ("displacements", "velocities", "reactions", "constrained", "loads")
#: The arrays of a prescribed motion that pieces contain.
MOTION = ("world", "nodes", "times", "to")


def save(path: str | PathLike[str], parts: PartSimulation, syncs: list[PartSync], comm: Any) -> None:
    """Write a checkpoint; all ranks must call.

    ``run.npz`` names the files ``run.ranks/step-…-rank-0000.npz`` and so on, each with the nodes that a rank moves.
    The files of a former checkpoint of this name are removed once all are written.

    Raises:
        InputError: On all ranks: bodies that are not in parts, or a rank cannot write.
    """
    target = checked_path(path, "path")
    if not all(each.is_in_parts for each in syncs):
        raise InputError("checkpoints of bodies in parts beside others do not work yet")
    folder = target.with_name(f"{target.stem}.ranks")
    names = [f"step-{parts.total_steps:012d}-rank-{rank:04d}.npz" for rank in range(comm.size)]
    piece: Arrays = {}
    bodies = [
        _pack(each, model, field, k, piece)
        for k, (each, model, field) in enumerate(zip(syncs, parts.models, parts.fields, strict=True))
    ]
    for name, array in parts.kept.items():
        body = body_of(name, parts)
        rows = array.numpy()
        if body is None:
            piece[f"same/kept.{name}"] = rows
        else:
            piece[f"nodes{body}/kept.{name}"] = rows[syncs[body].part.is_own]
    contact = None if parts.contact is None else pack_touch(parts.contact, syncs[0], piece)
    guard = {f"guard.{name}": values for name, values in parts.guard.state.items()}
    header = _header(parts) | {"bodies": bodies, "contact": contact, "pieces": names}

    def write_piece() -> None:
        folder.mkdir(exist_ok=True)
        write_archive(folder / names[comm.rank], piece)

    def write_header() -> None:
        if comm.rank == 0:
            write_archive(target, guard | {"header": np.frombuffer(json.dumps(header).encode(), np.uint8)})

    for act in (write_piece, write_header):
        all_or_none(act, comm)
    if comm.rank == 0:
        for former in folder.glob("step-*-rank-*.npz"):
            if former.name not in names:
                former.unlink(missing_ok=True)


def load(path: str | PathLike[str], device: str | wp.Device | None) -> SimpleNamespace | None:
    """The bodies of a checkpoint, of which this rank has its part, and what a simulation of them continues from.

    None if the file is another checkpoint, or none. All ranks must call.

    Raises:
        InputError: A piece is missing or damaged.
    """
    target = checked_path(path, "path")
    try:
        with np.load(target, allow_pickle=False) as archive:
            header = json.loads(archive["header"].tobytes())
            if header["format"] != FORMAT_IN_PARTS:
                return None
            check_version(header, target)
            guard = {name: archive[f"guard.{name}"] for name in GUARDED}
    except InputError:
        raise
    except Exception:  # whoever reads it as another checkpoint says what is wrong
        return None
    try:
        return _rebuilt_run(target, header, guard, device)
    except InputError:
        raise
    except Exception as error:  # any error of NumPy, zip files, or missing names
        raise InputError(f"{target} is not a complete checkpoint of bodies in parts: {error}") from error


def _header(parts: PartSimulation) -> dict[str, Any]:
    plain = ("stable_dt", "steps_before_reset", "time_before_reset", "gravity", "deterministic", "worlds")
    return {name: getattr(parts, name) for name in plain} | {
        "format": FORMAT_IN_PARTS,
        "version": VERSION,
        "device": str(parts.device),
        "integrator": described_of(parts.integrator, INTEGRATORS),
        "running": parts.running.state,
    }


def _pack(each: PartSync, model: Model, field: ForceField, k: int, piece: Arrays) -> dict[str, Any]:
    """Put this rank's part of the k-th body into its piece; returns what is the same on all ranks."""
    body, numbers, prefix = each.whole, each.part.numbers, f"body{k}."
    mesh, arrays = body.mesh, Arrays()
    assert isinstance(mesh, DividedForest | DividedTetMesh)
    described = pack_body(body, model, field, None, prefix, arrays, with_mesh=False)
    described.pop("trajectories")
    owned, counted = each.part.is_own, np.flatnonzero(numbers.counted)
    piece[f"nodes{k}/numbers"] = numbers.nodes[owned[: len(numbers.nodes)]]
    piece[f"elements{k}/numbers"] = numbers.elements[counted]
    for name, values in arrays.items():
        own = name.removeprefix(prefix)
        if own.rpartition(".")[2] in NODAL and not own.startswith("trajectory"):
            piece[f"nodes{k}/{name}"] = values[owned]
        elif own in {each.name for each in dataclasses.fields(body.material)}:
            axis = values.ndim - len(body.material.components.get(own, ())) - 1
            if axis >= 0 and values.shape[axis] == len(numbers.elements) > 1:
                piece[f"elements{k}/{name}"] = np.moveaxis(np.take(values, counted, axis=axis), axis, 0)
                described.setdefault("axes", {})[name] = axis
            else:
                piece[f"same/{name}"] = values
        elif own == "activation":
            piece[f"stresses{k}/numbers"] = numbers.elements[counted]
            piece[f"stresses{k}/{name}"] = values.reshape(body.worlds, -1)[:, counted].ravel()
        elif not own.startswith("trajectory"):
            piece[f"same/{name}"] = values
    for number, motion in enumerate(body.conditions.trajectories):
        mine = owned[motion.host_nodes]
        times, displacements = motion.keys()
        of_each = displacements if displacements.ndim == 2 else displacements[:, mine]
        world, node = np.divmod(motion.host_nodes[mine], len(numbers.nodes))
        for what, values in (("world", world), ("nodes", numbers.nodes[node]), ("times", times), ("to", of_each)):
            piece[f"motion{k}/{number}.{what}"] = values
    if not mesh.is_box:
        return described | {"divided": pack_part(mesh, f"mesh{k}/", piece)}
    assert isinstance(mesh, DividedForest)
    place = {"cells": mesh.cells, "cell_size": mesh.cell_size, "origin": mesh.origin, "up_axis": mesh.up_axis}
    return described | {"box": place | {"level": int(mesh.tree.leaf_levels[0])}}


def _rebuilt_run(
    target: Path, header: dict[str, Any], guard: Arrays, device: str | wp.Device | None
) -> SimpleNamespace:
    worlds, bodies = header["worlds"], []
    folder = target.with_name(f"{target.stem}.ranks")
    files = [folder / name for name in header["pieces"]]
    meshes = [_rebuilt_mesh(each, k, files) for k, each in enumerate(header["bodies"])]
    arrays: Arrays = {}
    counts, touched = [0] * len(meshes), []
    for file in files:
        with np.load(file, allow_pickle=False) as archive:
            piece = {name: archive[name] for name in archive.files if not name.startswith("mesh")}
        for k, mesh in enumerate(meshes):
            _take(piece, mesh, k, worlds, arrays)
            counts[k] += _take_motions(piece, mesh, k, counts[k], arrays)
        prefix = "touched/"
        touched.append({k.removeprefix(prefix): v for k, v in piece.items() if k.startswith(prefix)})
        arrays |= {name.removeprefix("same/"): values for name, values in piece.items() if name.startswith("same/")}
    if device is None:
        device = "cpu" if header["device"] == "cpu" else wp.get_device()
    for k, (each, mesh) in enumerate(zip(header["bodies"], meshes, strict=True)):
        for name, axis in each.get("axes", {}).items():
            arrays[name] = np.moveaxis(arrays[name], 0, axis)
        body = rebuilt_body(each | {"trajectories": counts[k]}, f"body{k}.", arrays, worlds, device, mesh)
        body.conditions.world_starts.assign(arrays[f"body{k}.world_starts"].astype(np.float64))
        bodies.append(body)
    kept = {name.removeprefix("kept."): Values(a) for name, a in arrays.items() if name.startswith("kept.")}
    plain = ("gravity", "deterministic", "stable_dt", "steps_before_reset", "time_before_reset")
    return SimpleNamespace(
        **{name: header[name] for name in plain},
        bodies=bodies,
        models=[rebuilt(each["model"], MODELS) for each in header["bodies"]],
        integrator=rebuilt(header["integrator"], INTEGRATORS),
        kept=kept,
        contact=None,
        touching=obstacles_in(header.get("contact"), arrays),
        resume_touch=functools.partial(resume_touch, arrays, touched),
        guard=SimpleNamespace(state=guard),
        running=SimpleNamespace(state=header["running"]),
    )


def _rebuilt_mesh(described: dict[str, Any], k: int, files: Sequence[Path]) -> DividedForest | DividedTetMesh:
    """This rank's part of the k-th body's mesh; rank 0 makes a divided one whole again, and divides it."""
    if "box" in described:
        return box(**described["box"] | {"cells": tuple(described["box"]["cells"])})
    prefix = f"mesh{k}/"

    def whole() -> TetForest | TetMesh:
        parts = []
        try:
            for file in files:
                with np.load(file, allow_pickle=False) as archive:
                    own = [name for name in archive.files if name.startswith(prefix)]
                    parts.append({name.removeprefix(prefix): archive[name] for name in own})
            return rejoined(described["divided"], parts)
        except InputError:
            raise
        except Exception as error:  # any error of NumPy, zip files, or missing names
            raise InputError(f"{files[0].parent} does not have the parts of a mesh: {error}") from error

    return divided(whole)


def _take(piece: Arrays, mesh: DividedForest | DividedTetMesh, k: int, worlds: int, arrays: Arrays) -> None:
    """Copy a piece's values to the arrays of this rank's part of the k-th body."""
    nodes, elements = mesh.numbers.nodes, mesh.numbers.elements
    for kind, numbers, copies in (("nodes", nodes, worlds), ("elements", elements, 1), ("stresses", elements, worlds)):
        prefix = f"{kind}{k}/"
        given = piece.get(prefix + "numbers", elements[:0])
        _, here, there = np.intersect1d(numbers, given, assume_unique=True, return_indices=True)
        for name, values in piece.items():
            if not name.startswith(prefix) or name == prefix + "numbers":
                continue
            shape = (copies * len(numbers), *values.shape[1:])
            found = arrays.setdefault(name.removeprefix(prefix), np.zeros(shape, values.dtype))
            by_world = found.reshape(copies, len(numbers), *values.shape[1:])
            by_world[:, here] = values.reshape(copies, len(given), *values.shape[1:])[:, there]


def _take_motions(piece: Arrays, mesh: DividedForest | DividedTetMesh, k: int, first: int, arrays: Arrays) -> int:
    """Copy prescribed motions of nodes of this rank's part of the k-th body; returns how many there are."""
    count, nodes = 0, mesh.numbers.nodes
    order = np.argsort(nodes)
    for name in sorted(name for name in piece if name.startswith(f"motion{k}/") and name.endswith(".nodes")):
        world, wanted, times, to = (piece[f"{name.removesuffix('nodes')}{what}"] for what in MOTION)
        place = order[np.searchsorted(nodes[order], wanted).clip(max=len(nodes) - 1)]
        here = nodes[place] == wanted
        if here.any():
            motion = f"body{k}.trajectory{first + count}."
            arrays[motion + "nodes"] = (place + len(nodes) * world)[here].astype(np.int32)
            arrays |= {motion + "times": times, motion + "displacements": to if to.ndim == 2 else to[:, here]}
            count += 1
    return count
