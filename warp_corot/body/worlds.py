"""One of several copies of a body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

if TYPE_CHECKING:
    from .soft_body import SoftBody


@dataclass(frozen=True, eq=False)
class World:
    """One copy's part of a body's arrays, as views: writing to them changes the body's state.

    Attributes:
        body: The body.
        index: Index of the copy, from 0.
    """

    body: SoftBody
    index: int

    @property
    def nodes(self) -> slice:
        """The range of the copy's nodes among the body's."""
        count = self.body.world_node_count
        return slice(self.index * count, (self.index + 1) * count)

    @property
    def elements(self) -> slice:
        """The range of the copy's elements among the body's."""
        count = self.body.world_element_count
        return slice(self.index * count, (self.index + 1) * count)

    @property
    def positions(self) -> wp.array:
        """As ``SoftBody.positions`` [m], vec3 [N] of one copy."""
        return self._own(self.body.positions)

    @property
    def displacements(self) -> wp.array:
        """As ``SoftBody.displacements`` [m], vec3 [N] of one copy: a copy of the values, not a view."""
        return self._own(self.body.displacements)

    @property
    def velocities(self) -> wp.array:
        """As ``SoftBody.velocities`` [m/s], vec3 [N] of one copy."""
        return self._own(self.body.velocities)

    @property
    def reactions(self) -> wp.array:
        """As ``SoftBody.reactions`` [N], vec3 [N] of one copy."""
        return self._own(self.body.reactions)

    @property
    def loads(self) -> wp.array:
        """As ``SoftBody.loads`` [N], vec3 [N] of one copy."""
        return self._own(self.body.loads)

    def _own(self, array: wp.array) -> wp.array:
        return array if self.body.worlds == 1 else array[self.nodes]
