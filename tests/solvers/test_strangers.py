"""Bodies on which no constant of the stepping was tuned: no error, and no energy from nowhere.

They are in ``strangers``.
"""

import pytest
from strangers import STRANGERS, Run, run, violations

#: Bodies with former or early trouble that take a second or two.
FEW = {
    "liver, light": 0.5,
    "hollow sphere, nu 0.3": 0.6,
    "shaken, neo-Hookean": 0.8,
    "thrown at 5 m/s, neo-Hookean": 0.3,
    "remeshed": 0.3,
}


@pytest.mark.parametrize("stranger", [s for s in STRANGERS if s.name in FEW], ids=str)
def test_a_stranger_has_no_more_energy_than_it_was_given(stranger, device):
    assert violations(run(stranger, device, FEW[stranger.name])) == []


@pytest.mark.slow
@pytest.mark.parametrize("stranger", STRANGERS, ids=str)
def test_a_stranger_goes_on_with_no_more_energy_than_it_was_given(stranger, device):
    assert violations(run(stranger, device)) == []


def test_violations_are_seen():
    assert violations(Run(surplus=0.009, given=1.0)) == []
    assert "1.10%" in violations(Run(surplus=0.011, given=1.0))[0]
    assert len(violations(Run(surplus=float("nan"), error="not finite"))) == 2
