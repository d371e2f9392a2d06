"""Adjoint motions: linear solves with the stiffness in a state, plus the inertia of a time step if there is one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.sizes import padded
from warp_corot.elasticity import ForceField
from warp_corot.errors import ConvergenceError
from warp_corot.solvers.implicit.conjugate_gradients import ConjugateGradients
from warp_corot.solvers.implicit.preconditioners import preconditioner_of
from warp_corot.solvers.implicit.tangent import TangentOperator

from .contact import RestingContact

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

#: Maximum number of solves, each for the residual of the one before, and of iterations in each.
REFINEMENTS, MOST = 3, 20000
#: The residual at which a solve with contact may end for its rounding.
ENOUGH = 1e-4
#: A larger residual means failure: the rounding of float32 leaves less.
LARGEST_RESIDUAL = 1e-2


class Adjoint:
    """Solves (K + s M) a = g for the adjoint motion a, zero at held nodes.

    Args:
        body: The body.
        field: Its elastic forces.
        preconditioner: As for ``solve_static``.
        tolerance: Norm of g - (K + s M) a over that of g.
        contact: The contacts that the motion keeps to, if there are any.

    Attributes:
        contact: The same, which may be changed.
        iterations: Number of iterations of conjugate gradients in the world that needed most.
        residual: Norm of g - (K + s M) a over that of g, the largest of all worlds.
        multipliers: With contact, the shares of the contacts' normals in g - (K + s M) a, float64 [contacts].
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        preconditioner: str | None,
        tolerance: float,
        contact: RestingContact | None = None,
    ):
        self.body, self.operator, self._tolerance = body, TangentOperator(body, field, exact=True), tolerance
        self.device, self.worlds, self.node_count = body.device, body.worlds, self.operator.node_count
        self._preconditioner = preconditioner_of(preconditioner, self.operator)
        self._solver = ConjugateGradients(self, len(body.state.displacements), most=MOST)
        self.contact, self._r = contact, wp.zeros_like(body.state.displacements)
        self.multipliers = np.zeros(0)
        self._solver.tolerance.fill_(tolerance)
        self._held = body.conditions.held_mask()[:, None]
        self._masses, self._share = body.masses[:, None], 0.0
        self.iterations, self.residual = 0, 0.0

    def apply(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x, or S (A + G) x with contact, for x in the range of the projector S that keeps to it."""
        self.operator.apply(x, y)
        if self.contact is not None:
            self.contact.launch_turning(x, y)
            self.contact.launch_free(y)

    def _precondition(self, r: wp.array, z: wp.array) -> None:
        """Launch z = B r, or S B S r with contact."""
        if self.contact is None:
            self._preconditioner.apply(r, z)
            return
        # Rounding moves residuals out of the range of S.
        wp.copy(self._r, r)
        self.contact.launch_free(self._r)
        self._preconditioner.apply(self._r, z)
        self.contact.launch_free(z)

    def take(self, u: wp.array, share: float = 0.0) -> None:
        """Set the stiffness to that at displacements u [m], vec4 [worlds * N], with the factor s of the mass
        [1/s^2].
        """
        self._share = share
        self.operator.set_scales(share, 0.0, 1.0)
        self.operator.take(u)
        self._preconditioner.update(self.operator)

    def solve(self, right: npt.NDArray[np.float64]) -> tuple[wp.array, npt.NDArray[np.float64]]:
        """The adjoint motion a, vec4 [worlds * N], and K a at all nodes, held ones too, float64 [worlds * N, 3]; with
        contact, K a and the contacts' forces on it.

        Args:
            right: g, zero at held nodes, [worlds * N, 3].

        Raises:
            ConvergenceError: K + s M is not positive definite, or the solve did not converge.
        """
        body = self.body
        self.iterations = 0
        of_worlds = right.reshape(body.worlds, -1)
        scale = np.abs(of_worlds).max(axis=1)
        scale = np.where(scale > 0.0, scale, 1.0)
        found = self._refined((of_worlds / scale[:, None]).reshape(-1, 3))
        adjoint = (found.reshape(body.worlds, -1) * scale[:, None]).reshape(-1, 3)
        motion = wp.array(padded(adjoint), dtype=wp.vec4, device=body.device)
        product = self._product(motion)
        if self.contact is not None:
            rest = right - product - self._share * self._masses * adjoint
            self.multipliers = self.contact.multipliers(np.where(self._held, 0.0, rest))
            product = product + self.contact.reactions(self.multipliers)
        return motion, product

    def _refined(self, right: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The solution in float64, as accurate as products with K."""
        worlds, device = self.body.worlds, self.body.device
        x = wp.zeros(len(right), dtype=wp.vec4, device=device)
        solution, left = np.zeros_like(right), self._free(right)
        wanted = np.linalg.norm(right.reshape(worlds, -1), axis=1)
        self.residual = np.inf
        for number in range(REFINEMENTS):
            self._solver.begin(wp.array(padded(left), dtype=wp.vec4, device=device), x)
            self._solver.iterate(self._precondition, x)
            report = self._solver.report()
            # Near the answer, what rounding leaves along contacts' normals may be all of the residual.
            rounded = (report.residual < ENOUGH) & (self.contact is not None)
            if number == 0 and ((report.negative | report.broken) & ~rounded).any():
                raise ConvergenceError(
                    "the stiffness is not positive definite: the state is not stable, and has no gradient"
                )
            self.iterations += int(report.iterations.max())
            trial = solution + x.numpy()[:, :3]
            product = self._product(wp.array(padded(trial), dtype=wp.vec4, device=device))
            left = right - product - self._share * self._masses * trial
            left = self._free(np.where(self._held, 0.0, left))
            norms = np.linalg.norm(left.reshape(worlds, -1), axis=1)
            residual = float((norms / np.where(wanted > 0.0, wanted, 1.0)).max())
            if not residual < self.residual:
                break
            solution, self.residual = trial, residual
            if residual < self._tolerance:
                break
        if self.residual > LARGEST_RESIDUAL:
            raise ConvergenceError(f"the adjoint solve did not converge: its residual is {self.residual:.2g}")
        return solution

    def _free(self, x: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """x without what contacts do not let nodes follow."""
        return x if self.contact is None else self.contact.free(x)

    def _product(self, x: wp.array) -> npt.NDArray[np.float64]:
        """K x at all nodes, held ones too, and the turning of contacts' normals."""
        y = wp.zeros_like(x)
        self.operator.tangent.add_product(x, y)
        product = y.numpy()[:, :3].astype(np.float64)
        return product if self.contact is None else product + self.contact.turning(x.numpy()[:, :3].astype(float))
