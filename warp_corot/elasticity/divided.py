"""Elastic forces on the CPU in parts that threads compute side by side, without a place that two of them write to."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import warp as wp

from warp_corot.discretization.plan import Slots
from warp_corot.inputs.cpu_threads import Regions, Team


class Piece(Protocol):
    """The forces of some elements; launches go through ``inputs.cpu_threads.launch``."""

    def scatter_forces(self, u: wp.array, f: wp.array) -> None: ...

    @property
    def nodes(self) -> list[wp.array]:
        """The nodes of these elements, in arrays of any shape."""
        ...


class DividedForces:
    """Forces of the pieces of a field.

    Each piece adds its forces to an array of its own, so that their order never depends on the threads. Then each
    thread adds up those of some nodes, in the order of the pieces.

    Args:
        team: As many threads as there are pieces.
        pieces: The pieces.
        count: Number of nodes.
    """

    def __init__(self, team: Team, pieces: Sequence[Piece], count: int):
        self._pieces, self._bounds = pieces, team.bounds(count)
        touched = np.zeros((len(pieces), count), bool)
        for of_piece, piece in zip(touched, pieces, strict=True):
            for nodes in piece.nodes:
                of_piece[nodes.numpy().ravel()] = True
        starts = np.concatenate([[0], np.cumsum(touched.sum(axis=0))])
        piece_of, node_of = np.nonzero(touched.T)[::-1]
        order = piece_of * count + node_of
        begins, places = (wp.array(each, dtype=wp.int32, device="cpu") for each in (starts, order))
        values = wp.zeros((len(pieces), count), dtype=wp.vec4, device="cpu")
        self._values, self._slots = values, Slots(begins, places, values.flatten())
        self._regions = Regions(team, values.device)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f; both vec4 [N]."""
        self._regions.launch(
            (u.ptr, f.ptr),
            lambda part: self._pieces[part].scatter_forces(u, self._values[part]),
            lambda part: self._slots.gather(f, *self._bounds[part], clears=True),
        )
