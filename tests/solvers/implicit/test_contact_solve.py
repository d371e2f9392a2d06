"""When contacts are located again between the linear solves of a step, and when a step is solved for."""

import numpy as np
import pytest
import warp as wp

from warp_corot.kernels.implicit import contact_solve as kernels
from warp_corot.kernels.implicit.conjugate_gradients import BEGAN, SCALARS, WITHIN


def judged(residuals, pairs=1):
    """Whether contacts are located after each of some solves, and whether another one follows; residuals are those
    with which the solves begin, over the tolerance."""
    locates, rounds, total, solves, going = (wp.zeros(1, dtype=wp.int32, device="cpu") for _ in range(5))
    outer = wp.zeros(1, dtype=wp.float64, device="cpu")
    given = [wp.array([value], dtype=wp.int32, device="cpu") for value in (1, pairs)]
    found = []
    for residual in residuals:
        scalars = np.zeros((1, SCALARS))
        scalars[0, int(BEGAN)], scalars[0, int(WITHIN)] = residual**2, 1.0
        outputs = [locates, outer, rounds, total, solves, going]
        inputs = [wp.array(scalars, dtype=wp.float64, device="cpu"), *given]
        wp.launch(kernels.judge_round, 1, inputs, outputs, device="cpu")
        found.append((int(locates.numpy()[0]), int(going.numpy()[0])))
    return found


def test_contacts_are_located_again_once_forces_are_in_balance():
    """Forces that are not would be bad multipliers: a residual that begins at 90 must fall below 27 first."""
    assert judged([90.0, 80.0, 40.0, 20.0, 95.0, 60.0]) == [(0, 1), (0, 1), (0, 1), (1, 1), (0, 1), (0, 1)]


@pytest.mark.parametrize(("pairs", "ends"), [(1, [1, 1, 0]), (0, [1, 0, 0])])
def test_a_step_with_pairs_ends_after_a_solve_for_which_they_were_located(pairs, ends):
    assert [going for _, going in judged([2000.0, 8.0, 5.0], pairs)] == ends
