"""The host's work in a call of ``advance``: one wait for the device and a launch or two, however short the call is;
and that the device sees what users write in between."""

from collections import Counter

import numpy as np
import pytest
import warp as wp
from beams import beam, stretched

import warp_corot as wc
from warp_corot.solvers.stability import INTERVAL


@pytest.fixture
def calls(monkeypatch):
    """Number of Warp's calls since the counter was cleared, by kind."""
    counted = Counter()

    def count(owner, name, what):
        whole = getattr(owner, name)

        def wrapped(*args, **kwargs):
            if what != "launches" or not any(device.is_capturing for device in wp.get_devices()):
                counted[what] += 1
            return whole(*args, **kwargs)

        monkeypatch.setattr(owner, name, wrapped)

    for name in ("synchronize", "synchronize_device", "synchronize_stream", "synchronize_event"):
        count(wp, name, "waits")
    for name in ("numpy", "list", "assign"):
        count(wp.array, name, "waits")
    for name in ("launch", "copy"):
        count(wp, name, "launches")
    count(wp, "capture_launch", "graphs")
    return counted


def simulation(device, dt=None, **options):
    return wc.Simulation(beam(device, young=2e5, **options), integrator=wc.SymplecticEuler(dt=dt))


@pytest.mark.parametrize("steps", [1, 3.3, 7])
@pytest.mark.parametrize("given", [False, True], ids=["its own step", "given step"])
def test_a_short_call_waits_once(device, calls, given, steps):
    """For a body that hardly deforms, with measurements of the step; twice if a check on elastic energies, which
    comes every so many steps, falls within the call."""
    dt = simulation(device).dt
    sim = simulation(device, dt=dt if given else None)
    sim.advance_steps(4 * INTERVAL * 16)
    done, waits, most = sim.steps, 0, Counter()
    for _ in range(count := int(8 * INTERVAL / steps)):
        calls.clear()
        sim.advance(steps * dt)
        waits += calls["waits"]
        most |= calls
    assert sim.steps > done
    assert waits <= count + (sim.steps - done) // (2 * INTERVAL)
    assert most["graphs"] <= 12
    assert most["launches"] <= 2


def test_the_ordinary_call_is_one_graph(device, calls):
    sim = simulation(device, dt=1e-4)
    for _ in range(3):
        sim.advance(4e-4)
    calls.clear()
    sim.advance(4e-4)
    assert calls == {"waits": 1, "graphs": 1}


def test_the_host_does_not_ask_for_what_it_knows(device, calls):
    sim = simulation(device)
    sim.advance(0.01)
    calls.clear()
    numbers = sim.time, sim.total_time, sim.steps, sim.total_steps, sim.dt, sim.dt_range
    assert not calls
    assert numbers[:2] == (0.01, 0.01)
    sim.step()
    assert sim.steps == numbers[2] + 1
    assert sim.time == pytest.approx(0.01 + sim.dt)


def written(sim):
    sim.body.positions.assign(sim.body.positions.numpy() + [0, 1e-6, 0] * ~sim.body.constrained[:, None])


def pushed(sim):
    sim.body.velocities.assign(sim.body.velocities.numpy() + [0, 1e-3, 0] * ~sim.body.constrained[:, None])


def freed(sim):
    sim.body.release(sim.body.constrained)


@pytest.mark.parametrize("act", [written, pushed, freed])
@pytest.mark.parametrize("dt", [None, 1e-4])
def test_what_a_user_writes_in_place_is_seen(device, calls, act, dt):
    """The device sees it: the next call counts from other energies, for which the host waits once more."""
    sim = simulation(device, dt=dt)
    for _ in range(5):
        sim.advance(4e-4)
    act(sim)
    calls.clear()
    sim.advance(4e-4)
    assert calls["waits"] > 1
    calls.clear()
    sim.advance(4e-4)
    assert calls["waits"] == 1


def test_a_hand_that_pushes_costs_nothing_more(device, calls):
    sim = simulation(device)
    end = np.flatnonzero(sim.body.mesh.points[:, 2] > 0.192 - 1e-9)
    rng = np.random.default_rng(5)
    waits = []
    for _ in range(100):
        sim.body.load(end, rng.normal(0, 0.01, 3))
        calls.clear()
        sim.advance(1e-3)
        waits.append(calls["waits"])
    assert np.median(waits) == 1


@pytest.mark.parametrize("dt", [None, 2e-4])
def test_a_hand_that_shakes_held_nodes_is_no_fault(device, dt):
    """Held nodes move at any velocity; the user sets the state each time."""
    sim = simulation(device, dt=dt)
    end = np.flatnonzero(sim.body.mesh.points[:, 2] > 0.192 - 1e-9)
    rng = np.random.default_rng(5)
    for _ in range(100):
        sim.body.prescribe(end, velocity=rng.normal(0, 0.3, 3))
        sim.advance(1e-3)
    assert sim.time == pytest.approx(0.1)


@pytest.mark.parametrize("dt", [None, 5e-4])
def test_the_work_of_temporary_loads_counts(device, dt):
    """Their work counts while they act, so that their energy does not seem to come from nowhere when they are gone."""
    sim = wc.Simulation(beam(device), gravity=(0, 0, 0), integrator=wc.SymplecticEuler(dt=dt))
    end = np.flatnonzero(sim.body.mesh.points[:, 2] > 0.192 - 1e-9)
    for k in range(60):
        sim.body.load(end, [0.0, 0.03 if k % 3 == 0 else 0.0, 0.0])
        sim.advance(2e-3)
    assert sim.energy().total > 1e-5


def test_after_a_failure_the_end_of_the_last_call_is_the_last_good_state(device):
    """With what a user wrote to it; earlier calls are never repeated."""
    sim = wc.Simulation(beam(device), gravity=(0, 0, 0))
    for _ in range(70):
        sim.advance(3e-3)
    velocities = np.zeros((sim.body.node_count, 3))
    velocities[:, 2] = np.where(sim.body.constrained, 0.0, -100.0 * sim.body.mesh.points[:, 2] / 0.192)
    stretched(sim.body, 0.02)
    sim.body.velocities = velocities
    began, steps = sim.time, sim.steps
    with pytest.warns(wc.StabilityWarning, match=rf"continues from t = {began:.4g} s with half the step"):
        sim.advance(0.1)
    assert sim.time == pytest.approx(began + 0.1)
    assert sim.steps > steps


def test_short_calls_take_the_same_steps_as_one(device):
    """The steps have equal lengths except at the ends of calls.

    On CUDA forces are summed in any order, and the two runs find slightly different stable steps.
    """
    short, long = (simulation(device) for _ in range(2))
    for _ in range(100):
        short.advance(0.5 * short.dt * INTERVAL)
    long.advance(short.total_time)
    assert short.time == pytest.approx(long.time, rel=1e-12)
    least = 1.0 if short.device.is_cpu else 0.95
    assert least * long.steps <= short.steps <= 1.1 * long.steps
    size = np.abs(long.body.displacements.numpy()).max()
    assert size > 1e-4
    np.testing.assert_allclose(
        short.body.displacements.numpy(), long.body.displacements.numpy(), atol=0.02 * size, rtol=0
    )
