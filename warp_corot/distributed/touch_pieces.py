"""Contact with obstacles in checkpoints of a body in parts: a rank's values by the numbers of nodes and triangles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.contacts import Contacts
from warp_corot.io.checkpoint.contact import obstacles_of, pack_obstacles

from .part_simulation import PartSimulation
from .part_sync import PartSync
from .touch_checkpoint import NODAL

Arrays = dict[str, npt.NDArray[Any]]

#: Arrays that are the same on all ranks, those of obstacles; and arrays of triangles.
COMMON = ("now", "later", "target")
OF_TRIANGLES = ("normal", "force")


def pack_touch(here: Contacts, following: PartSync, piece: Arrays) -> dict[str, Any]:
    """Put this rank's contact into its piece; returns what is the same on all ranks.

    Args:
        here: Contact of this rank's part.
        following: The ``PartSync`` of the body.
        piece: The piece.
    """
    assert here.rigid is not None
    own, part = following.part.is_own, following.part
    node, chosen = _nodes(here, own)
    for name in NODAL:
        values = np.moveaxis(getattr(here.rigid, name).numpy(), 0, 1)
        of_nodes = np.zeros((len(own), *values.shape[1:]), values.dtype)
        of_nodes[node[chosen]] = values[chosen]
        piece[f"nodes0/contact.{name}"] = of_nodes[own]
    assert part.state.contact_forces is not None
    piece["nodes0/contact.body"] = part.state.contact_forces.numpy()[: len(own)][own]
    piece["touched/triangles"] = triangles = _triangles(following)
    for name in OF_TRIANGLES:
        values = getattr(here.rigid.touches, name).numpy()[:, : part.worlds * len(triangles)]
        shape = (len(values), part.worlds, len(triangles), 3)
        piece[f"touched/{name}"] = np.moveaxis(values.reshape(shape), 2, 0) if values.size else np.zeros(0)
    obstacles: Arrays = {}
    described = pack_obstacles(here, obstacles)
    for name in COMMON:
        obstacles[f"motions.{name}"] = getattr(here.obstacles.motions, name).numpy()
    obstacles["wrenches"] = here.obstacles.wrenches.numpy()
    piece |= {f"same/contact.{name}": values for name, values in obstacles.items()}
    return described | {"law": [here.law.tolerance, here.law.recovery, here.law.whole]}


def obstacles_in(described: dict[str, Any] | None, arrays: Arrays) -> dict[str, Any]:
    """The arguments ``obstacles`` and ``contact`` of a simulation."""
    prefix = "contact."
    return obstacles_of(described, {k.removeprefix(prefix): v for k, v in arrays.items() if k.startswith(prefix)})


def resume_touch(
    described: dict[str, Any], arrays: Arrays, pieces: Sequence[Arrays], parts: PartSimulation, following: PartSync
) -> None:
    """Continue from the contact of a checkpoint.

    Args:
        described: As ``pack_touch`` returned it.
        arrays: Arrays of the nodes of this rank's part, and those that are the same on all ranks.
        pieces: The arrays of triangles of all pieces.
        parts: This rank's simulation of its part.
        following: The ``PartSync`` of the body.
    """
    here = parts.contact
    assert here is not None
    assert here.rigid is not None
    node, chosen = _nodes(here, following.part.is_own)
    used = chosen if here.system.is_implicit else node >= 0
    for name in NODAL:
        values = getattr(here.rigid, name).numpy()
        values[:, used] = np.moveaxis(arrays[f"contact.{name}"][node[used]], 1, 0)
        getattr(here.rigid, name).assign(values)
    _resume_triangles(here, pieces, following)
    following.publish()  # makes room for forces
    forces = following.whole.state.contact_forces
    assert forces is not None
    forces.assign(arrays["contact.body"])
    for name, value in zip(("tolerance", "recovery", "whole"), described["law"], strict=False):
        setattr(here.law, name, value)
    for name in COMMON:
        getattr(here.obstacles.motions, name).assign(arrays[f"contact.motions.{name}"])
    here.obstacles.wrenches.assign(arrays["contact.wrenches"])
    following.take_contact_forces()
    here.search.forget()


def _resume_triangles(here: Contacts, pieces: Sequence[Arrays], following: PartSync) -> None:
    assert here.rigid is not None
    mine, worlds = _triangles(following), following.part.worlds
    given = np.concatenate([mine, *(piece["touched/triangles"] for piece in pieces)])
    _, number = np.unique(given, axis=0, return_inverse=True)
    number = number.ravel()
    place = np.full(number.max(initial=-1) + 1, -1)
    place[number[len(mine) :]] = np.arange(len(given) - len(mine))
    for name in OF_TRIANGLES:
        array = getattr(here.rigid.touches, name)
        values = array.numpy()
        if not values.size:
            continue
        theirs = np.concatenate([piece[f"touched/{name}"] for piece in pieces])[place[number[: len(mine)]]]
        values[:, : worlds * len(mine)] = np.moveaxis(theirs, 0, 2).reshape(len(values), -1, 3)
        array.assign(values)


def _nodes(here: Contacts, own: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.bool_]]:
    """The node of the part at each place of its surface, -1 if there is none; and whether this rank moves it."""
    node = here.surface.arrays.node.numpy()
    return node, (node >= 0) & own[node]


def _triangles(following: PartSync) -> npt.NDArray[np.int64]:
    """The triangles around the nodes that this rank moves, by the nodes' numbers in the whole mesh, int64 [f, 3]."""
    faces, _ = following.part.surface_faces
    return np.sort(following.part.numbers.nodes[faces], axis=1).astype(np.int64)
