"""The largest stable explicit step, from the largest frequency of the body about its rest shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity.model import SmallForces
from warp_corot.errors import InputError
from warp_corot.kernels.stepping import lanczos
from warp_corot.mesh.scattered import normal_numbers, padded
from warp_corot.solvers.halo import ALONE, Halo

from .repeated import repeat

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

LANCZOS_STEPS = 30
#: The best of the last steps is taken, of this many.
LAST_STEPS = 8

# Probing displacements as a share of the smallest element's size: small enough to be linear, large enough for float32.
PROBE = 1e-3


def largest_frequency(body: SoftBody, field: SmallForces, ranks: Halo = ALONE, number: int = 0) -> float:
    """Largest angular frequency [rad/s] of small motions about rest; explicit central differences need dt < 2 / it.

    Zero if no node is free to move.

    Args:
        body, field: The body and its forces.
        ranks, number: The processes that have the other parts of the body, and its number there.
    """
    largest = largest_eigenvalue(
        field,
        body.conditions.inverse_mass,
        body.discretization.smallest_volume,
        body.sizes.nodes,
        body.sizes.launch_nodes,
        ranks,
        number,
        ranks.owned(body).numbers,
    )
    return float(np.sqrt(largest))


def largest_eigenvalue(
    forces: SmallForces,
    inverse_mass: wp.array,
    smallest_volume: float,
    nodes: int,
    launch_nodes: int | None = None,
    ranks: Halo = ALONE,
    number: int = 0,
    numbers: npt.NDArray[np.int64] | None = None,
) -> float:
    """The largest eigenvalue of M^-1 K [1/s^2], where K gives the forces of small displacements from rest.

    Lanczos' iteration on M^-1/2 K M^-1/2. The forces themselves apply K, so that the actual model and elements are
    measured. The Ritz value's residual is added to the result. Zero if no node is free to move.

    Args:
        forces: The forces.
        inverse_mass: Inverse masses of the nodes [1/kg], float32, zero for held ones; nodal arrays are equally long.
        smallest_volume: The volume of the smallest element [m^3], which sets the size of small displacements.
        nodes: Number of nodes.
        launch_nodes: Number of nodes that launches go through; None: ``nodes``.
        ranks, number: As for ``largest_frequency``.
        numbers: The numbers of the nodes in the whole body, which set the first motion; None: they are those here.
    """
    free = int(ranks.sum(int((inverse_mass[:nodes].numpy() > 0).sum())))
    if not free:
        return 0.0
    probe = PROBE * smallest_volume ** (1.0 / 3.0)
    iteration = _Lanczos(forces, inverse_mass, probe, launch_nodes or nodes, ranks, number, numbers)
    with forces.state_kept():
        iteration.find_rest_forces()
        iteration.launch(min(LANCZOS_STEPS, 3 * free))
    return max(_largest_value(*iteration.coefficients()), 0.0)


def _largest_value(diagonal: npt.NDArray[np.float64], off: npt.NDArray[np.float64]) -> float:
    """The largest Ritz value plus its residual, the smallest of the last few steps: rounding produces copies of values
    that were already found, with meaningless residuals.

    Raises:
        InputError: The forces are not finite.
    """
    bounds = []
    if not (np.isfinite(diagonal).all() and np.isfinite(off).all()):
        raise InputError("forces of small motions are not finite; moduli must be within the range of float32")
    for size in range(max(len(diagonal) - LAST_STEPS, 0) + 1, len(diagonal) + 1):
        tridiagonal = np.diag(diagonal[:size]) + np.diag(off[1:size], 1) + np.diag(off[1:size], -1)
        values, vectors = np.linalg.eigh(tridiagonal)
        bounds.append(values[-1] + off[size] * abs(vectors[-1, -1]))
    return float(max(min(bounds), values[-1]))


class _Lanczos:
    """The iteration's vectors on the device, vec4, as long as launches: the present, the previous and the next one."""

    def __init__(
        self,
        forces: SmallForces,
        inverse_mass: wp.array,
        probe: float,
        count: int,
        ranks: Halo,
        number: int,
        numbers: npt.NDArray[np.int64] | None,
    ):
        self._ranks, self._number = ranks, number
        self.forces, self.inverse_mass, self.probe, self.count = forces, inverse_mass, probe, count
        self.device = inverse_mass.device
        self.q, self.before, self.next = (wp.empty(count, dtype=wp.vec4, device=self.device) for _ in range(3))
        places = len(inverse_mass)
        self.u, self.f, self._rest = (wp.zeros(places, dtype=wp.vec4, device=self.device) for _ in range(3))
        parts = count if ranks.is_reproducible else min(count, lanczos.PARTS)
        self._parts, self._sums, self._largest, self._diagonal, self._off = (
            wp.empty(size, dtype=wp.float64, device=self.device)
            for size in (parts, lanczos.FOLDED, lanczos.FOLDED, LANCZOS_STEPS, LANCZOS_STEPS + 1)
        )
        self._scale = wp.empty(1, dtype=wp.float32, device=self.device)
        self._step = wp.zeros(1, dtype=wp.int32, device=self.device)
        self._steps = 0
        self._launch(lanczos.random_motion, [0, inverse_mass, self.q])
        if numbers is not None:
            motion = padded(normal_numbers(numbers, 0), count)
            motion[inverse_mass.numpy()[:count] == 0.0] = 0.0
            self.q.assign(motion)
        self._sum(self.q, self.q, self._off, root=True)
        self._launch(lanczos.normalise, [self._off, self.q])

    def find_rest_forces(self) -> None:
        """Find the forces at rest, which active stress makes; they are subtracted from those of displacements."""
        self.forces.add_forces(self.u, self._rest)
        self._launch(lanczos.scale_by, [-1.0, self._rest])

    def launch(self, steps: int) -> None:
        """Launch all steps of the iteration."""
        repeat(self._launch_step, steps, self.device, self._ranks)
        self._steps = steps

    def _launch_step(self) -> None:
        inverse_mass = self.inverse_mass
        self._launch(lanczos.largest_motions, [inverse_mass, self.q, self._parts], len(self._parts))
        self._launch(lanczos.fold, [self._parts, self._sums, self._largest], lanczos.FOLDED)
        self._ranks.max(self._largest)
        self._launch(lanczos.take_scale, [self.probe, self._largest, self._scale], 1)
        self._launch(lanczos.probe_motion, [self._scale, inverse_mass, self.q, self.u])
        self._ranks.exchange(self._number, self.u)
        wp.copy(self.f, self._rest, count=self.count)
        self.forces.add_forces(self.u, self.f)
        arguments = [self._scale, self._off, self._step, inverse_mass, self.f, self.before, self.next]
        self._launch(lanczos.apply_stiffness, arguments)
        self._sum(self.q, self.next, self._diagonal)
        self._launch(lanczos.take_away, [self._diagonal, self._step, self.q, self.next])
        self._sum(self.next, self.next, self._off, after=1, root=True)
        self._launch(lanczos.take_next, [self._off, self._step, self.next, self.q, self.before])
        self._launch(lanczos.count_step, [self._step], 1)

    def coefficients(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Diagonal and off-diagonal entries of the meaningful steps [1/s^2], with one more off-diagonal at either end.

        Waits for the device.
        """
        diagonal, off = self._diagonal.numpy()[: self._steps], self._off.numpy()[: self._steps + 1]
        ended = off[1:] <= 1e-6 * np.maximum.accumulate(np.abs(diagonal))
        size = int(np.argmax(ended)) + 1 if ended.any() else self._steps
        return diagonal[:size], off[: size + 1]

    def _sum(self, a: wp.array, b: wp.array, numbers: wp.array, *, after: int = 0, root: bool = False) -> None:
        """Launch the step's entry of ``numbers``: a . b, or its square root with ``root``."""
        self._launch(lanczos.inner_products, [a, b, self._parts], len(self._parts))
        self._launch(lanczos.fold, [self._parts, self._sums, self._largest], lanczos.FOLDED)
        if not (ranks := self._ranks).is_alone:
            total = ranks.sum(float(self._sums.numpy().sum()), self._parts.numpy() if ranks.is_reproducible else None)
            self._sums.assign(np.array([total] + [0.0] * (len(self._sums) - 1)))
        self._launch(lanczos.take_sum, [self._sums, int(root), self._step, after, numbers], 1)

    def _launch(self, kernel: wp.Kernel, arguments: list, dim: int | None = None) -> None:
        count = self.count if dim is None else dim
        wp.launch(kernel, dim=count, inputs=arguments, device=self.device)
