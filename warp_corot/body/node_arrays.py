"""A body's nodal arrays by name, for the user's own launches."""

from __future__ import annotations

import warp as wp

from .conditions import Conditions
from .state import State


class NodeArrays:
    """The part of ``SoftBody`` that gives its arrays with their layout in memory, one entry a node, [worlds * N] or
    longer.

    They are the solver's own arrays. Get them again after anything that changes them: a pass of remeshing,
    ``use_loads``, ``use_positions``, or the first load.
    """

    state: State
    conditions: Conditions

    @property
    def node_rest(self) -> wp.array:
        """Rest positions [m], vec4."""
        return self.state.rest

    @property
    def node_positions(self) -> wp.array:
        """``positions`` without gaps, vec4, for ``wp.to_jax``, which takes no strided views; or the array given to
        ``use_positions``."""
        return self.state.positions

    @property
    def node_displacements(self) -> wp.array:
        """Displacements from rest [m], vec4."""
        return self.state.displacements

    @property
    def node_velocities(self) -> wp.array:
        """Velocities [m/s], vec4."""
        return self.state.velocities

    @property
    def node_mass(self) -> wp.array:
        """Masses [kg], float32."""
        return self.conditions.mass

    @property
    def node_inverse_mass(self) -> wp.array:
        """Inverse masses [1/kg], float32; zero for fixed and prescribed nodes."""
        return self.conditions.inverse_mass

    @property
    def node_loads(self) -> wp.array:
        """External forces [N], vec4; or the array given to ``use_loads``."""
        return self.conditions.loads
