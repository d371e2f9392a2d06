"""Contact in checkpoints of several ranks: a rank's values by the numbers of nodes and triangles in the whole mesh."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.keeping import keep_again, kept_arrays
from warp_corot.solvers.system import System

from .part_simulation import PartSimulation, of_their_own
from .part_sync import PartSync
from .parts import Part

Arrays = dict[str, npt.NDArray[Any]]

#: Arrays of obstacles and surface places, and of triangles, that one step leaves for the next.
NODAL, OF_TRIANGLES = ("anchors", "kinds", "forces"), ("normal", "force")
#: Arrays of obstacles and numbers of the law, which are the same on all ranks.
MOTIONS, LAW = ("now", "later", "target"), ("tolerance", "recovery", "whole", "grain")


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


def packed(here: Contacts) -> Touch:
    """That of contact of a body; of this rank's part of one, that of the nodes that it moves."""
    assert here.rigid is not None
    body = here.system.bodies[0]
    own, faces = _surface_of(body)
    node, chosen = _places_of(here, own)
    nodal: Arrays = {"body": body.state.contact_forces.numpy()[: len(own)][own]}
    for name in NODAL:
        values = np.moveaxis(getattr(here.rigid, name).numpy(), 0, 1)
        of_nodes = np.zeros((len(own), *values.shape[1:]), values.dtype)
        of_nodes[node[chosen]] = values[chosen]
        nodal[name] = of_nodes[own]
    triangles: Arrays = {"triangles": faces}
    for name in OF_TRIANGLES:
        values = getattr(here.rigid.touches, name).numpy()[:, : body.worlds * len(faces)]
        shape = (len(values), body.worlds, len(faces), 3)
        triangles[name] = np.moveaxis(values.reshape(shape), 2, 0) if values.size else np.zeros(0)
    return Touch(nodal, triangles, common_of(here))


def take(here: Contacts, nodal: Arrays, pieces: Sequence[Arrays]) -> None:
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
    for name in NODAL:
        array = getattr(here.rigid, name)
        values = array.numpy()
        values[:, used] = np.moveaxis(nodal[name][node[used]], 1, 0)
        array.assign(values)
    count = len(faces)
    given = np.concatenate([faces, *(piece["triangles"] for piece in pieces)])
    _, number = np.unique(given, axis=0, return_inverse=True)
    number = number.ravel()
    place = np.full(number.max(initial=-1) + 1, -1)
    place[number[count:]] = np.arange(len(given) - count)
    for name in OF_TRIANGLES:
        array = getattr(here.rigid.touches, name)
        values = array.numpy()
        if values.size:
            theirs = np.concatenate([piece[name] for piece in pieces])[place[number[:count]]]
            values[:, : worlds * count] = np.moveaxis(theirs, 0, 2).reshape(len(values), -1, 3)
            array.assign(values)
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


def gathered_contact(
    parts: PartSimulation, everything: Sequence[PartSync], wholes: Sequence[SoftBody | None], comm: Any
) -> Contacts | None:
    """The state from which contact of the whole body continues, on rank 0; None elsewhere. All ranks must call this.

    Args:
        parts: This rank's simulation of its parts.
        everything: The ``PartSync`` of each body.
        wholes: On rank 0 the whole bodies; those that other ranks hold, too, have contact forces of all nodes.
        comm: The ranks.
    """
    here = parts.contact
    assert here is not None
    body = wholes[0]
    if here.surface.is_whole:
        # All ranks have all of it.
        kept = copy.copy(here)
        kept.system = SimpleNamespace(bodies=wholes)  # type: ignore[assignment]
        return kept if comm.rank == 0 else None
    touch = packed(here)
    given = comm.gather((everything[0].numbers, touch), root=0)
    if given is None:
        return None
    assert body is not None
    nodal: Arrays = {}
    for nodes, each in given:
        for name, values in each.nodal.items():
            nodal.setdefault(name, np.zeros((body.node_count, *values.shape[1:]), values.dtype))[nodes] = values
    system = System([body], (), parts.pace, parts.gravity)
    whole = Contacts(system, of_their_own(here.obstacles.given), here.options, stable_dt=parts.stable_dt)
    take(whole, nodal, [each.triangles for _, each in given])
    body.state.contact_forces.assign(nodal["body"])
    _take_common(whole, touch.common)
    return whole


def resume_contact(loaded: Contacts | Touch, parts: PartSimulation, everything: Sequence[PartSync]) -> None:
    """Continue from the contact of the whole body.

    Args:
        loaded: That contact; or of a body in parts, what is left of it here.
        parts: This rank's simulation of its parts.
        everything: The ``PartSync`` of each body.
    """
    here, part = parts.contact, everything[0].part
    assert here is not None
    if here.surface.is_whole:
        assert isinstance(loaded, Contacts)
        kept = {name: array.numpy() for name, array in kept_arrays(loaded).items()}
        keep_again(here, loaded.surface.rooms, 0 if loaded.pairs is None else loaded.pairs.room, kept)
        common = common_of(loaded)
        for each in everything:
            each.take_contact_forces()
    else:
        if isinstance(loaded, Contacts):
            loaded = packed(loaded).at(part.numbers.in_worlds(part.worlds))
        take(here, loaded.nodal, [loaded.triangles])
        part.state.contact_forces.assign(np.where(part.is_own[:, None], loaded.nodal["body"], 0.0))
        common = loaded.common
    _take_common(here, common)


def common_of(here: Contacts) -> Arrays:
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
