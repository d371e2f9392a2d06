"""The state of a body's nodes on a device: positions, velocities and forces."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.sizes import Sizes, padded, same_array
from warp_corot.kernels.stepping.integrate import ADOPT_POSITIONS, PUBLISH_POSITIONS

if TYPE_CHECKING:
    from warp_corot.mesh.surfaces.bound import SurfaceMesh


class State:
    """Displacements, velocities and forces of nodes, in 16-byte vec4 arrays whose fourth lane is unused.

    With vec4, a node is one load and, where the GPU supports it, one reduction. The state variable is the displacement
    from rest, which keeps the digits of small strains: the static end of a linear beam is exact to 1e-6 of its
    deflection; with float32 positions, to 4e-6 with the beam at the origin and to 3e-5 one metre away.

    Args:
        sizes: Number of nodes.
        rest: Rest positions of the nodes of all worlds [m], [worlds * N, 3].
        device: The device of the arrays.

    Attributes:
        rest, positions, displacements, velocities: [m], [m/s], vec4. ``positions`` may be another program's array, of
            vec3 or vec4.
        forces: The sum of forces within a step [N], zero between steps.
        reactions: Forces of the supports in the last step [N].
        contact_forces: Contact forces in the last step [N]; one entry until the body may have contact.
        contact_pressures: Contact pressures on the triangles of the surface [Pa], float32; empty until then.
        contact_surface: That surface; None: the boundary of the tetrahedra.
        rebound_contact_surface: Binds it to the nodes of the present mesh; None: the mesh does not change.
        is_touched: Whether the body may have contact.
        initial: Displacements and velocities that a reset restores; None for rest.
        revision: Changes whenever ``positions`` becomes another array.
    """

    def __init__(self, sizes: Sizes, rest: npt.NDArray[np.float64], device: wp.Device):
        self.sizes, self.device = sizes, device
        self.rest = wp.array(padded(rest), dtype=wp.vec4, device=device)
        self.positions = wp.clone(self.rest)
        self.displacements, self.velocities, self.forces, self.reactions = (wp.zeros_like(self.rest) for _ in range(4))
        self.contact_forces, self.is_touched = wp.zeros(1, dtype=wp.vec4, device=device), False
        self.contact_pressures = wp.zeros(0, dtype=wp.float32, device=device)
        self.contact_surface: SurfaceMesh | None = None
        self.rebound_contact_surface: Callable[[], SurfaceMesh] | None = None
        self.initial: tuple[wp.array, wp.array] | None = None
        self.revision = 0

    def move_into(self, rest: wp.array, displacements: wp.array, velocities: wp.array, reactions: wp.array) -> None:
        """Use other arrays from now on, vec4 of at least the same size; ``rest`` already has its values."""
        self.adopt_positions()
        for array, own in (
            (displacements, self.displacements),
            (velocities, self.velocities),
            (reactions, self.reactions),
        ):
            wp.copy(array, own, count=self.sizes.nodes)
        self.rest, self.displacements, self.velocities, self.reactions = rest, displacements, velocities, reactions
        self.positions, self.forces = wp.clone(rest), wp.zeros_like(displacements)

    def make_contact_forces(self) -> None:
        """Ensure that there is a contact force for every node of the current mesh."""
        if len(self.contact_forces) != len(self.displacements):
            self.contact_forces = wp.zeros_like(self.displacements)
            self.revision += 1
        self.is_touched = True

    def set_displacements(self, values: npt.NDArray[np.float64]) -> None:
        """Set the displacements of the nodes of all worlds [m], [worlds * N, 3]."""
        self.displacements[: self.sizes.nodes].assign(padded(values))
        self.publish_positions()

    def set_velocities(self, values: npt.NDArray[np.float64]) -> None:
        """Set the velocities of the nodes of all worlds [m/s], [worlds * N, 3]."""
        self.velocities[: self.sizes.nodes].assign(padded(values))

    def adopt_positions(self) -> None:
        """Adopt positions that were written after they were last published."""
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
        """Make the current state the one that a reset restores."""
        self.adopt_positions()
        self.initial = (wp.clone(self.displacements), wp.clone(self.velocities))

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=self.sizes.launch_nodes, inputs=inputs, outputs=outputs, device=self.device)
