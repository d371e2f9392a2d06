"""Energies of a simulation's worlds, and the work that was put into them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from ..kernels import balance as kernels
from .integrator import StepContext

if TYPE_CHECKING:
    from ..body import SoftBody
    from ..elasticity import ForceField

#: Threads that add up, at most, and those of one world.
THREADS = 4096
WORLD_THREADS = 1024

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Energies:
    """What free nodes have at one time, of each world [worlds].

    Attributes:
        kinetic, gravitational: [J]; gravitational about the rest shape.
        elastic: [J]; zero if not asked for.
        exact: With symplectic Euler's own kinetic energy, velocities behind times those ahead, and the elastic energy:
            what a linear body keeps to rounding [J]; means nothing if elastic energies were not asked for.
        untimely: What the kinetic energy at the time of the displacements has more than that of ``exact`` [J].
        loads: Work of loads since the displacements that were kept [J].
        supports: Work of all moving supports since the beginning [J].
        supports_absolute: The sum of its absolute values [J].
        reach: The largest displacement [m].
    """

    kinetic: Floats
    gravitational: Floats
    elastic: Floats
    exact: Floats
    untimely: Floats
    loads: Floats
    supports: Floats
    supports_absolute: float
    reach: Floats


class Balance:
    """Adds up energies, world by world.

    Args:
        bodies, fields: The simulation's.
        context: Its pace, gravity and what supports put in.
    """

    def __init__(self, bodies: Sequence[SoftBody], fields: Sequence[ForceField], context: StepContext):
        self.bodies, self.fields, self.context = tuple(bodies), tuple(fields), context
        self.worlds, self.device = bodies[0].worlds, bodies[0].device
        parts = 1 if self.device.is_cpu else max(min(THREADS // self.worlds, WORLD_THREADS), 1)
        self._sums = wp.zeros((self.worlds, parts, kernels.COLUMNS), dtype=wp.float64, device=self.device)
        self._energies: list[wp.array] = [wp.empty(0, dtype=wp.float64, device=self.device) for _ in bodies]

    @property
    def is_closed(self) -> bool:
        """Whether nothing but gravity, loads and supports puts work in: active stress does."""
        return not any(body.has_activation for body in self.bodies)

    def find(self, before: Sequence[wp.array], *, whole: bool) -> Energies:
        """The energies of the present state; waits for the device.

        Args:
            before: Displacements since which the work of loads counts, of each body.
            whole: Whether elastic energies are wanted, which take as long as some steps.
        """
        self._sums.zero_()
        for k, (body, field) in enumerate(zip(self.bodies, self.fields, strict=True)):
            if whole:
                self._add_elastic(k, body, field)
            self._add_nodal(body, before[k])
            if whole:
                body.node_forces.zero_()
        sums = self._sums.numpy()
        total, reach = sums.sum(axis=1), sums[:, :, kernels.REACH].max(axis=1)
        supports = self.context.support_work.numpy()
        kinetic, ahead, elastic = (total[:, int(c)] for c in (kernels.KINETIC, kernels.AHEAD, kernels.ELASTIC))
        done = np.full(self.worlds, supports[0] + total[:, kernels.SUPPORTS].sum())
        return Energies(
            kinetic=kinetic,
            gravitational=total[:, kernels.GRAVITATIONAL],
            elastic=elastic,
            exact=kinetic + ahead + elastic,
            untimely=total[:, kernels.UNTIMELY],
            loads=total[:, kernels.LOADS],
            supports=done,
            supports_absolute=float(supports[1]),
            reach=reach,
        )

    def rounding(self) -> Floats:
        """Energies that float32 cannot tell from none [J], of each world: of strains of about 4e-4."""
        found = np.zeros(self.worlds)
        for body in self.bodies:
            stiffness = 2.0 * float(body.mu.numpy().mean()) + float(body.lam.numpy().mean())
            found += 1e-7 * stiffness * float(np.sum(body.mesh.volumes))
        return found

    def _add_elastic(self, k: int, body: SoftBody, field: ForceField) -> None:
        """Strain energies to the sums, and elastic forces to ``node_forces``."""
        count = field.energy_count
        if len(self._energies[k]) != count:
            self._energies[k] = wp.empty(count, dtype=wp.float64, device=self.device)
        self._energies[k].zero_()
        with field.state_kept():
            field.write_energies(body.node_displacements, self._energies[k])
            field.add_forces(body.node_displacements, body.node_forces)
        inputs = [self._energies[k], count // self.worlds]
        wp.launch(kernels.sum_elements, self._sums.shape[:2], inputs, [self._sums], device=self.device)

    def _add_nodal(self, body: SoftBody, before: wp.array) -> None:
        context = self.context
        inputs = [
            context.pace.arrays,
            context.gravity,
            body.launch_nodes // self.worlds,
            body.node_mass,
            body.node_inverse_mass,
            int(body.has_loads),
            body.node_loads,
            body.node_forces,
            body.node_displacements,
            before,
            body.node_velocities,
        ]
        kernel = kernels.SUM_NODES[body.node_loads.dtype]
        wp.launch(kernel, self._sums.shape[:2], inputs, [self._sums], device=self.device)
