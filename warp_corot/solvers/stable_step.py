"""How large an explicit step may be: the largest frequency of the body about its rest shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..kernels import lanczos
from ..nodal import padded

if TYPE_CHECKING:
    from ..body import SoftBody
    from ..elasticity import ForceField

LANCZOS_STEPS = 30

# Probing displacements as a share of the smallest element's size: small enough to be linear, large enough for float32.
PROBE = 1e-3


def largest_frequency(body: SoftBody, field: ForceField) -> float:
    """Largest angular frequency [rad/s] of small motions about rest; explicit central differences need dt < 2 / it.

    Lanczos' iteration on M^-1/2 K M^-1/2, where K is applied as the force field itself does it for small displacements,
    so that whatever model and elements there are is what is measured. The Ritz value's residual is added to it. Zero if
    no node is free to move.
    """
    free = int((body.node_inverse_mass[: body.node_count].numpy() > 0).sum())
    if not free:
        return 0.0
    iteration = _Lanczos(body, field)
    diagonal: list[float] = []
    off: list[float] = [0.0]
    with field.state_kept():
        iteration.find_rest_forces()
        for _ in range(min(LANCZOS_STEPS, 3 * free)):
            a, b = iteration.step(off[-1])
            diagonal.append(a)
            off.append(b)
            if b <= 1e-6 * max(map(abs, diagonal)):
                break
    size = len(diagonal)
    tridiagonal = np.diag(diagonal) + np.diag(off[1:size], 1) + np.diag(off[1:size], -1)
    values, vectors = np.linalg.eigh(tridiagonal)
    bound = values[-1] + off[size] * abs(vectors[-1, -1])
    return float(np.sqrt(max(bound, 0.0)))


class _Lanczos:
    """The iteration's vectors on the device, vec4, as long as launches: the present one, the one before, the next."""

    def __init__(self, body: SoftBody, field: ForceField):
        self.body = body
        self.field = field
        self.probe = PROBE * body.smallest_volume ** (1.0 / 3.0)
        self.q, self.before, self.next = (
            wp.zeros(body.launch_nodes, dtype=wp.vec4, device=body.device) for _ in range(3)
        )
        self.u, self.f, self._rest = (wp.zeros_like(body.node_displacements) for _ in range(3))
        self._sums = wp.zeros(lanczos.PARTIAL_SUMS, dtype=wp.float64, device=body.device)
        self._largest = wp.zeros(lanczos.PARTIAL_SUMS, dtype=wp.float32, device=body.device)
        start = padded(np.random.default_rng(0).standard_normal((body.node_count, 3), np.float32))
        start[body.node_inverse_mass[: body.node_count].numpy() == 0] = 0.0
        self.q[: body.node_count].assign(start)
        self._launch(lanczos.scale_by, [1.0 / np.sqrt(self._inner(self.q, self.q)), self.q])

    def find_rest_forces(self) -> None:
        """What forces there are without displacements, by active stress: of those with any, only the rest counts."""
        self.field.add_forces(self.u, self._rest)
        self._launch(lanczos.scale_by, [-1.0, self._rest])

    def step(self, beta: float) -> tuple[float, float]:
        """One step; the last off-diagonal entry in, the next diagonal and off-diagonal ones out [1/s^2]."""
        inverse_mass = self.body.node_inverse_mass
        self._launch(lanczos.largest_motions, [inverse_mass, self.q, self._largest], lanczos.PARTIAL_SUMS)
        scale = self.probe / float(self._largest.numpy().max())
        self._launch(lanczos.probe_motion, [scale, inverse_mass, self.q, self.u])
        wp.copy(self.f, self._rest, count=self.body.launch_nodes)
        self.field.add_forces(self.u, self.f)
        self._launch(lanczos.apply_stiffness, [scale, beta, inverse_mass, self.f, self.before, self.next])
        diagonal = self._inner(self.q, self.next)
        self._launch(lanczos.add_scaled, [-diagonal, self.q, self.next])
        off = float(np.sqrt(self._inner(self.next, self.next)))
        if off > 0.0:
            self._launch(lanczos.scale_by, [1.0 / off, self.next])
        self.before, self.q, self.next = self.q, self.next, self.before
        return diagonal, off

    def _inner(self, a: wp.array, b: wp.array) -> float:
        self._launch(lanczos.inner_products, [a, b, self._sums], lanczos.PARTIAL_SUMS)
        return float(self._sums.numpy().sum())

    def _launch(self, kernel: wp.Kernel, arguments: list, dim: int | None = None) -> None:
        count = self.body.launch_nodes if dim is None else dim
        wp.launch(kernel, dim=count, inputs=arguments, device=self.body.device)
