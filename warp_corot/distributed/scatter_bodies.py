"""Bodies between rank 0, which has them whole, and all ranks, which have parts: handed out, and put together."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.elasticity import Corotated
from warp_corot.errors import InputError
from warp_corot.io.checkpoint.archive import pack_body, rebuilt_body
from warp_corot.io.checkpoint.tree import joined, split

from .part_sync import PartSync
from .rejoining import Arrays, pack_part, rejoined
from .scatter_mesh import Piece, dealt, handed_out, pieces_of

Longs = npt.NDArray[np.int64]

#: Keyframes of nodes and of elements: what they are called, whose they are, and of what.
KEYFRAMES = (("trajectories", "nodes", "displacements"), ("activations", "elements", "stress"))
#: Arrays of a body with an entry for each node of all worlds, by the ends of their names.
NODAL = ("displacements", "velocities", "reactions", "constrained", "loads")

#: The plain values of a body, its arrays by name, and its keyframes of each kind.
Packed = tuple[Any, Arrays, list[list[Arrays]]]


@dataclass(frozen=True, eq=False)
class GivenBody:
    """A part of a body on its way to the rank that computes it.

    Attributes:
        piece: The part of its mesh.
        packed: What ``_packed`` gives, of this part.
        worlds: Number of copies.
    """

    piece: Piece
    packed: Packed
    worlds: int

    def made(self, device: str | wp.Device | None) -> SoftBody:
        kind, place, options = self.piece
        return _made(self.packed, self.worlds, wp.get_device(device), kind(*place, **options))


def handed_bodies(
    wholes: Callable[[], Sequence[SoftBody]] | None,
    told: Callable[[list[Longs]], Any] | None,
    device: str | wp.Device | None,
    comm: Any,
) -> tuple[list[SoftBody], Any, list[list[Longs]]]:
    """This rank's parts of the bodies of rank 0; all ranks must call this.

    Args:
        wholes: Gives the whole bodies, on rank 0.
        told: Gives what else a rank gets, from the nodes of its parts, on rank 0.
        device: The device of this rank's parts.
        comm: The ranks.

    Returns:
        The parts; what else was given; and on rank 0 the nodes of each rank's part of each body among those of all
        worlds of the whole body, int64 [worlds * n], elsewhere none.

    Raises:
        InputError: On all ranks: a body cannot be divided.
    """
    nodes: list[list[Longs]] = []

    def given() -> Iterator[Any]:
        assert wholes is not None
        assert told is not None
        bodies = wholes()
        for body in bodies:
            if body.changing is not None:
                raise InputError("bodies that are remeshed cannot be handed out to ranks")
        each = [_pieces(body, comm.size) for body in bodies]
        for own in zip(*each, strict=True):
            nodes.append([there for _, there in own])
            yield [given for given, _ in own], told(nodes[-1])

    pieces, others = handed_out(given, comm)
    return [piece.made(device) for piece in pieces], others, nodes


def gathered_body(each: PartSync, comm: Any) -> SoftBody | None:
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


def _pieces(body: SoftBody, ranks: int) -> Iterator[tuple[GivenBody, Longs]]:
    """Each rank's part of a body, and its nodes among those of all worlds of the whole body."""
    plain, arrays, keyframes = _packed(body)
    for piece, numbers in pieces_of(body.mesh, dealt(body.mesh, ranks)):
        there = numbers.in_worlds(body.worlds)
        in_all = numbers.elements + body.world_element_count * np.arange(body.worlds)[:, None]
        places = []
        for items, number in ((there, body.node_count), (in_all.ravel(), body.worlds * body.world_element_count)):
            places.append(np.full(number, -1, np.int64))
            places[-1][items] = np.arange(len(items))
        cut = {
            name: _cut(values, *_kind_of(body, name, values), there, numbers.elements, body.worlds)
            for name, values in arrays.items()
        }
        yield GivenBody(piece, (plain, cut, _keyframes(keyframes, *places)), body.worlds), there


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
