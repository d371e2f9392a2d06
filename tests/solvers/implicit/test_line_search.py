"""Line searches of steps with contacts: where the power along a change vanishes."""

import numpy as np
import pytest
import warp as wp

from warp_corot.kernels.implicit import line_search as kernels
from warp_corot.solvers.implicit.conjugate_gradients import LineSearch


class Springs:
    """Contacts that close at some fractions of a change, each with a stiffness."""

    def __init__(self, closing: list[float], stiffness: list[float]):
        self._closing, self._stiffness = np.array(closing), np.array(stiffness)

    def power(self, share: float) -> float:
        return -float((self._stiffness * np.maximum(share - self._closing, 0.0)).sum())

    def add_slopes(self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array) -> None:
        share = float(search.numpy()[0, int(kernels.TRIED)])
        slopes.assign([self.power(share) + float(slopes.numpy()[0])])


def taken(springs: Springs) -> float:
    """The share that is taken of a change that is right without contacts: the power 1 - s vanishes at s = 1."""
    rest, product, change, d = (wp.zeros(4, dtype=wp.vec4, device="cpu") for _ in range(4))
    for vector in (rest, product, change):
        vector.assign(np.array([[1.0, 0.0, 0.0, 0.0]] + 3 * [[0.0] * 4]))
    LineSearch(1, 4, springs, wp.get_device("cpu")).launch(rest, product, change, d)
    return float(d.numpy()[0, 0])


@pytest.mark.parametrize(
    ("closing", "stiffness"),
    [([0.3], [1e6]), ([0.97], [1e5]), ([0.01], [1e4]), ([0.5], [3.0]), ([0.1, 0.2, 0.6], [2.0, 1e3, 1e6])],
)
def test_shares_reach_the_place_where_stiff_contacts_balance_the_power(closing, stiffness):
    springs = Springs(closing, stiffness)
    low, high = 0.0, 1.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if 1.0 - middle + springs.power(middle) > 0.0 else (low, middle)
    # The contacts that close there must be among those that push, because the next solve takes only these into account.
    assert taken(springs) == pytest.approx(low, rel=0.02)
    assert springs.power(taken(springs)) < 0.0


def test_changes_that_contacts_allow_are_taken_whole():
    assert taken(Springs([0.95], [1.0])) == 1.0
