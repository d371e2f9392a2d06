"""The adjoint of a state of rest: one linear solve with the stiffness in that state."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.nodal import padded
from warp_corot.elasticity import ForceField
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.preconditioners import preconditioner_of
from warp_corot.solvers.implicit.tangent import TangentOperator

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: Solves of one after another, each for what the last one left, and iterations of each.
REFINEMENTS, MOST = 3, 20000
#: A residual above this is no answer: rounding of float32 leaves less.
LARGEST_RESIDUAL = 1e-2


class StaticAdjoint:
    """Solves K a = g for the adjoint motion a, zero at held nodes, in a body's present state.

    Args:
        body: The body, at rest.
        field: Its elastic forces.
        preconditioner: As for ``solve_static``.
        tolerance: Norm of g - K a over that of g.

    Attributes:
        iterations: Of conjugate gradients, of the world that needed most.
        residual: g - K a over g, of the world with the largest.
    """

    def __init__(self, body: SoftBody, field: ForceField, preconditioner: str | None, tolerance: float):
        self.body, self.operator, self._tolerance = body, TangentOperator(body, field, exact=True), tolerance
        self._preconditioner = preconditioner_of(preconditioner, self.operator)
        u = body.state.displacements
        self._solver = ConjugateGradients(self.operator, len(u), most=MOST)
        self._solver.tolerance.fill_(tolerance)
        self.operator.take(u)
        self._preconditioner.update(self.operator)
        self.iterations, self.residual = 0, 0.0

    def solve(self, derivative: npt.NDArray[np.float64]) -> tuple[wp.array, npt.NDArray[np.float64]]:
        """The adjoint motion [1/N times the unit of J], vec4 [worlds * N], and the derivative with respect to where
        held nodes are held, zero at others, float64 [worlds * N, 3].

        Args:
            derivative: g, of J with respect to positions, [worlds * N, 3].

        Raises:
            ConvergenceError: K is not positive definite, or the solve did not converge.
        """
        body = self.body
        held = body.conditions.held_mask()
        if derivative.shape != (body.sizes.nodes, 3):
            raise InputError(f"the derivative has shape {derivative.shape}; it must be [{body.sizes.nodes}, 3]")
        self.iterations = 0
        right = np.where(held[:, None], 0.0, derivative).reshape(body.worlds, -1)
        scale = np.abs(right).max(axis=1)
        scale = np.where(scale > 0.0, scale, 1.0)
        found = self._refined((right / scale[:, None]).reshape(-1, 3))
        adjoint = (found.reshape(body.worlds, -1) * scale[:, None]).reshape(-1, 3)
        motion = wp.array(padded(adjoint), dtype=wp.vec4, device=body.device)
        return motion, np.where(held[:, None], derivative - self._product(motion), 0.0)

    def _refined(self, right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The solution, to the digits of K's products, in float64."""
        worlds, device = self.body.worlds, self.body.device
        x = wp.zeros(len(right), dtype=wp.vec4, device=device)
        solution, left = np.zeros_like(right), right
        wanted = np.linalg.norm(right.reshape(worlds, -1), axis=1)
        held, best = self.body.conditions.held_mask()[:, None], np.inf
        for _ in range(REFINEMENTS):
            self._solver.launch(self._preconditioner, wp.array(padded(left), dtype=wp.vec4, device=device), x)
            report = self._solver.report()
            if report.negative.any() or report.broken.any():
                raise ConvergenceError(
                    "the stiffness is not positive definite: the state of rest is not stable, and has no gradient"
                )
            self.iterations += int(report.iterations.max())
            trial = solution + x.numpy()[:, :3]
            rest = wp.array(padded(trial), dtype=wp.vec4, device=device)
            left = np.where(held, 0.0, right - self._product(rest))
            norms = np.linalg.norm(left.reshape(worlds, -1), axis=1)
            residual = float((norms / np.where(wanted > 0.0, wanted, 1.0)).max())
            if not residual < best:
                break
            solution, best = trial, residual
            if residual < self._tolerance:
                break
        self.residual = best
        if best > LARGEST_RESIDUAL:
            raise ConvergenceError(f"the adjoint solve did not converge: its residual is {best:.2g}")
        return solution

    def _product(self, x: wp.array) -> npt.NDArray[np.float64]:
        """K x at all nodes, held ones too."""
        y = wp.zeros_like(x)
        self.operator.tangent.add_product(x, y)
        return y.numpy()[:, :3].astype(np.float64)
