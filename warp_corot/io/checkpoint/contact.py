"""Contact in checkpoints: obstacles, tools, grasps, and the state from which steps continue."""

from __future__ import annotations

from collections.abc import Sequence
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

Arrays = dict[str, np.ndarray]

#: Functions that make shapes from their sizes; the place and the thickness are set afterwards.
SHAPES = {
    "Ground": lambda size, arrays, prefix: Ground(),
    "Sphere": lambda size, arrays, prefix: Sphere(size[0]),
    "Capsule": lambda size, arrays, prefix: Capsule(size[0], 2.0 * size[1]),
    "Cylinder": lambda size, arrays, prefix: Cylinder(size[0], 2.0 * size[1]),
    "Box": lambda size, arrays, prefix: Box([2.0 * each for each in size]),
    "Edge": lambda size, arrays, prefix: Edge(arrays[prefix + "points"]),
    "TriangleMesh": lambda size, arrays, prefix: TriangleMesh(arrays[prefix + "points"], arrays[prefix + "triangles"]),
    "SignedDistance": lambda size, arrays, prefix: SignedDistance(
        arrays[prefix + "values"], arrays[prefix + "lower"], spacing=size
    ),
}
#: Arrays of shapes that have some.
OF_SHAPES = ("points", "triangles", "values", "lower")


def pack_contact(contacts: Contacts | None, grasps: Sequence[Grasp], arrays: Arrays) -> dict[str, Any] | None:
    """Put contact into arrays; returns the remaining data for JSON, None without contact.

    Raises:
        InputError: A shape of a class of your own, a grasp that an array opens and closes, or another constraint of the
            bodies.
    """
    if contacts is None:
        return None
    for name, array in kept_arrays(contacts).items():
        arrays[f"contact.{name}"] = array.numpy()
    for number, body in enumerate(contacts.system.bodies):
        arrays[f"contact.forces{number}"] = body.state.contact_forces.numpy()
    law = contacts.law
    return pack_obstacles(contacts, arrays) | {
        "law": [law.tolerance, law.recovery, law.grain, law.whole],
        "rooms": contacts.surface.rooms,
        "room": 0 if contacts.pairs is None else contacts.pairs.room,
        "grasps": [_pack_grasp(contacts, grasp, f"grasp{k}.", arrays) for k, grasp in enumerate(grasps)],
    }


def pack_obstacles(contacts: Contacts, arrays: Arrays) -> dict[str, Any]:
    """Put the obstacles of contact into arrays; returns the remaining data for JSON, with the options of contact.

    Raises:
        InputError: A shape of a class of your own.
    """
    options, given = contacts.options, zip(contacts.obstacles.given, contacts.obstacles.tools, strict=True)
    return {
        "friction": options.friction,
        "self_contact": options.self_contact,
        "flat_edges": options.flat_edges,
        "on": options.on,
        "obstacles": [_pack_tool(tool, each is tool, f"tool{k}.", arrays) for k, (each, tool) in enumerate(given)],
    }


def obstacles_of(described: dict[str, Any] | None, arrays: Arrays) -> dict[str, Any]:
    """The arguments ``obstacles`` and ``contact`` of a simulation."""
    if described is None:
        return {}
    obstacles = [_unpacked_tool(each, f"tool{k}.", arrays) for k, each in enumerate(described["obstacles"])]
    options = {name: described[name] for name in ("friction", "self_contact", "flat_edges", "on")}
    return {"obstacles": obstacles, "contact": Contact(**options)}


def unpack_contact(contacts: Contacts | None, described: dict[str, Any] | None, arrays: Arrays) -> None:
    """Restore the contact of a simulation."""
    if described is None or contacts is None:
        return
    kept = {name.removeprefix("contact."): values for name, values in arrays.items() if name.startswith("contact.")}
    for name, value in zip(("tolerance", "recovery", "grain", "whole"), described["law"], strict=True):
        setattr(contacts.law, name, value)
    keep_again(contacts, described["rooms"], described["room"], kept)
    bodies = contacts.system.bodies
    for number, body in enumerate(bodies):
        body.state.contact_forces.assign(arrays[f"contact.forces{number}"])
    for k, each in enumerate(described["grasps"]):
        tool = contacts.obstacles.tools[each["tool"]]
        grasp = Grasp(bodies[each["body"]], arrays[f"grasp{k}.nodes"], tool=tool, stiffness=each["stiffness"])
        for name, array in grasp.kept.items():
            array.assign(arrays[f"grasp{k}.{name}"])


def pack_blades(blades: Blades | None, arrays: Arrays) -> dict[str, Any]:
    """Put the blades of a simulation whose bodies can be cut into arrays; returns the remaining data for JSON."""
    if blades is None:
        return {"blades": []}
    arrays |= {f"blades.{name}": array.numpy() for name, array in blades.kept.items()}
    given = enumerate(blades.blades)
    packed = [_pack_tool(blade, True, f"blade{k}.", arrays) | {"level": blade.level} for k, blade in given]
    return {"blades": packed, "every": blades.every, "unchanged": blades.unchanged}


def blades_of(described: dict[str, Any] | None, arrays: Arrays) -> list[Any] | None:
    """The argument ``cuts`` of a simulation."""
    if described is None:
        return None
    return [_unpacked_tool(each, f"blade{k}.", arrays) for k, each in enumerate(described["blades"])]


def unpack_blades(blades: Blades | None, described: dict[str, Any], arrays: Arrays) -> None:
    """Restore what blades have done, on the present meshes."""
    if blades is None:
        return
    for name, array in blades.kept.items():
        array.assign(arrays[f"blades.{name}"])
    blades.every, blades.unchanged = int(described["every"]), int(described["unchanged"])


def _pack_grasp(contacts: Contacts, grasp: Grasp, prefix: str, arrays: Arrays) -> dict[str, Any]:
    if grasp.closed is not None:
        raise InputError("a grasp that an array opens and closes cannot be saved; release it first")
    arrays[prefix + "nodes"] = grasp.nodes
    for name, array in grasp.kept.items():
        arrays[prefix + name] = array.numpy()
    tool = contacts.obstacles.tools.index(grasp.tool)
    return {"body": contacts.system.bodies.index(grasp.body), "tool": tool, "stiffness": grasp.stiffness}


def _pack_tool(tool: Tool, moves: bool, prefix: str, arrays: Arrays) -> dict[str, Any]:
    shape = tool.shape
    kind = type(shape).__name__
    if kind not in SHAPES:
        raise InputError(f"a {kind} cannot be saved; only {', '.join(SHAPES)}")
    arrays[prefix + "place"] = shape.pose
    arrays[prefix + "pose"] = tool.pose
    for name in OF_SHAPES:
        if hasattr(shape, name):
            arrays[prefix + name] = getattr(shape, name)
    if tool.keys is not None:
        arrays[prefix + "times"], arrays[prefix + "poses"] = tool.keys
    return {
        "shape": kind,
        "size": list(shape.size),
        "thickness": shape.thickness if np.isfinite(shape.thickness) else None,
        "friction": shape.friction,
        "moves": moves,
        "speed": tool.speed,
        "is_sent": tool.is_sent,
        "follows": tool.keys is not None,
    }


def _unpacked_tool(described: dict[str, Any], prefix: str, arrays: Arrays) -> Obstacle:
    shape: Shape = SHAPES[described["shape"]](described["size"], arrays, prefix)
    place, pose = (_finite(arrays[prefix + name], (7,)) for name in ("place", "pose"))
    shape.position, shape.quaternion = place[:3], place[3:]
    shape.friction = described["friction"]
    if described["thickness"] is not None:
        shape.thickness = float(described["thickness"])
    if not described["moves"]:
        return shape
    tool = Tool(shape, speed=described["speed"])
    if isinstance(shape, Edge):
        options = {"position": place[:3], "quaternion": place[3:], "level": described["level"]}
        tool = Blade(shape.points, speed=described["speed"], **options)
    tool.pose, tool.is_sent = pose, bool(described["is_sent"])
    if described["follows"]:
        times = _finite(arrays[prefix + "times"])
        tool.keys = times, _finite(arrays[prefix + "poses"], (len(times), 7))
    return tool


def _finite(values: np.ndarray, shape: tuple[int, ...] | None = None) -> np.ndarray:
    if values.dtype != np.float64 or (shape is not None and values.shape != shape) or not np.isfinite(values).all():
        raise InputError(f"an array of a tool has shape {list(values.shape)} or is not finite")
    return values
