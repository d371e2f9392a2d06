"""Bodies between rank 0, which has them whole, and all ranks, which have parts: handed out, and put together."""

from __future__ import annotations

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
            if body.changing is not None or body.conditions.activations:
                said = "bodies that are remeshed or follow keyframes of active stress cannot be handed out to ranks"
                raise InputError(said)
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
    owned, counted = each.part.is_own, np.flatnonzero(numbers.counted)
    everywhere, elements = numbers.in_worlds(body.worlds), numbers.elements[counted]
    there = np.where(owned, everywhere, -1)
    kinds = {name: _kind_of(body, name, values) for name, values in arrays.items()}
    cut = {name: _cut(arrays[name], *kind, np.flatnonzero(owned), counted, body.worlds) for name, kind in kinds.items()}
    of_mesh: Arrays = {}
    mesh = pack_part(body.mesh, of_mesh)  # type: ignore[arg-type]
    motions = _motions(described, arrays, there)
    given = comm.gather((everywhere[owned], elements, cut, motions, of_mesh), root=0)
    if given is None:
        return None
    whole: Arrays = {}
    total, count = body.worlds * numbers.node_count, mesh["element_count"]
    for nodes, numbered, values, _, _ in given:
        for name, (kind, axis) in kinds.items():
            _put(whole, name, values[name], kind, axis, nodes, numbered, (total, count, body.worlds))
    motions = [motion for *_, moved, _ in given for motion in moved]
    joined = rejoined(mesh, [of_mesh for *_, of_mesh in given])
    return _made(*_with_motions(described, whole, motions), body.worlds, wp.get_device("cpu"), joined)


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
        place = np.full(body.node_count, -1, np.int64)
        place[there] = np.arange(len(there))
        cut = {
            name: _cut(values, *_kind_of(body, name, values), there, numbers.elements, body.worlds)
            for name, values in arrays.items()
        }
        given = _with_motions(described, cut, _motions(described, arrays, place))
        yield GivenBody(piece, *given, body.worlds), there


def _kind_of(body: SoftBody, name: str, values: npt.NDArray[Any]) -> tuple[str, int]:
    """What the entries of an array belong to: nodes or elements of all worlds, elements of one, or nothing; and the
    axis along which they lie."""
    material = body.material
    if name.startswith("trajectory"):
        return "motion", 0
    if name.rpartition(".")[2] in NODAL:
        return "nodes", 0
    if name == "activation":
        return "stresses", 0
    axis = values.ndim - len(material.components.get(name, ())) - 1
    varies = hasattr(material, name) and axis >= 0 and values.shape[axis] == body.world_element_count > 1
    return ("elements", axis) if varies else ("same", 0)


def _cut(values: npt.NDArray[Any], kind: str, axis: int, nodes: Longs, elements: Longs, worlds: int) -> Any:
    """The values of some nodes of all worlds and elements of one world."""
    if kind == "stresses":
        return values.reshape(worlds, -1)[:, elements]
    return values if kind in ("same", "motion") else np.take(values, nodes if kind == "nodes" else elements, axis)


def _put(
    whole: Arrays,
    name: str,
    values: npt.NDArray[Any],
    kind: str,
    axis: int,
    nodes: Longs,
    elements: Longs,
    counts: tuple[int, int, int],
) -> None:
    """Put what ``_cut`` gave into an array of the whole body."""
    if kind in ("same", "motion"):
        whole.setdefault(name, values)
        return
    axis, number = (1, elements) if kind == "stresses" else (axis, nodes if kind == "nodes" else elements)
    shape = list(values.shape)
    shape[axis] = counts[0] if kind == "nodes" else counts[1]
    found = whole.setdefault(name, np.zeros(shape, values.dtype))
    np.moveaxis(found, axis, 0)[number] = np.moveaxis(values, axis, 0)


def _motions(described: dict[str, Any], arrays: Arrays, place: Longs) -> list[Arrays]:
    """The prescribed motions of the nodes that have a place, with these places for nodes."""
    found = []
    for k in range(described["trajectories"]):
        given = {name: arrays[f"trajectory{k}.{name}"] for name in ("nodes", "times", "displacements")}
        here, to = place[given["nodes"]] >= 0, given["displacements"]
        if here.any():
            of_each = to if to.ndim == 2 else to[:, here]
            found.append(given | {"nodes": place[given["nodes"]][here].astype(np.int32), "displacements": of_each})
    return found


def _with_motions(described: dict[str, Any], arrays: Arrays, motions: list[Arrays]) -> tuple[dict[str, Any], Arrays]:
    """The same body with other motions."""
    kept = {name: values.ravel() if name == "activation" else values for name, values in arrays.items()}
    kept = {name: values for name, values in kept.items() if not name.startswith("trajectory")}
    for k, motion in enumerate(motions):
        kept |= {f"trajectory{k}.{name}": values for name, values in motion.items()}
    return described | {"trajectories": len(motions)}, kept
