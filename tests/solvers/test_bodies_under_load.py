"""Soft bodies under their own weight with defaults: no error, no absurd state, and no energy beyond gravity's.

The bodies are in ``loaded``, the checks and their tolerances in ``falls``.
"""

import numpy as np
import pytest
from falls import Fall, fall, violations
from loaded import DOZEN, FEW, GRAVITY, LAWS, LONG, MANY, SHAPES, SHORT, THIRTY, Loaded


@pytest.mark.parametrize("case", DOZEN, ids=str)
def test_a_soft_body_moves_within_what_gravity_gives(case, device):
    assert violations(fall(case, SHORT, FEW, device)) == []


@pytest.mark.slow
@pytest.mark.parametrize("case", THIRTY, ids=str)
def test_a_soft_body_goes_on_moving_within_what_gravity_gives(case, device):
    assert violations(fall(case, LONG, MANY, device)) == []


def test_all_shapes_laws_and_stiffnesses_are_among_them():
    assert {case.shape for case in THIRTY} == set(SHAPES)
    assert {case.law for case in THIRTY} == set(LAWS)
    assert {case.kilopascals for case in THIRTY} == {1, 3, 5, 10, 30}
    assert len(set(THIRTY)) == len(THIRTY) >= 30
    assert len(set(DOZEN)) == len(DOZEN) == 12
    assert {case.shape for case in DOZEN} == set(SHAPES)


def test_stvk_that_collapses_says_why(device):
    """Its energy has no barrier against J = 0: crushed elements invert, and the force grows as they move on."""
    found = fall(Loaded("sphere", 1, "stvk", poisson=0.44), SHORT, FEW, device)
    assert not violations(found) or "barrier" in found.error


# --- the laws see what they should ------------------------------------------------------------------------------------


def drop(**changed):
    """A free fall of 2 kg over 1 s, with some of its numbers changed."""
    t = np.linspace(0.1, 1.0, 10)
    fallen = 0.5 * GRAVITY * t**2
    energy = 2 * GRAVITY * fallen
    numbers = {"times": t, "kinetic": energy, "elastic": 0 * t, "dropped": energy, "farthest": fallen}
    return Fall(1, 10.0, 0.1, lengthens=False, **(numbers | changed))


def test_a_free_fall_holds_all_laws():
    assert violations(drop()) == []


def test_violations_are_seen():
    late = np.arange(10) > 5  # from 0.7 s on
    (said,) = violations(drop(kinetic=drop().kinetic * np.where(late, 1.02, 1.0)))
    assert "energy" in said
    assert "0.70 s" in said
    (said,) = violations(drop(farthest=drop().farthest * np.where(late, 3.0, 1.0)))
    assert "moved" in said
    (said,) = violations(drop(farthest=drop().farthest * np.where(late, np.nan, 1.0)))
    assert said == "not finite at 0.70 s"
    (said,) = violations(drop(error="the state is not finite"))
    assert said.startswith("ended")


@pytest.mark.parametrize("law", ["corotated", "neo-hookean", "mass-spring"])
def test_a_small_step_holds_all_laws(law, device):
    """The checks are feasible: a tenth of the stable step at rest satisfies them."""
    case = Loaded("sphere", 1, law)
    dt = 0.1 * case.simulation(FEW, device).stable_dt
    assert violations(fall(case, SHORT, FEW, device, dt)) == []
