"""Springs between hands and the shown surfaces in implicit steps, whose matrix has their stiffness."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.kernels.viewing import implicit_hands as kernels
from warp_corot.simulation.simulation import Simulation
from warp_corot.solvers import SymplecticEuler, largest_frequency

from .shown import Shown
from .springs import MOST_HANDS, MOST_POINTS, AllSprings, BodySprings, Springs


def springs_of(sim: Simulation, shown: Sequence[Shown]) -> AllSprings:
    """The springs of all hands of a simulation, for its kind of steps.

    Args:
        sim: The simulation.
        shown: The shown surface of each body.
    """
    return (ImplicitSprings if sim.system.is_implicit else Springs)(sim, shown)


class ImplicitSprings(AllSprings):
    """The springs of implicit steps, as stiff as those of explicit ones."""

    def _springs_of(self, body: int) -> StiffSprings:
        return StiffSprings(self.sim, self.shown[body])

    def add_stiffness(self, body: SoftBody, p: wp.array, y: wp.array) -> None:
        """Launch y += K p, where K are springs as soft as their limits make them; may be recorded."""
        for springs in self._on(body):
            springs.launch_product(p, y)

    def add_diagonal(self, body: SoftBody, blocks: wp.array) -> None:
        """Launch the addition of the blocks on K's diagonal; may be recorded."""
        for springs in self._on(body):
            springs.launch_blocks(blocks)

    def _on(self, body: SoftBody) -> list[StiffSprings]:
        return [cast("StiffSprings", springs) for springs in self._bodies.values() if springs.body is body]


class StiffSprings(BodySprings):
    """The springs that hold one body in implicit steps."""

    def __init__(self, sim: Simulation, shown: Shown):
        super().__init__(sim, shown)
        shape = (MOST_HANDS, MOST_POINTS)
        self._softened = wp.zeros(shape, dtype=wp.float32, device=self.body.device)
        self._explicit_dt: float | None = None

    def launch(self) -> None:
        state = self.body.state
        inputs = [*self._places, self._starts, state.displacements]
        self._launch(kernels.pull, [*inputs, state.forces, self._found, self._softened])

    def launch_product(self, p: wp.array, y: wp.array) -> None:
        """Launch y += K p."""
        self._launch(kernels.add_products, [*self._places, self._softened, p, y])

    def launch_blocks(self, blocks: wp.array) -> None:
        """Launch the addition of the blocks on K's diagonal."""
        self._launch(kernels.add_blocks, [*self._places, self._softened, blocks])

    @property
    def _places(self) -> list[wp.array]:
        shown = self.shown
        return [self._springs, self._patches, self._shares, shown.nodes, shown.binding.weights]

    def _longest_step(self) -> float:
        if self._explicit_dt is None:
            sim, k = self.sim, self.sim.bodies.index(self.body)
            frequency = largest_frequency(self.body, sim.fields[k].stiffest, sim.ranks, k)
            self._explicit_dt = SymplecticEuler().stable_step(frequency)
        return self._explicit_dt

    def _launch(self, kernel: wp.Kernel, inputs: list[wp.array]) -> None:
        wp.launch(kernel, MOST_HANDS, inputs, device=self.body.device)
