"""The state at which implicit steps of a Newton model are linearised; see ``kernels.newton.turning``."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.kernels.implicit import turning
from warp_corot.kernels.newton import turning as kernels
from warp_corot.mesh.growing.cut import connected
from warp_corot.solvers.implicit.sums import WorldSums

from .library import newton
from .tetrahedra import Tetrahedra
from .unknowns import Unknowns


class TurnedPieces:
    """A model whose free pieces are turned as they will turn in a step; see ``solvers.implicit.turning``.

    Pieces with held particles are not turned.

    Args:
        model: The model.
        tetrahedra: Its elements.
        unknowns: The entries of vectors.

    Attributes:
        positions: Those of the turned particles [m], vec3 [P].
        way: The way to them [m], vec4 [entries].
    """

    def __init__(self, model: newton.Model, tetrahedra: Tetrahedra, unknowns: Unknowns):
        self._model, self._tetrahedra, self._entry, device = model, tetrahedra, unknowns.particle, model.device
        piece = np.full(model.particle_count, -1, np.int32)
        piece[tetrahedra.tets] = connected(tetrahedra.tets)[:, None]
        members = np.argsort(piece, kind="stable")[np.count_nonzero(piece < 0) :]
        first = np.cumsum(np.bincount(piece + 1))
        first -= first[0]
        count = len(first) - 1
        self._sums = WorldSums(count, int(np.diff(first).max(initial=0)), turning.COLUMNS, device)
        self._piece, self._members, self._first = (
            wp.array(values, dtype=wp.int32, device=device) for values in (piece, members, first)
        )
        self._centres = wp.zeros(count, dtype=wp.vec3, device=device)
        self._turns = wp.zeros(count, dtype=wp.mat33, device=device)
        self._any_turns = wp.zeros(1, dtype=wp.int32, device=device)
        self.positions = wp.zeros(model.particle_count, dtype=wp.vec3, device=device)
        self.way = wp.zeros(len(unknowns), dtype=wp.vec4, device=device)

    def launch(self, state: newton.State, dt: float) -> None:
        """Launch the turn in a step of dt [s]; the elements' gathered positions are turned, too."""
        model, tets, sums, q = self._model, self._tetrahedra, self._sums, state.particle_q
        _, threads, lanes = sums.sizes
        inputs = [self._first, self._members, model.particle_inv_mass, model.particle_flags, q, state.particle_qd]
        wp.launch(kernels.sum_motion, sums.shape, [*inputs, threads, lanes], [sums.parts], device=model.device)
        outputs = [self._centres, self._turns, self._any_turns]
        sums.launch_scalars(turning.find_turns, [wp.float64(dt)], outputs)
        inputs = [self._piece, q, self._centres, self._turns, self._entry]
        outputs = [tets.x, tets.u, self.positions, self.way]
        wp.launch(kernels.turn_particles, model.particle_count, inputs, outputs, device=model.device)
