"""The state of a body's nodes on a device: where they are, how they move, and what acts on them."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.nodal import padded, same_array
from warp_corot.discretization.sizes import Sizes
from warp_corot.kernels.stepping.integrate import ADOPT_POSITIONS, PUBLISH_POSITIONS


class State:
    """Displacements, velocities and forces of nodes, in 16-byte vec4 arrays whose fourth lane is unused.

    A node so is one load and, where the card can, one reduction. The state proper is the displacement from rest, which
    keeps the digits of small strains: the static end of a linear beam comes out to 1e-6 of its deflection, from float32
    positions to 4e-6 with the beam at the origin and to 3e-5 with it one metre away.

    Args:
        sizes: How many nodes there are.
        rest: Rest positions of the nodes of all worlds [m], [worlds * N, 3].
        device: Where.

    Attributes:
        rest, positions, displacements, velocities: [m], [m/s], vec4. ``positions`` may be another program's array, of
            vec3 or vec4.
        forces: What a step adds up [N], zero between steps.
        reactions: Forces of the supports in the last step [N].
        initial: Displacements and velocities that worlds are reset to; None for rest.
        revision: Changes whenever ``positions`` is another array.
    """

    def __init__(self, sizes: Sizes, rest: npt.NDArray[np.float64], device: wp.Device):
        self.sizes, self.device = sizes, device
        self.rest = wp.array(padded(rest), dtype=wp.vec4, device=device)
        self.positions = wp.clone(self.rest)
        self.displacements, self.velocities, self.forces, self.reactions = (wp.zeros_like(self.rest) for _ in range(4))
        self.initial: tuple[wp.array, wp.array] | None = None
        self.revision = 0

    def move_into(self, rest: wp.array, displacements: wp.array, velocities: wp.array, reactions: wp.array) -> None:
        """Live in other arrays from now on, vec4 with as many places or more; ``rest`` is there already."""
        self.adopt_positions()
        for array, own in (
            (displacements, self.displacements),
            (velocities, self.velocities),
            (reactions, self.reactions),
        ):
            wp.copy(array, own, count=self.sizes.nodes)
        self.rest, self.displacements, self.velocities, self.reactions = rest, displacements, velocities, reactions
        self.positions, self.forces = wp.clone(rest), wp.zeros_like(displacements)

    def set_displacements(self, values: npt.NDArray[np.float64]) -> None:
        """Put the nodes of all worlds where they are displaced by so much [m], [worlds * N, 3]."""
        self.displacements[: self.sizes.nodes].assign(padded(values))
        self.publish_positions()

    def set_velocities(self, values: npt.NDArray[np.float64]) -> None:
        """Set the velocities of the nodes of all worlds [m/s], [worlds * N, 3]."""
        self.velocities[: self.sizes.nodes].assign(padded(values))

    def adopt_positions(self) -> None:
        """Take over positions that somebody wrote since they were last published."""
        kernel = ADOPT_POSITIONS[self.positions.dtype]
        self._launch(kernel, [self.rest, self.positions], [self.displacements])

    def publish_positions(self) -> None:
        """Write positions from displacements."""
        kernel = PUBLISH_POSITIONS[self.positions.dtype]
        self._launch(kernel, [self.rest, self.displacements], [self.positions])

    def use_positions(self, positions: wp.array) -> None:
        """Publish positions to this array from now on, and adopt them from it."""
        before, self.positions = self.positions, positions
        self.publish_positions()
        if not same_array(positions, before):
            self.revision += 1

    def remember(self) -> None:
        """Make the present state the one that worlds are reset to."""
        self.adopt_positions()
        self.initial = (wp.clone(self.displacements), wp.clone(self.velocities))

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.sizes.launch_nodes, inputs=inputs, outputs=outputs, device=self.device)
