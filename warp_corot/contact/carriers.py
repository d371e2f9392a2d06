"""The carriers of contact places in implicit steps; see ``kernels.contact.carriers``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.contact import bearing
from warp_corot.kernels.contact import carriers as kernels
from warp_corot.kernels.contact.motion import Surface

from .surface import ContactSurface

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

FIELDS = {"entry": wp.int32, "compliance": wp.float32, "crowd": wp.float32, "gone": wp.vec3}


class PlaceCarriers:
    """The nodes that move the places of a surface and take their forces.

    Args:
        surface: The surface.
        bodies: Its bodies; on several ranks this rank's parts of them.

    Attributes:
        arrays: As a struct for kernels.
    """

    def __init__(self, surface: ContactSurface, bodies: Sequence[SoftBody]):
        self._surface, self._bodies, self._taken = surface, bodies, -1
        self.follow()

    def follow(self) -> None:
        """Update to the present surface; not while launches are recorded."""
        surface = self._surface
        if surface.revision == self._taken:
            return
        self._taken, self.arrays = surface.revision, kernels.Carriers()
        for name, dtype in FIELDS.items():
            count = surface.count + surface.bearer_count
            setattr(self.arrays, name, wp.zeros(count, dtype=dtype, device=surface.device))

    def nodes_of(self, k: int) -> tuple[int, int, int, Surface]:
        """The carriers of a body as nodes: the first, the number of carriers before these nodes, how many there are,
        and the struct of all these nodes."""
        surface, part = self._surface, self._surface.parts[k]
        if part.bearers:
            return part.bearer_start, surface.count, surface.worlds * part.bearers, surface.bearers
        return part.start, 0, surface.worlds * part.nodes, surface.arrays

    def launch_places(self, k: int) -> None:
        """Launch the positions and motions of the places between nodes of a body, from those of the nodes."""
        surface, part = self._surface, self._surface.parts[k]
        if part.bearers:
            inputs = [part.start, surface.bearers, surface.arrays]
            wp.launch(bearing.place_borne, surface.worlds * part.nodes, inputs, device=surface.device)

    def launch_begin(self, k: int, first: int, blocks: wp.array, increment: wp.array, guess: wp.array) -> None:
        """Launch the beginning of a step: where the places of a body are.

        Args:
            k: The number of the body.
            first: Its first entry in vectors.
            blocks: The blocks on the diagonal of its matrix, mat33.
            increment: How far held nodes have gone in the step [m], vec4.
            guess: How far free nodes may go [m], vec4.
        """
        body = self._bodies[k]
        start, offset, count, own = self.nodes_of(k)
        inputs = [start, offset, first, body.conditions.inverse_mass, blocks]
        inputs += [body.state.rest, body.state.displacements, increment, guess]
        wp.launch(kernels.begin_carriers, count, inputs, [own, self.arrays], device=body.device)
        self.launch_places(k)

    def launch_end(self, k: int) -> None:
        """Launch the forces at the nodes of a body, from those at its places."""
        surface = self._surface
        start, _offset, count, own = self.nodes_of(k)
        inputs = [start, int(surface.parts[k].bearers > 0), own, surface.arrays]
        forces = self._bodies[k].state.contact_forces
        wp.launch(kernels.end_carriers, count, inputs, [forces], device=surface.device)
