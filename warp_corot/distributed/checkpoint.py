"""Checkpoints of a run on several ranks: the files that one process would write, from which any number of ranks can
resume, and one process.

Rank 0 puts bodies in parts together to write them; to resume, every rank reads the whole and cuts out its part. What
contact leaves from one step for the next travels by the numbers of nodes and triangles in the whole mesh.
"""

from __future__ import annotations

import copy
import itertools
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.carried import keep_again, kept_arrays
from warp_corot.contact.contacts import Contacts
from warp_corot.elasticity import Corotated
from warp_corot.inputs.checks import checked_path
from warp_corot.io.checkpoint.archive import joined, load_checkpoint, pack_body, rebuilt_body, save_checkpoint, split
from warp_corot.remesh.remeshing import OnlineRemesh
from warp_corot.simulation.simulation import Simulation as OnOne
from warp_corot.solvers.system import System

from .divided_mesh import pack_part, rejoined
from .meshes import part_of_whole
from .mpi import all_or_none
from .part import Part, PartSync

if TYPE_CHECKING:
    from .simulation import Simulation

Arrays = dict[str, npt.NDArray[Any]]
Longs = npt.NDArray[np.int64]

#: The beginnings of the names of kept nodal arrays; other kept arrays are the same on all ranks.
DIRECTIONS, VELOCITIES, HISTORY, TOUCHED, SETUP = "directions", "velocities.", "history.", "touched.", "setup."
#: What a simulation continues from, besides arrays.
RESUMED = ("stable_dt", "steps_before_reset", "time_before_reset")
#: What a checkpoint has of a simulation, besides its bodies, their contact and kept arrays.
SAVED = (
    *("models", "integrator", "gravity", "deterministic", "device", "worlds", "fields", "remeshing"),
    *("guard", "running", "grasps", *RESUMED),
)
#: Keyframes of nodes and of elements: what they are called, whose they are, and of what.
KEYFRAMES = (("trajectories", "nodes", "displacements"), ("activations", "elements", "stress"))
#: Arrays of a body with an entry for each node of all worlds, by the ends of their names.
NODAL = ("displacements", "velocities", "reactions", "constrained", "loads")
#: Arrays of obstacles and surface places, and of triangles, that one step leaves for the next.
OF_PLACES, OF_TRIANGLES = ("anchors", "force"), ("normal", "force")
#: Arrays of obstacles and numbers of the law, which are the same on all ranks.
MOTIONS, LAW = ("now", "later", "target"), ("tolerance", "recovery", "whole", "grain")

#: The plain values of a body, its arrays by name, and its keyframes of each kind.
Packed = tuple[Any, Arrays, list[list[Arrays]]]


def save(path: str | PathLike[str], sim: Simulation) -> None:
    """Write a checkpoint on rank 0, which gets the whole bodies for that; all ranks must call this, with bodies in
    which all nodes that they have are up to date.

    Raises:
        InputError: On all ranks, if rank 0 cannot write.
    """
    comm, syncs = sim.comm, sim.syncs
    wholes = [_gathered_body(each, comm) for each in syncs]
    kept = {}
    for name, array in sim.kept.items():
        k, values = _body_of(name, sim), array.numpy()
        found = values if k is None else syncs[k].gather_part(values)
        if found is not None:
            kept[name] = wp.array(found, device="cpu")
    contact = None if sim.contact is None else _gathered_contact(sim, wholes)
    told = SimpleNamespace(**{name: getattr(sim, name) for name in SAVED}, bodies=wholes, kept=kept, contact=contact)
    told.guard = SimpleNamespace(state=sim.guard.state)
    in_parts = any(each.is_in_parts for each in syncs)

    def write() -> None:
        if comm.rank == 0:
            save_checkpoint(told, path, in_parts=in_parts)  # type: ignore[arg-type]

    all_or_none(write, comm)


def load(
    path: str | PathLike[str],
    device: str | wp.Device | None,
    remesh: OnlineRemesh | Sequence[OnlineRemesh | None] | None,
    comm: Any,
) -> tuple[list[SoftBody], OnOne]:
    """The bodies of a checkpoint, or this rank's parts of them, and the simulation that one process loads from it; all
    ranks must call this.

    Raises:
        InputError: As ``load_checkpoint``.
    """
    if (place := _device_of_parts(checked_path(path, "path"))) is None:
        loaded = load_checkpoint(path, device, remesh)
        return list(loaded.bodies), loaded
    loaded = load_checkpoint(path, "cpu", remesh)
    where = wp.get_device(place if device is None else device)
    return [_part_of_body(body, where, comm) for body in loaded.bodies], loaded


def resume(loaded: OnOne, sim: Simulation) -> None:
    """Resume a simulation from the one that one process loads from a checkpoint."""
    for name, array in sim.kept.items():
        k, values = _body_of(name, sim), loaded.kept[name].numpy()
        array.assign(values if k is None else sim.syncs[k].part_values(values))
    for name in RESUMED:
        setattr(sim, name, getattr(loaded, name))
    if loaded.contact is not None:
        _resume_contact(loaded.contact, sim)
    sim.guard.resume(**loaded.guard.state)
    sim.running.resume(**loaded.running.state)
    wp.synchronize_device(sim.device)


def _device_of_parts(path: str | PathLike[str]) -> str | None:
    """The device of a checkpoint of bodies in parts, or this rank's card; None if the file is another one."""
    try:
        with np.load(path, allow_pickle=False) as archive:
            header = json.loads(archive["header"].tobytes())
    except Exception:  # whoever reads it as a checkpoint says what is wrong
        return None
    return ("cpu" if header["device"] == "cpu" else str(wp.get_device())) if header.get("in_parts") else None


def _body_of(name: str, sim: OnOne) -> int | None:
    """The body to which a kept array belongs, if it has an entry for each node; otherwise None."""
    if name.startswith(HISTORY):
        count = sum(each.startswith(HISTORY) for each in sim.kept)
        return int(name.removeprefix(HISTORY)) * len(sim.bodies) // count
    for first in (DIRECTIONS, VELOCITIES, TOUCHED):
        if name.startswith(first):
            return int(name.removeprefix(first))
    if name.startswith(SETUP) and name.endswith(".at"):
        return int(name.removeprefix(SETUP).removesuffix(".at"))
    return None


# --- bodies ----------------------------------------------------------------------------------------------------------


def _part_of_body(body: SoftBody, device: wp.Device, comm: Any) -> SoftBody:
    """This rank's part of a body that all ranks have; all ranks must call this."""
    mesh, worlds = part_of_whole(body.mesh, comm), body.worlds
    plain, arrays, keyframes = _packed(body)
    numbers = mesh.numbers
    there = numbers.in_worlds(worlds)
    in_all = numbers.elements + body.world_element_count * np.arange(worlds)[:, None]
    places = []
    for items, number in ((there, body.node_count), (in_all.ravel(), worlds * body.world_element_count)):
        places.append(np.full(number, -1, np.int64))
        places[-1][items] = np.arange(len(items))
    cut = {
        name: _cut(values, *_kind_of(body, name, values), there, numbers.elements, worlds)
        for name, values in arrays.items()
    }
    return _made((plain, cut, _keyframes(keyframes, *places)), worlds, device, mesh)


def _gathered_body(each: PartSync, comm: Any) -> SoftBody | None:
    """On rank 0, the whole body of which ranks have parts, on the CPU; None elsewhere. All ranks must call this."""
    body, numbers = each.whole, each.part.numbers
    if not each.is_in_parts:
        return body if comm.rank == 0 else None
    plain, arrays, all_keyframes = _packed(body)
    owned, counted, worlds = each.part.is_own, np.flatnonzero(numbers.counted), body.worlds
    everywhere, elements = numbers.in_worlds(worlds), numbers.elements[counted]
    cut: dict[str, tuple[Any, str, int]] = {}
    for name, values in arrays.items():
        kind = _kind_of(body, name, values)
        cut[name] = _cut(values, *kind, np.flatnonzero(owned), counted, worlds), *kind
    of_mesh: Arrays = {}
    mesh = pack_part(body.mesh, of_mesh)  # type: ignore[arg-type]
    total, count = worlds * numbers.node_count, mesh["element_count"]
    of_elements = np.where(numbers.counted, numbers.elements + count * np.arange(worlds)[:, None], -1).ravel()
    keyframes = _keyframes(all_keyframes, np.where(owned, everywhere, -1), of_elements)
    given = comm.gather((everywhere[owned], elements, cut, keyframes, of_mesh), root=0)
    if given is None:
        return None
    whole: Arrays = {}
    for nodes, numbered, there, _, _ in given:
        for name, (own, what, axis) in there.items():
            if what == "same":
                whole.setdefault(name, own)
                continue
            shape = list(own.shape)
            shape[axis] = total if what == "nodes" else count
            found = np.moveaxis(whole.setdefault(name, np.zeros(shape, own.dtype)), axis, 0)
            found[nodes if what == "nodes" else numbered] = np.moveaxis(own, axis, 0)
    keyframes = [list(itertools.chain(*of_kind)) for of_kind in zip(*(each for *_, each, _ in given), strict=True)]
    rejoined_mesh = rejoined(mesh, [of_mesh for *_, of_mesh in given])
    return _made((plain, whole, keyframes), worlds, wp.get_device("cpu"), rejoined_mesh)


def _packed(body: SoftBody) -> Packed:
    no_field: Any = SimpleNamespace(state={})
    tree = pack_body(body, Corotated(), no_field, None, with_mesh=False)
    keyframes = [joined(*split(tree["state"].pop(name))) for name, *_ in KEYFRAMES]
    return *split(tree), keyframes


def _made(packed: Packed, worlds: int, device: wp.Device, mesh: Any) -> SoftBody:
    plain, arrays, keyframes = packed
    tree = joined(plain, arrays)
    state = tree["state"]
    if state["activation"] is not None:
        state["activation"] = state["activation"].ravel()
    state |= {name: given for (name, *_), given in zip(KEYFRAMES, keyframes, strict=True)}
    body = rebuilt_body(tree, worlds, device, mesh)
    body.conditions.world_starts.assign(tree["world_starts"])
    return body


def _kind_of(body: SoftBody, name: str, values: npt.NDArray[Any]) -> tuple[str, int]:
    """What the entries of an array belong to: nodes or elements of all worlds, elements of one, or nothing; and the
    axis along which they lie."""
    material, name = body.material, name.rpartition(".")[2]
    if name in NODAL:
        return "nodes", 0
    if name == "activation":
        return "stresses", 1
    axis = values.ndim - len(material.components.get(name, ())) - 1
    varies = hasattr(material, name) and axis >= 0 and values.shape[axis] == body.world_element_count > 1
    return ("elements", axis) if varies else ("same", 0)


def _cut(values: npt.NDArray[Any], kind: str, axis: int, nodes: Longs, elements: Longs, worlds: int) -> Any:
    """The values of some nodes of all worlds and elements of one world."""
    if kind == "same":
        return values
    values = values.reshape(worlds, -1) if kind == "stresses" else values
    return np.take(values, nodes if kind == "nodes" else elements, axis)


def _keyframes(given: list[list[Arrays]], nodes: Longs, elements: Longs) -> list[list[Arrays]]:
    """The keyframes, of each kind, of the nodes and elements that have a place, with these places."""
    found: list[list[Arrays]] = []
    for (_, whose, what), of_kind, place in zip(KEYFRAMES, given, (nodes, elements), strict=True):
        found.append([])
        for each in of_kind:
            items, values = each[whose], each[what]
            here = place[items] >= 0
            if here.any():
                of_each = values[:, here] if values.ndim == 3 or (what == "stress" and values.shape[1] > 1) else values
                found[-1].append(each | {whose: place[items[here]].astype(np.int32), what: of_each})
    return found


# --- contact ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Touch:
    """What one step leaves for the next.

    Attributes:
        nodal, triangles: Arrays of nodes, and of the triangles around them.
        common: What is the same on all ranks: poses and wrenches of obstacles, and the law.
    """

    nodal: Arrays
    triangles: Arrays
    common: Arrays

    def at(self, nodes: npt.NDArray[np.integer]) -> Touch:
        """The same of some of the nodes."""
        return replace(self, nodal={name: values[nodes] for name, values in self.nodal.items()})


def _pack(here: Contacts) -> Touch:
    """That of contact of a body; of this rank's part of one, that of the nodes that it moves."""
    assert here.rigid is not None
    body = here.system.bodies[0]
    own, faces = _surface_of(body)
    node, chosen = _places_of(here, own)
    nodal: Arrays = {"body": body.state.contact_forces.numpy()[: len(own)][own]}
    for name in OF_PLACES:
        values = np.moveaxis(here.rigid.parts(name)[0], 0, 1)
        of_nodes = np.zeros((len(own), *values.shape[1:]), values.dtype)
        of_nodes[node[chosen]] = values[chosen]
        nodal[name] = of_nodes[own]
    triangles: Arrays = {"triangles": faces}
    for name in OF_TRIANGLES:
        values = here.rigid.parts(name)[1][:, : body.worlds * len(faces)]
        shape = (len(values), body.worlds, len(faces), 3)
        triangles[name] = np.moveaxis(values.reshape(shape), 2, 0) if values.size else np.zeros(0)
    return Touch(nodal, triangles, _common_of(here))


def _take(here: Contacts, nodal: Arrays, pieces: Sequence[Arrays]) -> None:
    """Continue from what was packed.

    Args:
        here: Contact of a body, or of this rank's part of it.
        nodal: Arrays of all nodes here.
        pieces: The arrays of triangles of all ranks that packed.
    """
    assert here.rigid is not None
    worlds, (own, faces) = here.system.bodies[0].worlds, _surface_of(here.system.bodies[0])
    node, chosen = _places_of(here, own)
    used = chosen if here.system.is_implicit else node >= 0
    given_rows = {name: here.rigid.parts(name) for name in {*OF_PLACES, *OF_TRIANGLES}}
    for name in OF_PLACES:
        given_rows[name][0][:, used] = np.moveaxis(nodal[name][node[used]], 1, 0)
    count = len(faces)
    given = np.concatenate([faces, *(piece["triangles"] for piece in pieces)])
    _, number = np.unique(given, axis=0, return_inverse=True)
    number = number.ravel()
    place = np.full(number.max(initial=-1) + 1, -1)
    place[number[count:]] = np.arange(len(given) - count)
    for name in OF_TRIANGLES:
        values = given_rows[name][1]
        if values.size:
            theirs = np.concatenate([piece[name] for piece in pieces])[place[number[:count]]]
            values[:, : worlds * count] = np.moveaxis(theirs, 0, 2).reshape(len(values), -1, 3)
    here.rigid.assign(given_rows)
    here.search.forget()


def _surface_of(body: SoftBody) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.int64]]:
    """The nodes of a body, or of a part of one, that this rank moves, bool [worlds * n]; and the triangles of the
    surface around them, by the ascending numbers of their nodes in the whole mesh, int64 [f, 3]."""
    faces, own = body.surface_faces[0], np.ones(body.node_count, bool)
    if isinstance(body, Part):
        faces, own = body.numbers.nodes[faces], body.is_own
    return own, np.sort(faces, axis=1).astype(np.int64)


def _places_of(here: Contacts, own: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """The node at each place of the surface, -1 if there is none; and whether this rank moves it."""
    node = here.surface.arrays.node.numpy()
    return node, (node >= 0) & own[node]


def _gathered_contact(sim: Simulation, wholes: Sequence[SoftBody | None]) -> Contacts | None:
    """The state from which contact of the whole body continues, on rank 0; None elsewhere. All ranks must call this.

    Args:
        sim: The simulation.
        wholes: On rank 0 the whole bodies; those that other ranks hold, too, have contact forces of all nodes.
    """
    from .simulation import of_their_own

    here, comm, body = sim.contact, sim.comm, wholes[0]
    assert here is not None
    if here.surface.is_whole:
        # All ranks have all of it.
        kept = copy.copy(here)
        kept.system = SimpleNamespace(bodies=wholes)  # type: ignore[assignment]
        return kept if comm.rank == 0 else None
    touch = _pack(here)
    given = comm.gather((sim.syncs[0].numbers, touch), root=0)
    if given is None:
        return None
    assert body is not None
    nodal: Arrays = {}
    for nodes, each in given:
        for name, values in each.nodal.items():
            nodal.setdefault(name, np.zeros((body.node_count, *values.shape[1:]), values.dtype))[nodes] = values
    system = System([body], (), sim.pace, sim.gravity)
    whole = Contacts(system, of_their_own(here.obstacles.given), here.options, stable_dt=sim.stable_dt)
    _take(whole, nodal, [each.triangles for _, each in given])
    body.state.contact_forces.assign(nodal["body"])
    _take_common(whole, touch.common)
    return whole


def _resume_contact(loaded: Contacts, sim: Simulation) -> None:
    """Continue from the contact of the whole body."""
    here, part = sim.contact, sim.parts[0]
    assert here is not None
    if here.surface.is_whole:
        kept = {name: array.numpy() for name, array in kept_arrays(loaded).items()}
        keep_again(here, loaded.surface.rooms, 0 if loaded.pairs is None else loaded.pairs.room, kept)
        for each in sim.syncs:
            each.take_contact_forces()
    else:
        given = _pack(loaded).at(part.numbers.in_worlds(part.worlds))
        _take(here, given.nodal, [given.triangles])
        part.state.contact_forces.assign(np.where(part.is_own[:, None], given.nodal["body"], 0.0))
    _take_common(here, _common_of(loaded))


def _common_of(here: Contacts) -> Arrays:
    """What is the same on all ranks: poses and wrenches of obstacles, and the law."""
    found = {f"motions.{name}": getattr(here.obstacles.motions, name).numpy() for name in MOTIONS}
    law = np.array([float(getattr(here.law, name)) for name in LAW])
    return found | {"wrenches": here.obstacles.wrenches.numpy(), "law": law}


def _take_common(to: Contacts, common: Arrays) -> None:
    for name, value in zip(LAW, common["law"], strict=True):
        setattr(to.law, name, float(value))
    for name in MOTIONS:
        getattr(to.obstacles.motions, name).assign(common[f"motions.{name}"])
    to.obstacles.wrenches.assign(common["wrenches"])
