"""What implicit steps took to solve."""

from __future__ import annotations

from typing import NamedTuple


class Solves(NamedTuple):
    """Sums over all steps and bodies since the beginning; in each step of the world that needed most.

    Attributes:
        steps: Steps, once for each body.
        iterations: Of Newton's method.
        linear_iterations: Of conjugate gradients.
        unfinished: Steps that did not come within the tolerance.
    """

    steps: int
    iterations: int
    linear_iterations: int
    unfinished: int
