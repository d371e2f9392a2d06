"""Contact in checkpoints of several ranks: a rank's values by the numbers of nodes and triangles in the whole mesh."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.contacts import Contacts
from warp_corot.contact.keeping import keep_again, kept_arrays
from warp_corot.io.checkpoint.contact import obstacles_of, pack_obstacles
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
class SurfaceShare:
    """What a rank knows of the surface of a body.

    Attributes:
        own: The nodes that it moves, bool [worlds * n].
        triangles: The triangles around these, by the ascending numbers of their nodes in the whole mesh, int64 [f, 3].
        worlds: Number of copies of the body.
    """

    own: npt.NDArray[np.bool_]
    triangles: npt.NDArray[np.int64]
    worlds: int

    @classmethod
    def of(cls, body: SoftBody) -> SurfaceShare:
        """That of a part, or of a whole body."""
        faces = body.surface_faces[0]
        if isinstance(body, Part):
            return cls(body.is_own, np.sort(body.numbers.nodes[faces], axis=1).astype(np.int64), body.worlds)
        return cls(np.ones(body.node_count, bool), np.sort(faces, axis=1).astype(np.int64), body.worlds)

    def places(self, here: Contacts) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
        """The node at each place of the surface, -1 if there is none; and whether this rank moves it."""
        node = here.surface.arrays.node.numpy()
        return node, (node >= 0) & self.own[node]


def packed(here: Contacts, share: SurfaceShare) -> tuple[Arrays, Arrays]:
    """What one step leaves for the next: arrays of the nodes that this rank moves, and of triangles."""
    assert here.rigid is not None
    node, chosen = share.places(here)
    nodal: Arrays = {}
    triangles: Arrays = {"triangles": share.triangles}
    for name in NODAL:
        values = np.moveaxis(getattr(here.rigid, name).numpy(), 0, 1)
        of_nodes = np.zeros((len(share.own), *values.shape[1:]), values.dtype)
        of_nodes[node[chosen]] = values[chosen]
        nodal[name] = of_nodes[share.own]
    count = len(share.triangles)
    for name in OF_TRIANGLES:
        values = getattr(here.rigid.touches, name).numpy()[:, : share.worlds * count]
        shape = (len(values), share.worlds, count, 3)
        triangles[name] = np.moveaxis(values.reshape(shape), 2, 0) if values.size else np.zeros(0)
    return nodal, triangles


def take(here: Contacts, share: SurfaceShare, nodal: Arrays, pieces: Sequence[Arrays]) -> None:
    """Continue from what was packed.

    Args:
        here: Contact of a body, or of this rank's part of it.
        share: Its share.
        nodal: Arrays of all nodes here.
        pieces: The arrays of triangles of all ranks that packed.
    """
    assert here.rigid is not None
    node, chosen = share.places(here)
    used = chosen if here.system.is_implicit else node >= 0
    for name in NODAL:
        array = getattr(here.rigid, name)
        values = array.numpy()
        values[:, used] = np.moveaxis(nodal[name][node[used]], 1, 0)
        array.assign(values)
    count = len(share.triangles)
    given = np.concatenate([share.triangles, *(piece["triangles"] for piece in pieces)])
    _, number = np.unique(given, axis=0, return_inverse=True)
    number = number.ravel()
    place = np.full(number.max(initial=-1) + 1, -1)
    place[number[count:]] = np.arange(len(given) - count)
    for name in OF_TRIANGLES:
        array = getattr(here.rigid.touches, name)
        values = array.numpy()
        if values.size:
            theirs = np.concatenate([piece[name] for piece in pieces])[place[number[:count]]]
            values[:, : share.worlds * count] = np.moveaxis(theirs, 0, 2).reshape(len(values), -1, 3)
            array.assign(values)
    here.search.forget()


def gathered_contact(parts: PartSimulation, everything: Sequence[PartSync], comm: Any) -> Contacts | None:
    """The state from which contact of the whole body continues, on rank 0; None elsewhere. All ranks must call this.

    Args:
        parts: This rank's simulation of its parts.
        everything: The ``PartSync`` of each body; the whole bodies have contact forces of all nodes.
        comm: The ranks.
    """
    here = parts.contact
    assert here is not None
    if here.surface.is_whole:
        # All ranks have all of it.
        kept = copy.copy(here)
        kept.system = SimpleNamespace(bodies=[each.whole for each in everything])  # type: ignore[assignment]
        return kept if comm.rank == 0 else None
    part, body = everything[0].part, everything[0].whole
    given = comm.gather((everything[0].own_nodes, *packed(here, SurfaceShare.of(part))), root=0)
    if given is None:
        return None
    forces = wp.clone(body.state.contact_forces)
    system = System([body], (), parts.pace, parts.gravity)
    whole = Contacts(system, of_their_own(here.obstacles.given), here.options, stable_dt=parts.stable_dt)
    body.state.contact_forces.assign(forces)
    nodal: Arrays = {}
    for nodes, own, _ in given:
        for name, values in own.items():
            nodal.setdefault(name, np.zeros((body.node_count, *values.shape[1:]), values.dtype))[nodes] = values
    take(whole, SurfaceShare.of(body), nodal, [triangles for *_, triangles in given])
    _take_common(whole, common_of(here))
    return whole


def resume_contact(loaded: Contacts, parts: PartSimulation, everything: Sequence[PartSync]) -> None:
    """Continue from the contact of the whole body.

    Args:
        loaded: That contact.
        parts: This rank's simulation of its parts.
        everything: The ``PartSync`` of each body.
    """
    here = parts.contact
    assert here is not None
    if here.surface.is_whole:
        kept = {name: array.numpy() for name, array in kept_arrays(loaded).items()}
        keep_again(here, loaded.surface.rooms, 0 if loaded.pairs is None else loaded.pairs.room, kept)
    else:
        part, (nodal, triangles) = everything[0].part, packed(loaded, SurfaceShare.of(everything[0].whole))
        everywhere = part.numbers.in_worlds(part.worlds)
        take(here, SurfaceShare.of(part), {name: values[everywhere] for name, values in nodal.items()}, [triangles])
    _take_common(here, common_of(loaded))
    for each in everything:
        each.take_contact_forces()


def pack_touch(here: Contacts, sync: PartSync, piece: Arrays) -> dict[str, Any]:
    """Put this rank's contact into its piece; returns what is the same on all ranks.

    Args:
        here: Contact of this rank's part.
        sync: The ``PartSync`` of the body.
        piece: The piece.
    """
    part = sync.part
    nodal, triangles = packed(here, SurfaceShare.of(part))
    assert part.state.contact_forces is not None
    nodal["body"] = part.state.contact_forces.numpy()[: len(part.is_own)][part.is_own]
    obstacles = common_of(here)
    described = pack_obstacles(here, obstacles)
    for prefix, arrays in (("nodes0/contact.", nodal), ("touched/", triangles), ("same/contact.", obstacles)):
        piece |= {prefix + name: values for name, values in arrays.items()}
    return described


def obstacles_in(described: dict[str, Any] | None, arrays: Arrays) -> dict[str, Any]:
    """The arguments ``obstacles`` and ``contact`` of a simulation."""
    return obstacles_of(described, _of_contact(arrays))


def resume_touch(arrays: Arrays, pieces: Sequence[Arrays], parts: PartSimulation, sync: PartSync) -> None:
    """Continue from the contact of a checkpoint in parts.

    Args:
        arrays: Arrays of the nodes of this rank's part, and those that are the same on all ranks.
        pieces: The arrays of triangles of all pieces.
        parts: This rank's simulation of its part.
        sync: The ``PartSync`` of the body.
    """
    here, given = parts.contact, _of_contact(arrays)
    assert here is not None
    take(here, SurfaceShare.of(sync.part), given, pieces)
    sync.publish()  # makes room for forces
    forces = sync.whole.state.contact_forces
    assert forces is not None
    forces.assign(given["body"])
    _take_common(here, given)
    sync.take_contact_forces()


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


def _of_contact(arrays: Arrays) -> Arrays:
    return {name.removeprefix("contact."): values for name, values in arrays.items() if name.startswith("contact.")}
