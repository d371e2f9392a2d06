"""Exchanges between the memory of cards; without a card there is nothing to test."""

from pathlib import Path

import exchanging
import pytest
import warp as wp
from mpirun import needs_mpi, on_ranks

pytestmark = [needs_mpi, pytest.mark.skipif(wp.get_cuda_device_count() == 0, reason="needs a card")]


def test_values_of_all_types_arrive_between_cards_and_in_recorded_launches():
    done = on_ranks(3, str(Path(exchanging.__file__)), timeout=300.0)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("as expected") == 3
