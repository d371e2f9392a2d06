"""Checkpoints of bodies whose meshes change: the current pools, those that ``reset`` restores, and the options.

Pools are stored entry by entry, not as a mesh, so that a resumed run numbers new nodes like an uninterrupted one.
"""

from __future__ import annotations

import importlib
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any

import numpy as np
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

#: Fields of `OnlineRemesh` that JSON can store directly.
PLAIN = ("refine_above", "simplify_below", "min_level", "max_level", "every", "capacity")
#: Modules in which criteria can be found by their names.
CRITERIA = "warp_corot.kernels."


def pack_changing(changing: Changing) -> dict[str, Any]:
    """A body's remeshing as a tree of plain values and arrays."""
    changing.body.state.adopt_positions()
    conditions, forest, options = changing.conditions, changing.forest, changing.options
    conditions.note()
    return {
        "is_remeshed": changing.is_remeshed,
        "options": {name: getattr(options, name) for name in PLAIN},
        "criterion": None if options.criterion is None else _name_of(options.criterion),
        "parameters": options.parameters,
        "near": None if options.near is None else options.near.place_among_obstacles()[1],
        "conditions": conditions.kept,
        "rows": [[k, row.times, row.displacements] for k, row in conditions.keyframes.rows.items()],
        "between": [[*ends, row] for ends, row in conditions.keyframes.between.items()],
        "loads": changing.body.conditions.has_loads,
        "activation": changing.body.discretization.has_activation,
        "activation_rows": [[each.first, each.times, each.stress] for each in conditions.activation.keys],
        "at_beginning": conditions.of_present_mesh,
        "survey": asdict(changing.survey.last),
        "initial": _pack_snapshot(forest.remembered),
        "present": _pack_snapshot(Snapshot.of(forest.pools, forest.carriage.arrays)),
    }


def unpack_changing(changing: Changing, packed: dict[str, Any]) -> None:
    """Restore the remeshing that ``pack_changing`` packed, for a body with its initial mesh."""
    forest, keyframes, body = changing.forest, changing.conditions.keyframes, changing.body
    kept_in = forest.pools, forest.carriage.arrays
    _unpacked_snapshot(kept_in, packed["initial"]).restore(*kept_in)
    forest.remember()
    _unpacked_snapshot(kept_in, packed["present"]).restore(*kept_in)
    keyframes.rows = {k: Row(times, displacements) for k, times, displacements in packed["rows"]}
    keyframes.between = {(a, b): row for a, b, row in packed["between"]}
    if packed["activation"]:
        _ = body.activation  # made on first use
    changing.renew()
    activation = changing.conditions.activation
    activation.keys = [Keys(*row) for row in packed["activation_rows"]]
    if activation.keys:
        activation.serve()
    rows = forest.carriage.arrays.row[: body.node_count].numpy()
    nodes = np.flatnonzero(rows >= 0).astype(np.int32)
    body.conditions.set_trajectories(keyframes.trajectories(nodes, rows[nodes], body.device))
    kept = {
        name: wp.array(values, dtype=KEPT[name], device=body.device) for name, values in packed["conditions"].items()
    }
    changing.conditions.set_kept(kept, of_present_mesh=packed["at_beginning"])
    changing.survey.last = Findings(**packed["survey"])


def remesh_options(
    packed: Sequence[dict[str, Any]],
    device: str | wp.Device,
    given: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
    tools: Sequence[Tool],
) -> OnlineRemesh | Sequence[OnlineRemesh | None] | None:
    """The options with which the bodies of a checkpoint are remeshed.

    Args:
        packed: The bodies.
        device: The device of the resumed simulation.
        given: Options in place of the stored ones, except the capacity, which stays.
        tools: The obstacles of the resumed simulation.

    Raises:
        InputError: The criterion is not known, and no options replace it.
    """
    kept = [
        None
        if each["remesh"] is None or not each["remesh"]["is_remeshed"]
        else _options(each["remesh"], device, given, tools)
        for each in packed
    ]
    if given is None:
        return kept if any(kept) else None
    several = list(given) if isinstance(given, Sequence) else [given] * len(packed)
    if len(several) != len(kept) or not all(isinstance(each, OnlineRemesh | None) for each in several):
        return given  # the simulation reports what is wrong
    found: list[OnlineRemesh | None] = []
    for number, (own, before) in enumerate(zip(several, kept, strict=True)):
        if before is not None and own is None:
            raise InputError(f"remesh is None for body {number}, whose mesh has changed; it must be an OnlineRemesh")
        found.append(own if own is None or before is None else replace(own, capacity=before.capacity))
    return found


def _options(packed: dict[str, Any], device: Any, given: Any, tools: Sequence[Tool]) -> OnlineRemesh:
    if packed["near"] is not None:
        return OnlineRemesh(**packed["options"], near=tools[packed["near"]])
    name, parameters = packed["criterion"], packed["parameters"]
    criterion = None if name is None else _criterion(name)
    if name is not None and criterion is None and given is None:
        raise InputError(
            f"the criterion {name.rpartition('.')[2]!r} is your own function, which a checkpoint cannot hold; load "
            "with remesh=OnlineRemesh(criterion=...) as for the original simulation"
        )
    if parameters is not None:
        parameters = wp.array(parameters, dtype=wp.float32, device=device)
    return OnlineRemesh(**packed["options"], criterion=criterion, parameters=parameters)


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


def _pack_snapshot(snapshot: Snapshot) -> dict[str, Any]:
    """A snapshot's values by the names of their arrays and, after a dot, the beginning of the stretch."""
    pieces = {f"{name}.{start}": values for name, start, values in snapshot.pieces}
    return {"counts": snapshot.counts, "pieces": pieces}


def _unpacked_snapshot(kept_in: tuple[Any, Any], packed: dict[str, Any]) -> Snapshot:
    check_places(*kept_in, packed["counts"], packed["pieces"])
    pieces = []
    for key, values in packed["pieces"].items():
        name, _, start = key.rpartition(".")
        like = array_of(*kept_in, name)
        on_device = wp.array(values, dtype=like.dtype, ndim=like.ndim, device=like.device)
        pieces.append(Piece(name, int(start), on_device))
    return Snapshot(packed["counts"], tuple(pieces))
