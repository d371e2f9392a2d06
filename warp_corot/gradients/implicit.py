"""Runs of implicit steps backwards: one adjoint solve for each step, in the states of the run forwards."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.sizes import padded
from warp_corot.kernels.implicit import steps as rows
from warp_corot.solvers.implicit.schemes import ImplicitIntegrator

from .adjoint import Adjoint
from .contact import RestingContact
from .sums import StepSums

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField

Array = npt.NDArray[np.float64]


class ImplicitRun:
    """The adjoints of implicit steps of one body.

    A step finds its increment d at the stage u + d from M (A0 d + A1 v + A2 h1 + A3 h2) + damping M (R0 d + R1 v + …) =
    f(u + d) + loads, and leaves u + d / share and sums of d, v, h1 and h2; see ``kernels.implicit.steps``.

    Args:
        body, field: The body and its elastic forces.
        integrator: The integrator of the steps.
        sums: The sums over steps.
        displacements: The displacements before the first step and after each step, vec4.
        tolerance: Tolerance of the adjoint solves.
        contacts: What obstacles have pushed in each step, if there are any obstacles.

    Attributes:
        of_obstacles: The derivative with respect to the places of the obstacles, or 0.
        of_displacements, of_velocities: The adjoint of the state that the run backwards has reached, float64
            [worlds * N, 3].
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        integrator: ImplicitIntegrator,
        sums: StepSums,
        displacements: list[wp.array],
        tolerance: float,
        contacts: Sequence[RestingContact] = (),
    ):
        self._contacts, self.of_obstacles = contacts, np.zeros(1)
        self.body, self.sums, self.displacements = body, sums, displacements
        self._adjoint = Adjoint(body, field, integrator.preconditioner, tolerance)
        self._dt, self._damping = integrator.dt, integrator.damping
        self._tables = [np.asarray(table(integrator.dt), np.float64) for table in (integrator.start, integrator.scheme)]
        self._held = body.conditions.held_mask()[:, None]
        self._masses = body.masses[:, None]
        self.of_displacements, self.of_velocities, self._of_first, self._of_second = (
            np.zeros((body.sizes.nodes, 3)) for _ in range(4)
        )

    def backward(self, step: int) -> None:
        """Run a step backwards, 0 for the first one, after the steps that follow it."""
        table = self._tables[min(step, 1)]
        stage_share = table[int(rows.STAGE), 0]
        before, after = (self.displacements[k].numpy()[:, :3].astype(np.float64) for k in (step, step + 1))
        stage = wp.array(padded(before + stage_share * (after - before)), dtype=wp.vec4, device=self.body.device)
        inertia = table[int(rows.ACCELERATION)] + self._damping * table[int(rows.RATE)]
        made = [table[int(row)] for row in (rows.VELOCITY, rows.FIRST, rows.SECOND)]
        of_made = (self.of_velocities, self._of_first, self._of_second)
        right = self.of_displacements / stage_share + sum(row[0] * of for row, of in zip(made, of_made, strict=True))
        contact = self._contacts[step] if self._contacts and self._contacts[step].pushes else None
        self._adjoint.keep_to(contact)
        self._adjoint.take(stage, inertia[0])
        motion, product = self._adjoint.solve(np.where(self._held, 0.0, right))
        p = motion.numpy()[:, :3].astype(np.float64)
        if contact is not None:
            self.of_obstacles = self.of_obstacles + contact.of_obstacles(p, self._adjoint.multipliers)
        of_u = self.of_displacements - product
        # Held nodes keep their velocity and move with it; at the stage they have made the stage's fraction of that
        # motion.
        moved = self._dt * (self.of_displacements - stage_share * product)
        of_v = np.where(self._held, self.of_velocities + moved, 0.0)
        parts = []
        for column in (1, 2, 3):
            part = sum(row[column] * of for row, of in zip(made, of_made, strict=True))
            parts.append(np.where(self._held, 0.0, part - inertia[column] * self._masses * p))
        self.of_displacements, self.of_velocities = of_u, of_v + parts[0]
        self._of_first, self._of_second = parts[1], parts[2]
        self.sums.add(stage, motion)
        added = wp.array(padded(self.sums.of_loads.numpy()[:, :3] + p), dtype=wp.vec4, device=self.body.device)
        wp.copy(self.sums.of_loads, added)
