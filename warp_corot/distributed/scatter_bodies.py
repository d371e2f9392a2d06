"""Bodies that rank 0 has whole, handed out in parts: their material, supports, motions, loads and state."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.errors import InputError
from warp_corot.materials.isotropic import Material

from .parts import part_of_material
from .scatter_mesh import Piece, dealt, handed_out, pieces_of

Vectors = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class GivenBody:
    """A part of a body on its way to the rank that computes it.

    Attributes:
        piece: The part of its mesh.
        material: The material of the part's elements.
        worlds: Number of copies.
        held: Which nodes of the part are held, bool [worlds * n].
        motions: Prescribed motions: nodes [k], times [K] and displacements [K, 3] or [K, k, 3].
        loads, displacements, velocities: float32 [worlds * n, 3]; None: they are zero.
        activation: Active stress of the part's elements [Pa], float32 [worlds * t]; None: there is none.
    """

    piece: Piece
    material: Material
    worlds: int
    held: npt.NDArray[np.bool_]
    motions: list[tuple[npt.NDArray[np.integer], Vectors, Vectors]]
    loads: Vectors | None
    displacements: Vectors | None
    velocities: Vectors | None
    activation: Vectors | None

    def made(self, device: str | wp.Device | None) -> SoftBody:
        kind, place, options = self.piece
        body = SoftBody(kind(*place, **options), self.material, worlds=self.worlds, device=device)
        body.fix(self.held)
        for nodes, times, displacements in self.motions:
            body.follow(nodes, times=times, displacements=displacements)
        if self.loads is not None:
            body.loads.assign(self.loads)
        if self.displacements is not None:
            body.displacements = self.displacements
        if self.velocities is not None:
            body.state.set_velocities(self.velocities)
        if self.activation is not None:
            body.activation.assign(self.activation)
        return body


def handed_bodies(
    bodies: Sequence[SoftBody] | None, options: dict[str, Any] | None, device: str | wp.Device | None, comm: Any
) -> tuple[list[SoftBody], dict[str, Any], list[list[npt.NDArray[np.int64]]]]:
    """This rank's parts of the bodies of rank 0; all ranks must call this.

    Args:
        bodies: The whole bodies, on rank 0.
        options: Anything else that all ranks get, on rank 0.
        device: The device of this rank's parts.
        comm: The ranks.

    Returns:
        The parts; the options; and on rank 0 the nodes of each rank's part of each body among those of all worlds of
        the whole body, int64 [worlds * n], elsewhere none.

    Raises:
        InputError: On all ranks: a body cannot be divided.
    """
    nodes: list[list[npt.NDArray[np.int64]]] = []

    def given() -> Iterator[Any]:
        assert bodies is not None
        for body in bodies:
            if body.changing is not None or body.conditions.activations:
                said = "bodies that are remeshed or follow keyframes of active stress cannot be handed out to ranks"
                raise InputError(said)
        each = [_pieces(body, comm.size) for body in bodies]
        for own in zip(*each, strict=True):
            nodes.append([there for _, there in own])
            yield [given for given, _ in own], options

    pieces, told = handed_out(given, comm)
    return [piece.made(device) for piece in pieces], told, nodes


def _pieces(body: SoftBody, ranks: int) -> Iterator[tuple[GivenBody, npt.NDArray[np.int64]]]:
    """Each rank's part of a body, and its nodes among those of all worlds of the whole body."""
    count = len(body.mesh.tets)
    held = body.constrained
    loads = body.loads.numpy() if body.conditions.has_loads else None
    displacements, velocities = (
        array.numpy()[: body.node_count, :3] for array in (body.state.displacements, body.state.velocities)
    )
    has_stress = body.discretization.has_activation
    stress = body.activation.numpy().reshape(body.worlds, -1) if has_stress else None
    moves = [(motion.host_nodes, *motion.keys()) for motion in body.conditions.trajectories]
    for piece in pieces_of(body.mesh, dealt(body.mesh, ranks)):
        numbers = piece[2]["numbers"]
        there = numbers.in_worlds(body.worlds)
        place = np.full(body.node_count, -1, np.int64)
        place[there] = np.arange(len(there))
        yield (
            GivenBody(
                piece,
                part_of_material(body.material, numbers.elements, count),
                body.worlds,
                held[there],
                [moved for each in moves if len((moved := _here(*each, place))[0])],
                loads=None if loads is None else loads[there],
                displacements=displacements[there] if displacements.any() else None,
                velocities=velocities[there] if velocities.any() else None,
                activation=None if stress is None else stress[:, numbers.elements].ravel(),
            ),
            there,
        )


def _here(
    nodes: npt.NDArray[np.integer], times: Vectors, displacements: Vectors, place: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.integer], Vectors, Vectors]:
    """The motion of a part's nodes, from that of the whole body's."""
    here = place[nodes] >= 0
    return place[nodes[here]], times, displacements if displacements.ndim == 2 else displacements[:, here]
