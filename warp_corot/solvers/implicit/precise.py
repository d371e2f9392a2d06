"""A state of rest in float64, on the host: Newton's method with a direct solver."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import numpy.typing as npt
from scipy.sparse import block_array
from scipy.sparse.linalg import SuperLU, splu

from warp_corot.elasticity import ForceField, Model
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.elasticity.float64 import SharedDilatation, float64_law
from warp_corot.errors import ConvergenceError, InputError
from warp_corot.kernels.elements.simd8 import IsotropicLaw
from warp_corot.materials.isotropic import Isotropic

from .precise_elements import PreciseElements

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

Array = npt.NDArray[np.float64]

#: Maximum number of Newton's iterations, and the tolerance of the last one: its largest displacement over the largest
#: displacement.
ITERATIONS, SMALL = 20, 1e-13
#: Newton's method squares the error, so after a step below this only rounding is left: of bodies whose stiffness jumps
#: by factors of a million, more than ``SMALL``. Then the method ends once a step is more than half of the one before.
ROUNDED = 1e-8


class HostContact(Protocol):
    """Contact of one world in float64, such as ``gradients.precise_contact.PreciseContact``, which explains the
    members."""

    count: int
    pushes: Array

    def gaps(self, u: Array) -> Array: ...

    def normals(self, u: Array) -> Any: ...

    def turning(self, u: Array, pushes: Array) -> Any: ...


class PreciseRest:
    """Moves a body from a state of rest in float32 to the one in float64.

    Args:
        body: The body; some nodes of each world must be held. Its displacements become the answer, rounded.
        field: Its elastic forces.
        law: The model.
        loads: Loads and weight [N], float64 [worlds * N, 3].
        contacts: The contact of each world, if there is any.

    Attributes:
        elements: The elements of each world.
        u: Displacements [m], float64 [worlds, N, 3].
        held: Whether nodes are held, bool [worlds, N].
        free: Free entries of each world's displacements, int64 each.
        factors: The stiffness and its factors at free entries, of each world. With contact, unknowns are the free
            entries and the opposites of forces of contact.
        pushes: The forces of contact of each world [N].
        iterations: Newton's iterations of the world that needed most.
        correction: The largest displacement of the last iteration over the largest displacement.
        residual: The norm of the unbalanced forces over that of loads and reactions, of the world where it is largest.

    Raises:
        InputError: The model or the material does not exist in float64.
        ConvergenceError: Newton's method does not converge from the present state, the stiffness is singular, or an
            element is crushed so far that it has no rotation.
    """

    def __init__(
        self, body: SoftBody, field: ForceField, law: Model, loads: Array, contacts: Sequence[HostContact] = ()
    ):
        self._contacts = contacts
        self.pushes = [each.pushes for each in contacts]
        of_float64 = checked_float64_law(body, law)
        shared = SharedDilatation(field) if isinstance(field, DilatationField) else None
        worlds, count = body.worlds, body.sizes.nodes
        self.elements = [PreciseElements(body, of_float64, shared, world) for world in range(worlds)]
        self._loads = loads.reshape(worlds, -1, 3)
        self.held = body.conditions.held_mask().reshape(worlds, -1)
        # Free nodes of no element stay where they are.
        self.free = [
            np.flatnonzero(np.repeat(~held & (masses > 0.0), 3))
            for held, masses in zip(self.held, body.masses.reshape(worlds, -1), strict=True)
        ]
        start = body.state.displacements.numpy()[:count, :3].astype(np.float64).reshape(worlds, -1, 3)
        self.u = np.empty_like(start)
        self.factors: list[tuple[Any, SuperLU]] = []
        self.iterations, self.correction, self.residual = 0, 0.0, 0.0
        for world in range(worlds):
            self.u[world] = self._solved(world, start[world])
        body.displacements = self.u.reshape(-1, 3)

    def _solved(self, world: int, u: Array) -> Array:
        free, before = self.free[world], np.inf
        for number in range(ITERATIONS):
            step = np.zeros(u.size)
            left = self._unbalanced(world, u).ravel()[free]
            if self._touches(world):
                left = np.concatenate([left, -self._contacts[world].gaps(u)])
            found = self._factored(world, u).solve(left)
            step[free] = found[: len(free)]
            if self._touches(world):
                self.pushes[world] = self.pushes[world] - found[len(free) :]
            u = u + step.reshape(u.shape)
            longest, most = np.abs(step).max(), np.abs(u).max()
            if not longest > SMALL * most or ROUNDED * most > before < 2.0 * longest:
                self.factors.append((self._stiffness(world, u), self._factored(world, u)))
                self._measure(world, u, number + 1, longest)
                return u
            before = longest
        raise ConvergenceError("Newton's method in float64 does not converge from the answer of float32")

    def _unbalanced(self, world: int, u: Array) -> Array:
        """Elastic forces and loads [N], [N, 3]; reactions are their opposites."""
        found = self.elements[world].forces(u) + self._loads[world]
        if self._touches(world):
            found = found + (self._contacts[world].normals(u) @ self.pushes[world]).reshape(-1, 3)
        return found

    def _touches(self, world: int) -> bool:
        return bool(self._contacts) and self._contacts[world].count > 0

    def _stiffness(self, world: int, u: Array) -> Any:
        """K, and the turning of contacts' normals."""
        found = self.elements[world].stiffness(u)
        return found + self._contacts[world].turning(u, self.pushes[world]) if self._touches(world) else found

    def _measure(self, world: int, u: Array, iterations: int, step: float) -> None:
        left, size = self._unbalanced(world, u).ravel(), np.abs(u).max()
        of_free = np.linalg.norm(left[self.free[world]])
        compared = np.hypot(np.linalg.norm(self._loads[world]), np.linalg.norm(left))
        self.iterations = max(self.iterations, iterations)
        self.correction = max(self.correction, float(step / size) if size > 0.0 else 0.0)
        self.residual = max(self.residual, float(of_free / compared) if compared > 0.0 else 0.0)

    def _factored(self, world: int, u: Array) -> SuperLU:
        free = self.free[world]
        matrix = self._stiffness(world, u)[free][:, free]
        if self._touches(world):
            normals = self._contacts[world].normals(u)[free]
            matrix = block_array([[matrix, normals], [normals.T, None]])
        try:
            return splu(matrix.tocsc())
        except RuntimeError:
            raise ConvergenceError("the stiffness is singular: the state of rest has no gradient") from None


def checked_float64_law(body: SoftBody, law: Model) -> IsotropicLaw:
    """The law in float64.

    Raises:
        InputError: The law does not exist in float64.
    """
    found = float64_law(law)
    if found is None or not isinstance(body.material, Isotropic):
        raise InputError(
            "precision is 'float64'; it needs an isotropic material and Linear, Corotated, StVenantKirchhoff, "
            "NeoHookean or EdgeStVK with biquadratic springs"
        )
    return found
