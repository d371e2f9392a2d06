"""What a user asks for: how a mesh is to follow the motion."""

from __future__ import annotations

import inspect
import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count
from warp_corot.kernels.remesh.criteria import PARAMETER_COUNTS
from warp_corot.mesh import TetForest
from warp_corot.mesh.lattice import MAX_LEVEL


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
        criterion: In place of the elongation: one of ``kernels.remesh.criteria``, ``strain``, ``von_mises_stress`` or
            ``nearness``, or a Warp function (``@wp.func``) of your own of a ``kernels.remesh.mark.ElementState`` and an
            array of numbers.
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
        above, below = self.refine_above, self.simplify_below
        if not (_is_finite(above) and _is_finite(below) and below < above):
            raise InputError(
                f"simplify_below is {below} and refine_above {above}; "
                "the first must be smaller, or a leaf would be refined and simplified at once"
            )
        for name in ("min_level", "max_level"):
            level = getattr(self, name)
            if level is not None and not _is_level(level):
                raise InputError(f"{name} is {level!r}; it must be a whole number from 0 to {MAX_LEVEL}")
        if self.min_level is not None and self.max_level is not None and self.min_level > self.max_level:
            raise InputError(f"min_level is {self.min_level} and max_level {self.max_level}; the first is the smaller")
        checked_count(self.every, "every", least=1)
        if self.capacity is not None:
            checked_count(self.capacity, "capacity", least=1)
        _check_criterion(self.criterion, self.parameters)

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
        if capacity < count:
            raise InputError(f"capacity is {capacity}; the mesh has {count} elements already")
        return replace(self, min_level=low, max_level=high, capacity=capacity)


def _is_finite(given: Any) -> bool:
    return isinstance(given, int | float | np.number) and math.isfinite(given)


def _is_level(given: Any) -> bool:
    return isinstance(given, int | np.integer) and not isinstance(given, bool) and bool(0 <= given <= MAX_LEVEL)


def _check_criterion(criterion: Any, numbers: Any) -> None:
    """See that the criterion is a function of an element and numbers, and that there are as many as it reads."""
    if criterion is not None:
        if not isinstance(criterion, wp.Function) or criterion.func is None:
            raise InputError(f"criterion is {criterion!r}; it must be a Warp function (@wp.func) of an ElementState")
        count = len(inspect.signature(criterion.func).parameters)
        if count != 2:
            raise InputError(
                f"the criterion {criterion.func.__name__!r} takes {count} arguments; "
                "it must take two, an ElementState and an array of float32"
            )
    if numbers is not None and not (
        isinstance(numbers, wp.array) and numbers.dtype == wp.float32 and numbers.ndim == 1 and len(numbers) > 0
    ):
        raise InputError(f"parameters is {numbers!r}; it must be a Warp array of float32, [n], not empty")
    needed, given = PARAMETER_COUNTS.get(criterion, 0), 0 if numbers is None else len(numbers)
    if given < needed:
        raise InputError(f"the criterion {criterion.func.__name__!r} has {given} parameters; it reads {needed}")
