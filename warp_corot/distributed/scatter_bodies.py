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

from .part_sync import PartSync
from .rejoining import Arrays, pack_part, rejoined
from .scatter_mesh import Piece, dealt, handed_out, pieces_of

Longs = npt.NDArray[np.int64]

#: Keyframes of nodes and of elements: the beginning of their arrays' names, how many there are, whose, and of what.
KEYFRAMES = (
    ("trajectory", "trajectories", "nodes", "displacements"),
    ("activation", "activations", "elements", "stress"),
)
#: Arrays of a body with an entry for each node of all worlds, by the ends of their names.
NODAL = ("displacements", "velocities", "reactions", "constrained", "loads")


@dataclass(frozen=True, eq=False)
class GivenBody:
    """A part of a body on its way to the rank that computes it.

    Attributes:
        piece: The part of its mesh.
        described, arrays: As ``pack_body`` gives them, without a mesh.
        worlds: Number of copies.
    """

    piece: Piece
    described: dict[str, Any]
    arrays: Arrays
    worlds: int

    def made(self, device: str | wp.Device | None) -> SoftBody:
        kind, place, options = self.piece
        return _made(self.described, self.arrays, self.worlds, wp.get_device(device), kind(*place, **options))


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
    described, arrays = _packed(body)
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
    keyframes = _keyframes(described, arrays, np.where(owned, everywhere, -1), of_elements)
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
    joined = rejoined(mesh, [of_mesh for *_, of_mesh in given])
    return _made(*_with_keyframes(described, whole, keyframes), worlds, wp.get_device("cpu"), joined)


def _packed(body: SoftBody) -> tuple[dict[str, Any], Arrays]:
    arrays: Arrays = {}
    no_field: Any = SimpleNamespace(state={})
    return pack_body(body, Corotated(), no_field, None, "", arrays, with_mesh=False), arrays


def _made(described: dict[str, Any], arrays: Arrays, worlds: int, device: wp.Device, mesh: Any) -> SoftBody:
    body = rebuilt_body(described, "", arrays, worlds, device, mesh)
    body.conditions.world_starts.assign(arrays["world_starts"])
    return body


def _pieces(body: SoftBody, ranks: int) -> Iterator[tuple[GivenBody, Longs]]:
    """Each rank's part of a body, and its nodes among those of all worlds of the whole body."""
    described, arrays = _packed(body)
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
        given = _with_keyframes(described, cut, _keyframes(described, arrays, *places))
        yield GivenBody(piece, *given, body.worlds), there


def _kind_of(body: SoftBody, name: str, values: npt.NDArray[Any]) -> tuple[str, int]:
    """What the entries of an array belong to: nodes or elements of all worlds, elements of one, or nothing; and the
    axis along which they lie."""
    material = body.material
    if _of_keyframes(name) is not None:
        return "same", 0
    if name.rpartition(".")[2] in NODAL:
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


def _keyframes(described: dict[str, Any], arrays: Arrays, nodes: Longs, elements: Longs) -> list[list[Arrays]]:
    """The keyframes, of each kind, of the nodes and elements that have a place, with these places."""
    found: list[list[Arrays]] = []
    for (prefix, count, whose, what), place in zip(KEYFRAMES, (nodes, elements), strict=True):
        found.append([])
        for k in range(described[count]):
            items, times, values = (arrays[f"{prefix}{k}.{name}"] for name in (whose, "times", what))
            here = place[items] >= 0
            if here.any():
                of_each = values[:, here] if values.ndim == 3 or (what == "stress" and values.shape[1] > 1) else values
                found[-1].append({whose: place[items[here]].astype(np.int32), "times": times, what: of_each})
    return found


def _with_keyframes(
    described: dict[str, Any], arrays: Arrays, keyframes: list[list[Arrays]]
) -> tuple[dict[str, Any], Arrays]:
    """The same body with other keyframes."""
    kept = {name: values for name, values in arrays.items() if _of_keyframes(name) is None}
    if "activation" in kept:
        kept["activation"] = kept["activation"].ravel()
    counts = {}
    for (prefix, count, _, _), given in zip(KEYFRAMES, keyframes, strict=True):
        counts[count] = len(given)
        kept |= {f"{prefix}{k}.{name}": values for k, each in enumerate(given) for name, values in each.items()}
    return described | counts, kept


def _of_keyframes(name: str) -> str | None:
    """The beginning of a name, if it is that of an array of keyframes."""
    return next((prefix for prefix, *_ in KEYFRAMES if name.startswith(prefix) and "." in name), None)
