"""Random blades through twelve bodies leave no inverted, lost or doubled element, and closed surfaces."""

import pytest
from blade_cases import BODIES, RandomBlades


@pytest.mark.parametrize("name", BODIES)
def test_random_blades_leave_sound_bodies(name, device):
    """A second path meets a body that is cut; with self-contact, which takes ten times as long, the slow run has it."""
    send(name, 0, device, count=1 if name == "touching" else 2)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 19))
@pytest.mark.parametrize("name", BODIES)
def test_a_thousand_random_blades_leave_sound_bodies(name, seed, device):
    send(name, seed, device)


def send(name, seed, device, count=5):
    """Send blades through a body, one after another."""
    blades = RandomBlades(name, seed, device)
    for k in range(count):
        if k:
            blades.again()
        blades.run()
