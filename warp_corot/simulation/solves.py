"""The cost of the solves of implicit steps."""

from __future__ import annotations

from typing import NamedTuple


class Solves(NamedTuple):
    """Sums over all steps and bodies since the beginning; each step counts the world that needed most.

    Attributes:
        steps: Steps, once for each body.
        iterations: Iterations of Newton's method.
        linear_iterations: Iterations of conjugate gradients.
        unfinished: Steps that did not reach the tolerance, or whose linear solves ran out while contact still changed.
    """

    steps: int
    iterations: int
    linear_iterations: int
    unfinished: int
