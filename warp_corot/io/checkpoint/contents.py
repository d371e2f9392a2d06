"""What checkpoints hold: meshes, contact, and bodies whose meshes change."""

from __future__ import annotations

import dataclasses
import importlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.contact.carried import keep_again, kept_arrays
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, SignedDistance, Sphere, TriangleMesh
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.cutting.blade import Blade, Edge
from warp_corot.discretization.changing.pools import Piece, Snapshot, array_of, check_places
from warp_corot.errors import InputError
from warp_corot.mesh import TetForest, TetMesh, Tree
from warp_corot.mesh.tree import UniformTree
from warp_corot.remesh.conditions import KEPT
from warp_corot.remesh.remeshing import OnlineRemesh

if TYPE_CHECKING:
    from warp_corot.contact.tool import Tool
    from warp_corot.remesh.changing import Changing

# --- meshes ----------------------------------------------------------------------------------------------------------

#: Fields of trees.
OF_TREE = tuple(field.name for field in dataclasses.fields(Tree))
#: Fields of forests that were made from a domain, or cut.
OF_DOMAIN = ("phi", "fill", "labels", "node_labels", "snap")


def pack_mesh(mesh: TetForest | TetMesh) -> dict[str, Any]:
    """A mesh as a tree of plain values and arrays."""
    if isinstance(mesh, TetMesh):
        names = ("points", "tets", "labels", "up_axis", "repaired", "label_names")
        return {"kind": "general"} | {name: getattr(mesh, name) for name in names}
    place = {"up_axis": mesh.up_axis, "cells": mesh.cells, "cell_size": mesh.cell_size, "origin": mesh.origin}
    if (level := box_level(mesh)) is not None:
        return {"kind": "box", "level": level} | place
    return place | {
        "kind": "forest",
        "lattice": mesh.lattice,
        "node_ends": mesh.node_ends,
        "tree": {name: getattr(mesh.tree, name) for name in OF_TREE},
        "detail": mesh.detail,
        "of_domain": {name: getattr(mesh, name) for name in OF_DOMAIN},
        "label_names": mesh.label_names,
    }


def box_level(mesh: TetForest) -> int | None:
    """The level with which ``TetForest.box`` makes a forest; None: it makes no such forest."""
    if not isinstance(mesh.tree, UniformTree) or any(getattr(mesh, name) is not None for name in OF_DOMAIN):
        return None
    box = TetForest.box(mesh.cells, mesh.cell_size, mesh.tree.depth, origin=mesh.origin, up_axis=mesh.up_axis)
    same = np.array_equal(box.lattice, mesh.lattice) and np.array_equal(box.tree.leaf_tets, mesh.tree.leaf_tets)
    return mesh.tree.depth if same else None


def unpack_mesh(packed: dict[str, Any]) -> TetForest | TetMesh:
    """The mesh that ``pack_mesh`` packed."""
    up_axis = packed["up_axis"]
    if packed["kind"] == "general":
        labels = {"labels": packed["labels"], "label_names": packed["label_names"]}
        mesh = TetMesh(packed["points"], packed["tets"], up_axis=up_axis, **labels)
        mesh.repaired = packed["repaired"]
        return mesh
    cells, origin, size = tuple(packed["cells"]), tuple(packed["origin"]), packed["cell_size"]
    if packed["kind"] == "box":
        return TetForest.box(cells, size, packed["level"], origin=origin, up_axis=up_axis)
    tree, lattice, ends = Tree(**packed["tree"]), packed["lattice"], packed["node_ends"]
    # Kernels check no indices.
    count, nodes = len(tree.tets), len(lattice)
    cut = np.zeros(count, np.int32) if tree.cut is None else tree.cut
    of_tets = [array.shape for array in (tree.level, tree.parent, tree.first_child, cut)]
    shapes = [tree.tets.shape, lattice.shape, ends.shape, *of_tets]
    if shapes != [(count, 4), (nodes, 3), (nodes, 2), *[(count,)] * 4]:
        raise ValueError(f"the tree's arrays have the shapes {shapes}")
    bounds = ((tree.tets, 0, nodes), (ends, -1, nodes), (tree.parent, -1, count), (tree.first_child, -2, count - 1))
    for array, least, most in (*bounds, (tree.level, 0, 64), (cut, 0, 32)):
        if array.dtype.kind != "i" or (array.size and not (array.min() >= least and array.max() < most)):
            raise ValueError("an index of the tree is out of range")
    more = packed["of_domain"] | {"label_names": tuple(packed["label_names"]), "detail": packed["detail"]}
    return TetForest(cells, size, origin, lattice, ends, tree, up_axis, **more)


# --- obstacles, tools, grasps, and the state of contact from which steps continue ------------------------------------

#: Functions that make shapes from their sizes and their own arrays; the place and the thickness are set afterwards.
SHAPES: dict[str, Callable[..., Shape]] = {
    "Ground": lambda size: Ground(),
    "Sphere": lambda size: Sphere(size[0]),
    "Capsule": lambda size: Capsule(size[0], 2.0 * size[1]),
    "Cylinder": lambda size: Cylinder(size[0], 2.0 * size[1]),
    "Box": lambda size: Box([2.0 * each for each in size]),
    "Edge": lambda size, points: Edge(points),
    "TriangleMesh": lambda size, points, triangles: TriangleMesh(points, triangles),
    "SignedDistance": lambda size, values, lower: SignedDistance(values, lower, spacing=size),
}
#: Arrays of shapes that have some.
OF_SHAPES = ("points", "triangles", "values", "lower")
#: Numbers of the law that steps have found.
LAW = ("tolerance", "recovery", "grain", "whole")


def pack_contact(contacts: Contacts | None, grasps: Sequence[Grasp]) -> dict[str, Any] | None:
    """Contact as a tree of plain values and arrays; None without contact.

    Raises:
        InputError: A shape of a class of your own, a grasp that an array opens and closes, or another constraint of the
            bodies.
    """
    if contacts is None:
        return None
    if any(grasp.closed is not None for grasp in grasps):
        raise InputError("a grasp that an array opens and closes cannot be saved; release it first")
    given = zip(contacts.obstacles.given, contacts.obstacles.tools, strict=True)
    return {
        "options": contacts.options,
        "obstacles": [pack_tool(tool, each is tool) for each, tool in given],
        "kept": kept_arrays(contacts),
        "forces": [body.state.contact_forces for body in contacts.system.bodies],
        "law": {name: getattr(contacts.law, name) for name in LAW},
        "rooms": contacts.surface.rooms,
        "room": 0 if contacts.pairs is None else contacts.pairs.room,
        "grasps": [
            {
                "body": contacts.system.bodies.index(grasp.body),
                "tool": contacts.obstacles.tools.index(grasp.tool),
                "stiffness": grasp.stiffness,
                "nodes": grasp.nodes,
                "kept": grasp.kept,
            }
            for grasp in grasps
        ],
    }


def unpack_contact(contacts: Contacts | None, packed: dict[str, Any] | None) -> None:
    """Restore the contact of a simulation."""
    if packed is None or contacts is None:
        return
    for name, value in packed["law"].items():
        setattr(contacts.law, name, value)
    keep_again(contacts, packed["rooms"], packed["room"], packed["kept"])
    bodies = contacts.system.bodies
    for body, forces in zip(bodies, packed["forces"], strict=True):
        body.state.contact_forces.assign(forces)
    for each in packed["grasps"]:
        tool = contacts.obstacles.tools[each["tool"]]
        grasp = Grasp(bodies[each["body"]], each["nodes"], tool=tool, stiffness=each["stiffness"])
        for name, array in grasp.kept.items():
            array.assign(each["kept"][name])


def pack_tool(tool: Tool, moves: bool) -> dict[str, Any]:
    """An obstacle as a tree of plain values and arrays: a tool that ``moves``, or a shape that stays.

    Raises:
        InputError: A shape of a class of your own.
    """
    shape = tool.shape
    kind = type(shape).__name__
    if kind not in SHAPES:
        raise InputError(f"a {kind} cannot be saved; only {', '.join(SHAPES)}")
    return {
        "shape": kind,
        "size": list(shape.size),
        "arrays": {name: np.asarray(getattr(shape, name)) for name in OF_SHAPES if hasattr(shape, name)},
        "thickness": shape.thickness if np.isfinite(shape.thickness) else None,
        "friction": shape.friction,
        "place": shape.pose,
        "moves": moves,
        "pose": tool.pose,
        "speed": tool.speed,
        "is_sent": tool.is_sent,
        "keys": tool.keys,
    }


def unpacked_tool(packed: dict[str, Any]) -> Obstacle:
    """The obstacle that ``pack_tool`` packed."""
    shape = SHAPES[packed["shape"]](packed["size"], **packed["arrays"])
    place, pose = (_finite(packed[name], (7,)) for name in ("place", "pose"))
    shape.position, shape.quaternion = place[:3], place[3:]
    shape.friction = packed["friction"]
    if packed["thickness"] is not None:
        shape.thickness = float(packed["thickness"])
    if not packed["moves"]:
        return shape
    tool = Tool(shape, speed=packed["speed"])
    if isinstance(shape, Edge):
        options = {"position": place[:3], "quaternion": place[3:], "level": packed["level"]}
        tool = Blade(shape.points, speed=packed["speed"], **options)
    tool.pose, tool.is_sent = pose, bool(packed["is_sent"])
    if packed["keys"] is not None:
        times, poses = packed["keys"]
        tool.keys = _finite(times), _finite(poses, (len(times), 7))
    return tool


def _finite(values: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
    if values.dtype != np.float64 or (shape is not None and values.shape != shape) or not np.isfinite(values).all():
        raise InputError(f"an array of a tool has shape {list(values.shape)} or is not finite")
    return values


# --- meshes that change: the current pools, those that ``reset`` restores, and the options ---------------------------
# Pools are stored entry by entry, not as a mesh, so that a resumed run numbers new nodes like an uninterrupted one.

#: Fields of `OnlineRemesh` that JSON can store directly.
PLAIN = ("refine_above", "simplify_below", "min_level", "max_level", "every", "capacity")
#: Modules in which criteria can be found by their names.
CRITERIA = "warp_corot.kernels."


def pack_changing(changing: Changing) -> dict[str, Any]:
    """A body's remeshing as a tree of plain values and arrays."""
    changing.body.state.adopt_positions()
    conditions, forest, options = changing.conditions, changing.forest, changing.options
    conditions.note()
    called = None if options.criterion is None else options.criterion.func
    packed = {
        "is_remeshed": changing.is_remeshed,
        "options": {name: getattr(options, name) for name in PLAIN},
        "criterion": None if called is None else f"{called.__module__}.{called.__name__}",
        "parameters": options.parameters,
        "near": None if options.near is None else options.near.place_among_obstacles()[1],
        "conditions": conditions.kept,
        "rows": conditions.keyframes.keys,
        "between": [[*ends, row] for ends, row in conditions.keyframes.between.items()],
        "loads": changing.body.conditions.has_loads,
        "activation": changing.body.discretization.has_activation,
        "activation_rows": conditions.of_activation.keys,
        "at_beginning": conditions.of_present_mesh,
        "survey": changing.survey.last,
    }
    # A snapshot's values by the names of their arrays and, after a dot, the beginning of the stretch.
    present = Snapshot.of(forest.pools, forest.carriage.arrays)
    for name, snapshot in (("initial", forest.remembered), ("present", present)):
        pieces = {f"{array}.{start}": values for array, start, values in snapshot.pieces}
        packed[name] = {"counts": snapshot.counts, "pieces": pieces}
    return packed


def unpack_changing(changing: Changing, packed: dict[str, Any]) -> None:
    """Restore the remeshing that ``pack_changing`` packed, for a body with its initial mesh."""
    forest, keyframes, body = changing.forest, changing.conditions.keyframes, changing.body
    kept_in = forest.pools, forest.carriage.arrays
    _unpacked_snapshot(kept_in, packed["initial"]).restore(*kept_in)
    forest.remember()
    _unpacked_snapshot(kept_in, packed["present"]).restore(*kept_in)
    keyframes.keys = packed["rows"]
    keyframes.between = {(a, b): row for a, b, row in packed["between"]}
    if packed["activation"]:
        _ = body.activation  # made on first use
    changing.renew()
    changing.conditions.of_activation.keys = packed["activation_rows"]
    changing.conditions.follow_activation()
    rows = forest.carriage.arrays.row[: body.node_count].numpy()
    nodes = np.flatnonzero(rows >= 0).astype(np.int32)
    body.conditions.set_trajectories(keyframes.make(nodes, rows[nodes], wp.vec3, body.device))
    kept = {
        name: wp.array(values, dtype=KEPT[name], device=body.device) for name, values in packed["conditions"].items()
    }
    changing.conditions.set_kept(kept, of_present_mesh=packed["at_beginning"])
    changing.survey.last = packed["survey"]


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
    criterion = None
    if name is not None and name.startswith(CRITERIA):  # one of the package's own
        module, _, function = name.rpartition(".")
        with suppress(ImportError, AttributeError):
            found = getattr(importlib.import_module(module), function)
            criterion = found if isinstance(found, wp.Function) else None
    if name is not None and criterion is None and given is None:
        raise InputError(
            f"the criterion {name.rpartition('.')[2]!r} is your own function, which a checkpoint cannot hold; load "
            "with remesh=OnlineRemesh(criterion=...) as for the original simulation"
        )
    if parameters is not None:
        parameters = wp.array(parameters, dtype=wp.float32, device=device)
    return OnlineRemesh(**packed["options"], criterion=criterion, parameters=parameters)


def _unpacked_snapshot(kept_in: tuple[Any, Any], packed: dict[str, Any]) -> Snapshot:
    check_places(*kept_in, packed["counts"], packed["pieces"])
    pieces = []
    for key, values in packed["pieces"].items():
        name, _, start = key.rpartition(".")
        if name == "void_leaves":  # of earlier versions
            continue
        like = array_of(*kept_in, name)
        on_device = wp.array(values, dtype=like.dtype, ndim=like.ndim, device=like.device)
        pieces.append(Piece(name, int(start), on_device))
    return Snapshot(packed["counts"], tuple(pieces))
