"""Contact in checkpoints: obstacles, tools, grasps, and the state from which steps continue."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warp_corot.contact.contacts import Contacts
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.keeping import keep_again, kept_arrays
from warp_corot.contact.options import Contact
from warp_corot.contact.sampled import SignedDistance, TriangleMesh
from warp_corot.contact.shapes import Box, Capsule, Cylinder, Ground, Shape, Sphere
from warp_corot.contact.tool import Obstacle, Tool
from warp_corot.cutting.blade import Blade, Edge
from warp_corot.errors import InputError

if TYPE_CHECKING:
    from warp_corot.cutting.blades import Blades

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
#: Options of contact.
OPTIONS = ("friction", "self_contact", "flat_edges", "on")


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
    return pack_obstacles(contacts) | {
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


def pack_obstacles(contacts: Contacts) -> dict[str, Any]:
    """The obstacles and the options of contact as a tree of plain values and arrays.

    Raises:
        InputError: A shape of a class of your own.
    """
    given = zip(contacts.obstacles.given, contacts.obstacles.tools, strict=True)
    options = {name: getattr(contacts.options, name) for name in OPTIONS}
    return {"options": options, "obstacles": [_pack_tool(tool, each is tool) for each, tool in given]}


def obstacles_of(packed: dict[str, Any] | None) -> dict[str, Any]:
    """The arguments ``obstacles`` and ``contact`` of a simulation."""
    if packed is None:
        return {}
    return {"obstacles": list(map(_unpacked_tool, packed["obstacles"])), "contact": Contact(**packed["options"])}


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


def pack_blades(blades: Blades | None) -> dict[str, Any]:
    """The blades of a simulation whose bodies can be cut as a tree of plain values and arrays."""
    if blades is None:
        return {"blades": []}
    packed = [_pack_tool(blade, True) | {"level": blade.level} for blade in blades.blades]
    return {"blades": packed, "kept": blades.kept, "every": blades.every, "unchanged": blades.unchanged}


def blades_of(packed: dict[str, Any] | None) -> list[Any] | None:
    """The argument ``cuts`` of a simulation."""
    return None if packed is None else list(map(_unpacked_tool, packed["blades"]))


def unpack_blades(blades: Blades | None, packed: dict[str, Any]) -> None:
    """Restore what blades have done, on the present meshes."""
    if blades is None:
        return
    for name, array in blades.kept.items():
        array.assign(packed["kept"][name])
    blades.every, blades.unchanged = int(packed["every"]), int(packed["unchanged"])


def _pack_tool(tool: Tool, moves: bool) -> dict[str, Any]:
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


def _unpacked_tool(packed: dict[str, Any]) -> Obstacle:
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
