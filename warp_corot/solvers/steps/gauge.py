"""A measurement of the stable step in the present state of a body; see ``kernels.stepping.gauge``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.kernels.stepping import gauge as kernels
from warp_corot.mesh.scattered import normal_numbers, padded
from warp_corot.solvers.halo import ALONE, Halo

from .pace import Pace
from .repeated import repeat
from .stable_step import PROBE

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity import ForceField

#: Iterations to find the largest curvature at rest. They find it to 1 %; a value that is too small makes later steps
#: shorter, not longer.
REST_TURNS = 32


class Gauge:
    """Finds the largest curvature and the largest strain of a body, by launches that may be recorded.

    Args:
        body: The body.
        field: Its force field.
        found: The result, float32 [2], zero before: ``CURVATURE`` and ``STRAIN`` of ``kernels.stepping.pace``.
        ranks, number: The processes that have the other parts of the body, and its number there.
    """

    def __init__(self, body: SoftBody, field: ForceField, found: wp.array, ranks: Halo = ALONE, number: int = 0):
        self._ranks, self._number = ranks, number
        self.body = body
        self.field = field
        self.found = found
        places = body.state.displacements.shape
        self.directions = wp.zeros(places, dtype=wp.vec4, device=body.device)
        if (numbers := ranks.owned(body).numbers) is not None:
            drawn = normal_numbers(numbers, 20130705)
            self.directions.assign(padded(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), len(self.directions)))
        self._probed, self._forces = (wp.zeros(places, dtype=wp.vec4, device=body.device) for _ in range(2))
        self._rest_directions = self.directions
        #: The size of the probing motion, float32 [1].
        self.scale = wp.zeros(1, dtype=wp.float32, device=body.device)
        self.rescale()
        # Loading within a recording would end it on some drivers.
        wp.load_module(kernels.find_strains(body.discretization.element_kind).module, body.device)

    def rescale(self) -> None:
        """Scale the probing motion to the mesh: the lightest free node moves a share of the smallest element."""
        inverse = self.body.conditions.inverse_mass[: self.body.node_count].numpy()
        lightest = self._ranks.max(float(inverse.max(initial=0.0)))
        size = self.body.discretization.smallest_volume ** (1.0 / 3.0)
        self.scale.fill_(PROBE * size / np.sqrt(lightest) if lightest > 0 else 0.0)

    def restart(self) -> None:
        """Continue from the directions that were found at rest."""
        wp.copy(self.directions, self._rest_directions)

    def launch(self, pace: Pace, ahead: int) -> None:
        """Measure in the present state, whose elastic forces are in ``body.state.forces``.

        Args:
            pace: The length of the steps to come.
            ahead: Number of steps before the next measurement.
        """
        body = self.body
        self._find_curvature(body.state.displacements, body.state.forces)
        # Each part of a body numbers its elements in its own way, so all of them are measured there.
        turns = int(kernels.TURNS) if self._ranks.is_alone else 1
        wp.launch(
            kernels.find_strains(body.discretization.element_kind),
            dim=-(-body.sizes.launch_elements // turns),
            inputs=[
                body.discretization.elements,
                body.state.displacements,
                self._ranks.exchange(self._number, body.state.velocities, copies=True),
                pace.arrays,
                ahead,
                turns,
                body.sizes.launch_elements,
            ],
            outputs=[self.found],
            device=body.device,
        )

    def curvature_at_rest(self) -> float:
        """The largest curvature about the rest shape [1/s^2]; waits for the device."""
        u, f = (wp.zeros_like(self.body.state.displacements) for _ in range(2))
        with self.field.state_kept():
            self.field.add_forces(u, f)
            repeat(partial(self._find_afresh, u, f), REST_TURNS, self.body.device, self._ranks)
            self._ranks.max(self.found)
        self._rest_directions = wp.clone(self.directions)
        value = float(self.found.numpy()[0])
        self.found.zero_()
        return value

    def _find_afresh(self, u: wp.array, f: wp.array) -> None:
        self.found.zero_()
        self._find_curvature(u, f)

    def _find_curvature(self, u: wp.array, f: wp.array) -> None:
        inverse_mass = self.body.conditions.inverse_mass
        outputs = [self.directions, self._probed, self._forces]
        self._launch(kernels.probe_directions, [self.scale, inverse_mass, u], outputs)
        self._ranks.exchange(self._number, self._probed)
        self.field.add_forces(self._probed, self._forces)
        inputs = [inverse_mass, u, self._probed, f, self._forces]
        self._launch(kernels.find_curvatures, inputs, [self.directions, self.found])

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        body = self.body
        wp.launch(kernel, dim=body.sizes.launch_nodes, inputs=inputs, outputs=outputs, device=body.device)
