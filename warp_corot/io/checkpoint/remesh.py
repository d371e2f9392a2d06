"""Checkpoints of bodies whose meshes change: the current pools, those that ``reset`` restores, and the options.

Pools are stored entry by entry, not as a mesh, so that a resumed run numbers new nodes like an uninterrupted one.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.snapshot import Piece, Snapshot, array_of, check_places
from warp_corot.discretization.changing.survey import Findings
from warp_corot.errors import InputError
from warp_corot.remesh.carried_activation import Keys
from warp_corot.remesh.conditions import KEPT
from warp_corot.remesh.keyframes import Row
from warp_corot.remesh.online import OnlineRemesh

if TYPE_CHECKING:
    from warp_corot.contact.tool import Tool
    from warp_corot.remesh.changing import Changing

Arrays = dict[str, np.ndarray]

#: Fields of `OnlineRemesh` that JSON can store directly.
PLAIN = ("refine_above", "simplify_below", "min_level", "max_level", "every", "capacity")
#: Modules in which criteria can be found by their names.
CRITERIA = "warp_corot.kernels."


def pack_changing(changing: Changing, prefix: str, arrays: Arrays) -> dict[str, Any]:
    """Put a body's remeshing into arrays whose names begin with ``prefix``; returns the remaining data for JSON."""
    changing.body.state.adopt_positions()
    conditions, forest, options = changing.conditions, changing.forest, changing.options
    conditions.note()
    parameters = options.parameters
    if parameters is not None:
        arrays[prefix + "parameters"] = parameters.numpy()
    for name, array in conditions.kept.items():
        arrays[f"{prefix}conditions.{name}"] = array.numpy()
    rows = conditions.keyframes.rows
    for k, row in rows.items():
        arrays[f"{prefix}row{k}.times"], arrays[f"{prefix}row{k}.displacements"] = row.times, row.displacements
    keys = conditions.activation.keys
    for k, each in enumerate(keys):
        arrays[f"{prefix}activation{k}.times"], arrays[f"{prefix}activation{k}.stress"] = each.times, each.stress
    return {
        "is_remeshed": changing.is_remeshed,
        "options": {name: getattr(options, name) for name in PLAIN},
        "criterion": None if options.criterion is None else _name_of(options.criterion),
        "parameters": parameters is not None,
        "near": None if options.near is None else options.near.place_among_obstacles()[1],
        "conditions": sorted(conditions.kept),
        "rows": list(rows),
        "between": [[*ends, row] for ends, row in conditions.keyframes.between.items()],
        "loads": changing.body.conditions.has_loads,
        "activation": changing.body.discretization.has_activation,
        "activation_rows": [each.first for each in keys],
        "at_beginning": conditions.of_present_mesh,
        "survey": asdict(changing.survey.last),
        "initial": _pack_snapshot(forest.remembered, f"{prefix}initial.", arrays),
        "present": _pack_snapshot(Snapshot.of(forest.pools, forest.carriage.arrays), f"{prefix}present.", arrays),
    }


def unpack_changing(changing: Changing, described: dict[str, Any], prefix: str, arrays: Arrays) -> None:
    """Restore the remeshing that ``pack_changing`` stored, for a body with its initial mesh."""
    forest, keyframes, body = changing.forest, changing.conditions.keyframes, changing.body
    kept_in = forest.pools, forest.carriage.arrays
    _unpacked_snapshot(kept_in, described["initial"], f"{prefix}initial.", arrays).restore(*kept_in)
    forest.remember()
    _unpacked_snapshot(kept_in, described["present"], f"{prefix}present.", arrays).restore(*kept_in)
    keyframes.rows = {
        k: Row(arrays[f"{prefix}row{k}.times"], arrays[f"{prefix}row{k}.displacements"]) for k in described["rows"]
    }
    keyframes.between = {(a, b): row for a, b, row in described["between"]}
    if described["activation"]:
        _ = body.activation  # made on first use
    changing.renew()
    activation = changing.conditions.activation
    activation.keys = [
        Keys(first, arrays[f"{prefix}activation{k}.times"], arrays[f"{prefix}activation{k}.stress"])
        for k, first in enumerate(described["activation_rows"])
    ]
    if activation.keys:
        activation.serve()
    rows = forest.carriage.arrays.row[: body.node_count].numpy()
    nodes = np.flatnonzero(rows >= 0).astype(np.int32)
    body.conditions.set_trajectories(keyframes.trajectories(nodes, rows[nodes], body.device))
    kept = {
        name: wp.array(arrays[f"{prefix}conditions.{name}"], dtype=KEPT[name], device=body.device)
        for name in described["conditions"]
    }
    changing.conditions.set_kept(kept, of_present_mesh=described["at_beginning"])
    changing.survey.last = Findings(**described["survey"])


def remesh_options(
    described: Sequence[dict[str, Any]],
    arrays: Arrays,
    device: str | wp.Device,
    given: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
    tools: Sequence[Tool],
) -> OnlineRemesh | Sequence[OnlineRemesh | None] | None:
    """The options with which the bodies of a checkpoint are remeshed.

    Args:
        described: The bodies' data.
        arrays: The checkpoint's arrays.
        device: The device of the resumed simulation.
        given: Options in place of the stored ones, except the capacity, which stays.
        tools: The obstacles of the resumed simulation.

    Raises:
        InputError: The criterion is not known, and no options replace it.
    """
    kept = [
        None
        if each["remesh"] is None or not each["remesh"]["is_remeshed"]
        else _options(each["remesh"], f"body{number}.remesh.", arrays, device, given, tools)
        for number, each in enumerate(described)
    ]
    if given is None:
        return kept if any(kept) else None
    several = list(given) if isinstance(given, Sequence) else [given] * len(described)
    if len(several) != len(kept) or not all(isinstance(each, OnlineRemesh | None) for each in several):
        return given  # the simulation reports what is wrong
    found: list[OnlineRemesh | None] = []
    for number, (own, before) in enumerate(zip(several, kept, strict=True)):
        if before is not None and own is None:
            raise InputError(f"remesh is None for body {number}, whose mesh has changed; it must be an OnlineRemesh")
        found.append(own if own is None or before is None else replace(own, capacity=before.capacity))
    return found


def _options(
    described: dict[str, Any], prefix: str, arrays: Arrays, device: Any, given: Any, tools: Sequence[Tool]
) -> OnlineRemesh:
    if described["near"] is not None:
        return OnlineRemesh(**described["options"], near=tools[described["near"]])
    name = described["criterion"]
    criterion = None if name is None else _criterion(name)
    if name is not None and criterion is None and given is None:
        raise InputError(
            f"the criterion {name.rpartition('.')[2]!r} is your own function, which a checkpoint cannot hold; load "
            "with remesh=OnlineRemesh(criterion=...) as for the original simulation"
        )
    parameters = None
    if described["parameters"]:
        parameters = wp.array(arrays[prefix + "parameters"], dtype=wp.float32, device=device)
    return OnlineRemesh(**described["options"], criterion=criterion, parameters=parameters)


def _name_of(criterion: Any) -> str:
    return f"{criterion.func.__module__}.{criterion.func.__name__}"


def _criterion(name: str) -> Any:
    """The package's own criterion with this name; None if there is none."""
    module, _, function = name.rpartition(".")
    if not module.startswith(CRITERIA):
        return None
    try:
        found = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError):
        return None
    return found if isinstance(found, wp.Function) else None


def _pack_snapshot(snapshot: Snapshot, prefix: str, arrays: Arrays) -> list[list[Any]]:
    """Put a snapshot's values into arrays; returns their names and start positions."""
    arrays[prefix + "counts"] = snapshot.counts
    for name, start, values in snapshot.pieces:
        arrays[f"{prefix}{name}.{start}"] = values.numpy()
    return [[name, start] for name, start, _ in snapshot.pieces]


def _unpacked_snapshot(kept_in: tuple[Any, Any], pieces: list[list[Any]], prefix: str, arrays: Arrays) -> Snapshot:
    counts = arrays[prefix + "counts"]
    check_places(*kept_in, counts, {f"{n}.{k}": arrays[f"{prefix}{n}.{k}"] for n, k in pieces})
    made = [Piece(n, start, _on_device(arrays[f"{prefix}{n}.{start}"], array_of(*kept_in, n))) for n, start in pieces]
    return Snapshot(counts, tuple(made))


def _on_device(values: npt.NDArray[Any], like: wp.array) -> wp.array:
    return wp.array(values, dtype=like.dtype, ndim=like.ndim, device=like.device)
