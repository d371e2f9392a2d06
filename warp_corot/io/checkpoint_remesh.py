"""Checkpoints of bodies whose meshes change: the pools as they are and as ``reset`` finds them, and what was asked for.

Pools are kept place by place, not as a mesh, so that what comes next is numbered as if the run had never stopped.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from ..errors import InputError
from ..remesh.fields import CARRIED_BY_NODES, CARRIED_BY_TETRAHEDRA, OF_NODES, OF_TETRAHEDRA
from ..remesh.keyframes import Row
from ..remesh.online import OnlineRemesh
from ..remesh.snapshot import Snapshot, _Piece

if TYPE_CHECKING:
    from ..remesh.changing import Changing
    from ..remesh.pools import DeviceForest

Arrays = dict[str, np.ndarray]

#: Of `OnlineRemesh`, what JSON takes as it is.
PLAIN = ("refine_above", "simplify_below", "min_level", "max_level", "every", "capacity")
#: Where criteria are that can be found again by their names.
CRITERIA = "warp_corot.kernels."

_OF_POOLS = (*OF_NODES, *OF_TETRAHEDRA, "free_pairs", "leaves", "leaf_tets", "void_leaves")
_CARRIED = (*CARRIED_BY_NODES, *CARRIED_BY_TETRAHEDRA, "impulse")


def pack_changing(changing: Changing, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Put what remeshes a body into arrays whose names begin with ``prefix``; returns what else there is, for JSON."""
    changing.body.adopt_positions()
    changing._note_conditions()
    forest, options = changing.forest, changing.options
    parameters = options.parameters
    if parameters is not None:
        arrays[prefix + "parameters"] = parameters.numpy()
    for name, array in changing._conditions.items():
        arrays[f"{prefix}conditions.{name}"] = array.numpy()
    rows = changing._keyframes._rows
    for k, row in enumerate(rows):
        arrays[f"{prefix}row{k}.times"], arrays[f"{prefix}row{k}.displacements"] = row.times, row.displacements
    return {
        "options": {name: getattr(options, name) for name in PLAIN},
        "criterion": None if options.criterion is None else _name_of(options.criterion),
        "parameters": parameters is not None,
        "conditions": sorted(changing._conditions),
        "rows": len(rows),
        "between": [[*ends, row] for ends, row in changing._keyframes._between.items()],
        "loads": changing.body.has_loads,
        "at_beginning": changing.body.mesh_revision == changing._remembered_revision,
        "stiffness": changing._found_stiffness,
        "coarser_for": changing._coarser_for,
        "initial": _pack_snapshot(forest, forest._remembered, f"{prefix}initial.", arrays),
        "present": _pack_snapshot(forest, Snapshot(forest), f"{prefix}present.", arrays),
    }


def unpack_changing(changing: Changing, described: dict[str, Any], prefix: str, arrays: Arrays) -> None:
    """Have a body that was made as it began be remeshed as it was when ``pack_changing`` kept it."""
    forest, keyframes, body = changing.forest, changing._keyframes, changing.body
    _unpack_snapshot(forest, described["initial"], f"{prefix}initial.", arrays)
    forest.remember()
    _unpack_snapshot(forest, described["present"], f"{prefix}present.", arrays)
    carried = forest.carriage.arrays
    changing._conditions = {
        name: wp.array(arrays[f"{prefix}conditions.{name}"], dtype=getattr(carried, name).dtype, device=body.device)
        for name in described["conditions"]
    }
    keyframes._rows = [
        Row(arrays[f"{prefix}row{k}.times"], arrays[f"{prefix}row{k}.displacements"]) for k in range(described["rows"])
    ]
    keyframes._between = {(a, b): row for a, b, row in described["between"]}
    changing._renew()
    body.trajectories = keyframes.trajectories(carried.row[: body.node_count].numpy(), body.device)
    body.revision += 1
    changing._remembered_revision = body.mesh_revision if described["at_beginning"] else -1
    changing._found_stiffness, changing._coarser_for = described["stiffness"], described["coarser_for"]


def remesh_options(
    described: Sequence[dict[str, Any]],
    arrays: Arrays,
    device: str | wp.Device,
    given: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
) -> OnlineRemesh | Sequence[OnlineRemesh | None] | None:
    """How the bodies of a checkpoint are to be remeshed.

    Args:
        described: The bodies.
        arrays: Of the checkpoint.
        device: Where the simulation goes on.
        given: In place of what was kept, but for the capacity, which stays.

    Raises:
        InputError: A criterion that is not known, and nothing is given in its place.
    """
    kept = [
        None if each["remesh"] is None else _options(each["remesh"], f"body{number}.remesh.", arrays, device, given)
        for number, each in enumerate(described)
    ]
    if given is None:
        return kept if any(kept) else None
    several = list(given) if isinstance(given, Sequence) else [given] * len(described)
    if len(several) != len(kept) or not all(isinstance(each, OnlineRemesh | None) for each in several):
        return given  # the simulation says what is wrong
    found: list[OnlineRemesh | None] = []
    for number, (own, before) in enumerate(zip(several, kept, strict=True)):
        if before is not None and own is None:
            raise InputError(f"remesh is None for body {number}, whose mesh has changed; it must be an OnlineRemesh")
        found.append(own if own is None or before is None else replace(own, capacity=before.capacity))
    return found


def _options(described: dict[str, Any], prefix: str, arrays: Arrays, device: Any, given: Any) -> OnlineRemesh:
    name = described["criterion"]
    criterion = None if name is None else _criterion(name)
    if name is not None and criterion is None and given is None:
        raise InputError(
            f"the criterion {name.rpartition('.')[2]!r} is a function of yours, which a checkpoint does not hold; load "
            "with remesh=OnlineRemesh(criterion=...) as the simulation was made"
        )
    parameters = None
    if described["parameters"]:
        parameters = wp.array(arrays[prefix + "parameters"], dtype=wp.float32, device=device)
    return OnlineRemesh(**described["options"], criterion=criterion, parameters=parameters)


def _name_of(criterion: Any) -> str:
    return f"{criterion.func.__module__}.{criterion.func.__name__}"


def _criterion(name: str) -> Any:
    """The package's own criterion of a name; None if it is none of these."""
    module, _, function = name.rpartition(".")
    if not module.startswith(CRITERIA):
        return None
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError):
        return None
    return found if isinstance(found, wp.Function) else None


def _pack_snapshot(forest: DeviceForest, snapshot: Snapshot, prefix: str, arrays: Arrays) -> list[list[Any]]:
    """Put a snapshot's values into arrays; returns their names and the places where they start."""
    names = {id(array): name for name, array in _pool_arrays(forest).items()}
    arrays[prefix + "counts"] = snapshot._counts
    pieces = []
    for piece in snapshot._pieces:
        name = names[id(piece.array)]
        arrays[f"{prefix}{name}.{piece.start}"] = piece.values.numpy()
        pieces.append([name, piece.start])
    return pieces


def _unpack_snapshot(forest: DeviceForest, pieces: list[list[Any]], prefix: str, arrays: Arrays) -> None:
    pools, snapshot = _pool_arrays(forest), Snapshot(forest)
    snapshot._counts = arrays[prefix + "counts"]
    snapshot._pieces = [
        _Piece(pools[name], start, _on_device(arrays[f"{prefix}{name}.{start}"], pools[name])) for name, start in pieces
    ]
    snapshot.restore(forest)


def _on_device(values: npt.NDArray[Any], like: wp.array) -> wp.array:
    return wp.array(values, dtype=like.dtype, ndim=like.ndim, device=like.device)


def _pool_arrays(forest: DeviceForest) -> dict[str, wp.array]:
    pools, carried = forest.pools, forest.carriage.arrays
    return {name: getattr(pools, name) for name in _OF_POOLS} | {name: getattr(carried, name) for name in _CARRIED}
