"""A measurement of the stable step in the present state of a body; see ``kernels.stepping.gauge``."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
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

#: Adds the forces of displacements, vec4, to the second array.
AddForces = Callable[[wp.array, wp.array], None]

#: Iterations to find the largest curvature at rest. They find it to 1 %; a value that is too small makes later steps
#: shorter, not longer.
REST_TURNS = 32


class Curvature:
    """Finds the largest curvature of forces, by launches that may be recorded.

    Args:
        places: Length of nodal arrays.
        found: The result, float32 [2], zero before; see ``Gauge``.
        ranks, number: The processes that have the other parts of the body, and its number there.

    Attributes:
        directions: The directions in which nodes are moved, vec4, which go on from one measurement to the next.
        scale: The size of the probing motion, float32 [1].
    """

    def __init__(self, places: int, found: wp.array, ranks: Halo = ALONE, number: int = 0):
        self.found, self._ranks, self._number = found, ranks, number
        self.directions, self._probed, self._forces = (
            wp.zeros(places, dtype=wp.vec4, device=found.device) for _ in range(3)
        )
        self.scale = wp.zeros(1, dtype=wp.float32, device=found.device)

    def fit(self, inverse_mass: npt.NDArray[np.floating], smallest_volume: float) -> None:
        """Scale the probing motion to a mesh: the lightest free node moves a share of the smallest element."""
        lightest = self._ranks.max(float(inverse_mass.max(initial=0.0)))
        size = smallest_volume ** (1.0 / 3.0)
        self.scale.fill_(PROBE * size / np.sqrt(lightest) if lightest > 0 else 0.0)

    def find(self, add_forces: AddForces, inverse_mass: wp.array, u: wp.array, f: wp.array, count: int) -> None:
        """Measure at displacements u of ``count`` nodes, where the forces are f [N], both vec4."""
        outputs = [self.directions, self._probed, self._forces]
        wp.launch(kernels.probe_directions, count, [self.scale, inverse_mass, u], outputs, device=u.device)
        self._ranks.exchange(self._number, self._probed)
        add_forces(self._probed, self._forces)
        inputs = [inverse_mass, u, self._probed, f, self._forces]
        wp.launch(kernels.find_curvatures, count, inputs, [self.directions, self.found], device=u.device)

    def at_rest(self, add_forces: AddForces, inverse_mass: wp.array, count: int) -> float:
        """The largest curvature without displacements [1/s^2]; waits for the device."""
        u, f = (wp.zeros_like(self.directions) for _ in range(2))
        add_forces(u, f)

        def find_afresh() -> None:
            self.found.zero_()
            self.find(add_forces, inverse_mass, u, f, count)

        repeat(find_afresh, REST_TURNS, u.device, self._ranks)
        self._ranks.max(self.found)
        value = float(self.found.numpy()[0])
        self.found.zero_()
        return value


class Gauge(Curvature):
    """Finds the largest curvature and the largest strain of a body, by launches that may be recorded.

    Args:
        body: The body.
        field: Its force field.
        found: The result, float32 [2], zero before: ``CURVATURE`` and ``STRAIN`` of ``kernels.stepping.pace``.
        ranks, number: The processes that have the other parts of the body, and its number there.
    """

    def __init__(self, body: SoftBody, field: ForceField, found: wp.array, ranks: Halo = ALONE, number: int = 0):
        super().__init__(len(body.state.displacements), found, ranks, number)
        self.body, self.field = body, field
        if (numbers := ranks.owned(body).numbers) is not None:
            drawn = normal_numbers(numbers, 20130705)
            self.directions.assign(padded(drawn / np.linalg.norm(drawn, axis=1, keepdims=True), len(self.directions)))
        self._rest_directions = self.directions
        self.rescale()
        # Loading within a recording would end it on some drivers.
        wp.load_module(kernels.find_strains(body.discretization.element_kind).module, body.device)

    def rescale(self) -> None:
        """Scale the probing motion to the present mesh."""
        inverse = self.body.conditions.inverse_mass[: self.body.node_count].numpy()
        self.fit(inverse, self.body.discretization.smallest_volume)

    def restart(self) -> None:
        """Continue from the directions that were found at rest."""
        wp.copy(self.directions, self._rest_directions)

    def launch(self, pace: Pace, ahead: int) -> None:
        """Measure in the present state, whose elastic forces are in ``body.state.forces``.

        Args:
            pace: The length of the steps to come.
            ahead: Number of steps before the next measurement.
        """
        body, state = self.body, self.body.state
        self.find(self.field.add_forces, *self._nodes(state.displacements, state.forces))
        # Each part of a body numbers its elements in its own way, so all of them are measured there.
        turns = int(kernels.TURNS) if self._ranks.is_alone else 1
        wp.launch(
            kernels.find_strains(body.discretization.element_kind),
            dim=-(-body.sizes.launch_elements // turns),
            inputs=[
                body.discretization.elements,
                state.displacements,
                self._ranks.exchange(self._number, state.velocities, copies=True),
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
        with self.field.state_kept():
            value = self.at_rest(self.field.add_forces, *self._nodes())
        self._rest_directions = wp.clone(self.directions)
        return value

    def _nodes(self, *vectors: wp.array) -> tuple:
        return self.body.conditions.inverse_mass, *vectors, self.body.sizes.launch_nodes
