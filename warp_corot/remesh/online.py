"""What a user asks for: how a mesh is to follow the motion."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import warp as wp

from warp_corot.discretization.changing.checks import (
    checked_capacity,
    checked_criterion,
    checked_parameters,
    checked_thresholds,
)
from warp_corot.inputs.checks import checked_count
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import MAX_LEVEL, check_levels


@dataclass(frozen=True, eq=False)
class OnlineRemesh:
    """Refinement and simplification while a simulation runs; see ``warp_corot.remesh``.

    Every ``every`` steps a pass looks at all elements: an element is bisected where the criterion is above
    ``refine_above``, and given up with its sibling where both are below ``simplify_below`` and their parent would not
    be refined again. Between the two nothing happens. An element is bisected once a pass, and again where its
    neighbours ask for it. One of which the body takes less than half is not refined for its own sake.

    Children have their parent's material, with the direction of its fibres, and pull as it did. A parent has the mean
    of its children's stiffness, density and active stress, but its first child's directions, and that child's active
    stress where the two follow different keyframes.

    ``Simulation.reset()`` goes back to the mesh of the initial state, with the loads, held nodes and motions that it
    had last: what was given while there was another mesh is gone.

    Attributes:
        refine_above, simplify_below: Thresholds in the criterion's unit; the first is the larger one. By default of the
            elongation of an element's longest edge, deformed over rest (Tagawa et al. 2013).
        min_level, max_level: Elements of these levels are not simplified and not refined, 0 to 48; three levels halve
            the edge length. None: the coarsest level of the mesh, and three beyond its finest.
        every: Steps between passes.
        capacity: How many elements there may be; None: four times those of the mesh, at least 100,000. When it is
            reached refinement stops, with one warning, and the simulation goes on.
        criterion: In place of the elongation: ``remesh.strain``, ``von_mises_stress`` or ``nearness``, or a Warp
            function (``@wp.func``) of your own of a ``remesh.ElementState`` and an array of numbers.
        parameters: Those numbers, float32 [n] on the simulation's device, which may be written to between steps. They
            must be all that the criterion reads: there is no check within kernels.

    Raises:
        InputError: Thresholds that cannot both hold, levels out of order or beyond the lattice's depth, a criterion
            that is no Warp function or has other arguments, too few parameters, or a number of steps or elements that
            is not positive.
    """

    refine_above: float = 1.25
    simplify_below: float = 1.08
    min_level: int | None = None
    max_level: int | None = None
    every: int = 10
    capacity: int | None = None
    criterion: Any = None
    parameters: wp.array | None = None

    def __post_init__(self) -> None:
        checked_thresholds(self.refine_above, self.simplify_below)
        check_levels(self.min_level, self.max_level)
        checked_count(self.every, "every", least=1)
        if self.capacity is not None:
            checked_count(self.capacity, "capacity", least=1)
        if self.criterion is not None:
            checked_criterion(self.criterion)
        checked_parameters(self.parameters, self.criterion)

    def on(self, mesh: TetForest) -> OnlineRemesh:
        """The same with numbers in place of what is found from a mesh.

        Raises:
            InputError: The mesh has more elements than ``capacity``.
        """
        levels, count = mesh.levels, len(mesh.tets)
        low, high = self.min_level, self.max_level
        if high is None:
            high = min(max(int(levels.max()) + 3, low or 0), MAX_LEVEL)
        if low is None:
            low = min(int(levels.min()), high)
        capacity = max(4 * count, 100_000) if self.capacity is None else self.capacity
        return replace(self, min_level=low, max_level=high, capacity=checked_capacity(capacity, count))
