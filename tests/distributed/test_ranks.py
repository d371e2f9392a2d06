"""The same run on 1, 2, 3 and 7 ranks."""

from pathlib import Path

import numpy as np
import pytest
import ranked
from mpirun import needs_mpi, on_ranks

import warp_corot as wc

SIZES = (1, 2, 3, 7)

pytestmark = needs_mpi


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """What each number of ranks has found."""
    folder, found = tmp_path_factory.mktemp("ranks"), {}
    for size in SIZES:
        done = on_ranks(size, str(Path(ranked.__file__)), str(folder / f"{size}.npz"))
        assert done.returncode == 0, done.stderr
        with np.load(folder / f"{size}.npz") as archive:
            found[size] = dict(archive)
    return found


@pytest.mark.parametrize("case", ranked.CASES)
def test_a_deterministic_run_is_the_same_bit_by_bit(runs, case):
    for size in SIZES[1:]:
        for what in ("x", "v", "numbers"):
            np.testing.assert_array_equal(runs[size][f"{case}.True.{what}"], runs[1][f"{case}.True.{what}"])


def test_any_run_is_the_same_to_rounding(runs):
    """Rounding alone tells runs apart, and the steps that it changes: the beams have moved by some centimetres."""
    for size in SIZES:
        np.testing.assert_allclose(runs[size]["forest.False.x"], runs[1]["forest.True.x"], atol=1e-5)
        energies = [runs[n][f"forest.{kind}.energy"] for n, kind in ((size, "False"), (1, "True"))]
        np.testing.assert_allclose(*energies, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("case", ranked.CASES)
def test_energies_are_those_of_all_ranks(runs, case):
    for size in SIZES[1:]:
        np.testing.assert_allclose(runs[size][f"{case}.True.energy"], runs[1][f"{case}.True.energy"], rtol=1e-12)


@pytest.mark.parametrize("case", ranked.CASES)
def test_ranks_do_what_one_process_does(runs, case):
    body = ranked.CASES[case]()
    sim = wc.Simulation(body)
    sim.advance(0.04)
    body.load("z > 0.09 and z < 0.1", [0.0, 0.0, 0.0])
    sim.advance(0.01)
    moved = np.abs(body.displacements.numpy()).max()
    assert moved > 0.01
    np.testing.assert_allclose(runs[7][f"{case}.True.x"], body.positions.numpy(), atol=2e-3 * moved)
