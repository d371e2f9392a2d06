"""Contact in checkpoints of several ranks: from the ranks' parts to the whole body, and back."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.contacts import Contacts
from warp_corot.contact.keeping import keep_again, kept_arrays
from warp_corot.solvers.system import System

from .part_simulation import PartSimulation, of_their_own
from .part_sync import PartSync

Ints = npt.NDArray[np.intp]

#: Arrays of obstacles and surface places that one step leaves for the next.
NODAL = ("anchors", "kinds", "forces")


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
    following, body = everything[0], everything[0].whole
    assert here.rigid is not None
    touches = here.rigid.touches
    own, of_nodes, of_triangles = _places(here, following)
    mine = (
        of_nodes[own],
        [getattr(here.rigid, name).numpy()[:, own] for name in NODAL],
        of_triangles,
        *(array.numpy()[:, : len(of_triangles)] for array in (touches.normal, touches.force)),
    )
    given = comm.gather(mine, root=0)
    if given is None:
        return None
    forces = wp.clone(body.state.contact_forces)
    system = System([body], (), parts.pace, parts.gravity)
    whole = Contacts(system, of_their_own(here.obstacles.given), here.options, stable_dt=parts.stable_dt)
    assert whole.rigid is not None
    body.state.contact_forces.assign(forces)
    nodal = [getattr(whole.rigid, name).numpy() for name in NODAL]
    normal, force = (array.numpy() for array in (whole.rigid.touches.normal, whole.rigid.touches.force))
    for nodes, theirs, triangles, their_normal, their_force in given:
        for values, their_values in zip(nodal, theirs, strict=True):
            values[:, nodes] = their_values
        if normal.size:
            normal[:, triangles], force[:, triangles] = their_normal, their_force
    for name, values in zip(NODAL, nodal, strict=True):
        getattr(whole.rigid, name).assign(values)
    whole.rigid.touches.normal.assign(normal)
    whole.rigid.touches.force.assign(force)
    _take_common(whole, here)
    return whole


def resume_contact(loaded: Contacts, parts: PartSimulation, everything: Sequence[PartSync]) -> None:
    """Continue from the contact of the whole body.

    Args:
        loaded: That contact.
        parts: This rank's simulation of its parts.
        everything: The ``PartSync`` of each body.
    """
    here, following = parts.contact, everything[0]
    assert here is not None
    if here.surface.is_whole:
        kept = {name: array.numpy() for name, array in kept_arrays(loaded).items()}
        keep_again(here, loaded.surface.rooms, 0 if loaded.pairs is None else loaded.pairs.room, kept)
        _take_common(here, loaded)
        for each in everything:
            each.take_contact_forces()
        return
    assert here.rigid is not None
    assert loaded.rigid is not None
    own, of_nodes, of_triangles = _places(here, following)
    used = own if here.system.is_implicit else of_nodes >= 0
    for name in NODAL:
        values = getattr(here.rigid, name).numpy()
        values[:, used] = getattr(loaded.rigid, name).numpy()[:, of_nodes[used]]
        getattr(here.rigid, name).assign(values)
    for name in ("normal", "force"):
        array = getattr(here.rigid.touches, name)
        values = array.numpy()
        if values.size:
            values[:, : len(of_triangles)] = getattr(loaded.rigid.touches, name).numpy()[:, of_triangles]
            array.assign(values)
    _take_common(here, loaded)
    following.take_contact_forces()
    here.search.forget()


def _places(here: Contacts, following: PartSync) -> tuple[npt.NDArray[np.bool_], Ints, Ints]:
    """Which places of this rank's surface have nodes that it moves; the place of each in the whole body's surface, -1
    if there is none; and the places of its triangles there, world after world."""
    whole, numbers, skin = following.whole, following.part.numbers, here.surface.parts[0]
    triangles = whole.surface_triangles
    nodes = np.unique(triangles)
    found = np.full(here.surface.count, -1, np.intp)
    own = np.zeros(here.surface.count, bool)
    for world in range(whole.worlds):
        places = slice(skin.start + world * skin.nodes, skin.start + world * skin.nodes + len(skin.skin.nodes))
        found[places] = world * len(nodes) + np.searchsorted(nodes, numbers.nodes[skin.skin.nodes])
        own[places] = following.part.is_own[skin.skin.nodes]
    here_of_whole = following.part.surface_here
    shift = len(triangles) * np.arange(whole.worlds)[:, None]
    return own, found, (here_of_whole + shift).ravel().astype(np.intp)


def _take_common(to: Contacts, other: Contacts) -> None:
    """Copy what is the same on all ranks: poses and wrenches of obstacles, and the law."""
    for name in ("tolerance", "recovery", "whole", "grain"):
        setattr(to.law, name, getattr(other.law, name))
    for name in ("now", "later", "target"):
        getattr(to.obstacles.motions, name).assign(getattr(other.obstacles.motions, name).numpy())
    to.obstacles.wrenches.assign(other.obstacles.wrenches.numpy())
