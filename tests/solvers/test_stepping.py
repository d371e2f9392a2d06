"""A step that follows the state: as long as the strained body's spectrum allows, exact in time, and repeated if
it was too long; and a given step, whose run ends if energy comes from nowhere."""

import warnings

import numpy as np
import pytest
from beams import beam, stretched

import warp_corot as wc
from warp_corot.solvers.stability import INTERVAL


def energy_range(sim, seconds, looks):
    """The total energy at each sample [J]."""
    found = [sim.energy().total]
    for _ in range(looks):
        sim.advance(seconds / looks)
        found.append(sim.energy().total)
    return np.array(found)


# --- time ----------------------------------------------------------------------------------------------------------


def test_time_adds_up_exactly(device):
    sim = wc.Simulation(beam(device))
    sim.advance(1.0)
    assert sim.time == sim.total_time == 1.0
    for _ in range(3):
        sim.advance(0.125)
    assert sim.total_time == 1.375
    sim.advance_until(1.5)
    assert sim.total_time == 1.5
    sim.reset()
    sim.advance(0.25)
    assert (sim.time, sim.total_time) == (0.25, 1.75)


def test_time_is_exact_with_hooks_that_make_steps_themselves(device):
    sim = wc.Simulation(beam(device))
    seen = []

    def also(s):
        seen.append(s.steps)
        if s.steps == 20:
            s.advance_steps(3)

    sim.on_step(also, every=5)
    sim.advance(0.2)
    assert sim.time == 0.2
    assert seen == list(range(5, sim.steps + 1, 5))


def test_frames_are_the_same_in_one_run_or_many():
    """On the CPU bit for bit: measurements come at whole intervals, wherever calls begin and end.

    Only a run that goes back differs: it goes back to where a call ended. A beam that bends under gravity does not.
    """
    whole, parted = (wc.Simulation(beam()) for _ in range(2))
    whole.advance_steps(4 * INTERVAL)
    for count in (7, INTERVAL - 7, 2 * INTERVAL, INTERVAL // 2, INTERVAL // 2):
        parted.advance_steps(count)
    assert whole.time == parted.time
    np.testing.assert_array_equal(whole.body.positions.numpy(), parted.body.positions.numpy())


def test_single_steps_follow_the_state_too():
    """Like runs in which no energy check changes the step, since single steps have no such check."""
    one, many = (wc.Simulation(beam()) for _ in range(2))
    one.advance_steps(3 * INTERVAL)
    for _ in range(3 * INTERVAL):
        many.step()
    assert many.time == one.time
    np.testing.assert_array_equal(one.body.positions.numpy(), many.body.positions.numpy())


def test_a_simulation_that_is_reset_repeats_its_steps():
    sim = wc.Simulation(beam())
    stretched(sim.body, 0.3)
    sim.body.set_initial_state()
    ends = []
    for _ in range(2):
        sim.reset()
        sim.advance(0.1)
        ends.append((sim.steps, sim.body.positions.numpy().copy()))
    assert ends[0][0] == ends[1][0]
    np.testing.assert_array_equal(ends[0][1], ends[1][1])


# --- the step ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", [wc.Corotated(), wc.NeoHookean(), wc.StVenantKirchhoff(), wc.Linear()], ids=repr)
def test_a_body_that_hardly_deforms_takes_hardly_more_steps_than_a_fixed_one(device, model):
    """Within 1.15 of the steps of 0.98 times the largest stable step, which is known to be stable."""
    body = beam(device, young=2e6)
    sim = wc.Simulation(body, model=model)
    sim.advance(0.05)
    assert sim.steps <= 1.15 * (0.05 / (0.98 * sim.stable_dt)) + 1
    assert sim.dt <= 0.9 * sim.stable_dt


@pytest.mark.parametrize("model", [wc.Corotated(), wc.NeoHookean(), wc.StVenantKirchhoff(), wc.EdgeStVK()], ids=repr)
def test_the_step_follows_the_spectrum_of_the_strained_body(device, model):
    """The largest frequency of the state in float64 allows the step, with the same margin as for safe strains.

    The measured frequency lies within a fifth of the true one: the measurement is a power iteration that continues
    during the motion, not a solved eigenvalue problem.
    """
    spectrum = pytest.importorskip("spectrum", reason="the float64 spectrum of strained bodies")
    names = {
        "Corotated": "corotated",
        "NeoHookean": "neo_hookean",
        "StVenantKirchhoff": "stvk",
        "EdgeStVK": "edge_stvk",
    }
    body = beam(device)
    sim = wc.Simulation(body, model=model, integrator=wc.SymplecticEuler(damping=5.0))
    for until in (0.1, 0.2, 0.3):
        sim.advance_until(until)
        true = spectrum.stable_step(names[type(model).__name__], body)
        assert 0.5 * 0.6 * true < sim.dt < 1.1 * true


def test_worlds_share_the_smallest_step(device):
    body = beam(device, worlds=2)
    alone = beam(device)
    for each in (body, alone):
        each.set_initial_state()
    points = body.mesh.points
    body.displacements = np.stack([0.0 * points, 0.8 * points * [0, 0, 1]])
    together = wc.Simulation(body)
    together.advance_steps(INTERVAL)
    still = wc.Simulation(alone, gravity=(0, 0, 0))
    still.advance_steps(INTERVAL)
    assert together.dt < 0.8 * still.dt


# --- going back ----------------------------------------------------------------------------------------------------


def test_a_failed_run_is_repeated_with_half_the_step(device):
    """A blow between two measurements: the state before it does not show that the step must be so short."""
    sim = wc.Simulation(beam(device), gravity=(0, 0, 0))
    sim.advance_steps(INTERVAL + 1)
    velocities = np.zeros((sim.body.node_count, 3))
    velocities[:, 2] = np.where(sim.body.constrained, 0.0, -25.0 * sim.body.mesh.points[:, 2] / 0.192)
    sim.body.velocities = velocities
    start = sim.energy().total
    until = sim.total_time + 0.1
    with pytest.warns(
        wc.StabilityWarning, match=r"went wrong by t = .* continues from t = .* with half the step"
    ) as said:
        sim.advance(0.1)
    assert len(said) == 1
    assert sim.total_time == pytest.approx(until, rel=1e-12)
    assert sim.dt < sim.dt_range[1]
    # Half of the largest kinetic energy exceeds the tolerance.
    assert sim.energy().total < 1.5 * start


@pytest.mark.parametrize("seconds", [0.05, 0.1])
@pytest.mark.parametrize("share", [0.3, 0.9, None])
def test_a_swing_back_to_where_it_began_is_no_energy_from_nowhere(device, share, seconds):
    """One tetrahedron on three held nodes swings with a period of 52 ms: at the checks, gravity has moved little."""
    mesh = wc.TetMesh(0.1 * np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -1]]), [[0, 2, 1, 3]])
    body = wc.SoftBody(mesh, wc.Isotropic(1e5, 0.4, 1e3), device=device)
    body.fix([0, 1, 2])
    sim = wc.Simulation(body)
    if share is not None:
        sim = wc.Simulation(body, integrator=wc.SymplecticEuler(share * sim.dt))
    with warnings.catch_warnings():
        warnings.simplefilter("error", wc.StabilityWarning)
        for _ in range(4):
            sim.advance(seconds)


def test_a_given_step_ends_with_an_error_where_energy_comes_from_nowhere(device):
    """Long before a value is not finite."""
    limit = wc.Simulation(beam(device)).stable_dt
    with pytest.warns(wc.StabilityWarning, match="beyond the largest stable"):
        sim = wc.Simulation(beam(device), integrator=wc.SymplecticEuler(dt=1.02 * limit))
    sim.on_step(lambda s: None, every=16)  # before which it is checked
    with pytest.raises(wc.UnstableError, match=r"J of energy came from nowhere .* take a shorter step, or dt=None"):
        sim.advance(5.0)
    assert np.isfinite(sim.body.positions.numpy()).all()


def test_energy_from_nowhere_in_some_worlds_is_an_error_as_in_one(device, rng):
    mesh = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.1, level=0)
    body = wc.SoftBody(mesh, wc.Isotropic(1e5, 0.4, 1e3), worlds=3, device=device)
    limit = wc.Simulation(body).stable_dt
    velocities = 0.1 * rng.standard_normal((body.node_count, 3))
    velocities[: len(mesh.points)] = 0.0
    body.velocities = velocities
    with pytest.warns(wc.StabilityWarning, match="beyond the largest stable"):
        sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=1.1 * limit))
    sim.on_step(lambda s: None, every=4)
    with pytest.raises(wc.UnstableError, match="J of energy came from nowhere"):
        sim.advance(1.0)


def test_no_step_helps_against_forces_without_bounds(device):
    sim = wc.Simulation(beam(device))
    sim.body.load([sim.body.node_count - 1], [0.0, 3e38, 0.0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wc.StabilityWarning)
        with pytest.raises(wc.UnstableError, match="half the step did not help"):
            sim.advance(0.1)


# --- energy --------------------------------------------------------------------------------------------------------


def pushed(sim):
    sim.body.load(np.arange(sim.body.node_count), [0.0, 0.0, 0.02 / sim.body.node_count])


def pulled(sim):
    end = sim.body.mesh.points[:, 2] > 0.192 - 1e-9
    sim.body.prescribe(
        end, times=[0.0, 0.02, 0.05, 0.06], displacements=[[0, 0, 0], [0, 0, 0.05], [0.03, 0, 0], [0] * 3]
    )


def wound(sim):
    end = sim.body.mesh.points[:, 2] > 0.192 - 1e-9
    sim.body.prescribe(end, velocity=[0.0, 0.0, 0.4])


@pytest.mark.parametrize("model", [wc.Corotated(), wc.NeoHookean(), wc.MassSpring()], ids=repr)
@pytest.mark.parametrize("act", [pushed, pulled, wound])
@pytest.mark.filterwarnings("ignore:the state went wrong")
def test_work_put_in_is_not_energy_from_nowhere(device, model, act):
    for dt in (None, 1e-4):
        sim = wc.Simulation(beam(device), model=model, gravity=(0, 0, 0), integrator=wc.SymplecticEuler(dt=dt))
        act(sim)
        for _ in range(4):
            sim.advance(0.05)
        assert sim.energy().total > 0


def test_the_balance_accounts_for_supports_to_the_digits_of_the_forces(device):
    """Symplectic Euler keeps the energy of a linear body exactly, with its own form of the kinetic energy: so the
    supports' work appears in it, to the rounding of the forces, for any motion."""
    sim = wc.Simulation(beam(device), model=wc.Linear(), integrator=wc.SymplecticEuler(dt=2e-4))
    pulled(sim)
    sim.advance(0.01)
    for _ in range(10):
        sim.advance_steps(512)
    drift, scale = sim.guard.state["drift"][0], sim.guard.state["scale"][0]
    assert scale > 0.01
    assert drift < 1e-3 * scale


def test_states_that_a_user_writes_begin_a_new_balance(device):
    sim = wc.Simulation(beam(device), gravity=(0, 0, 0))
    sim.advance(0.05)
    stretched(sim.body, 0.5)
    sim.advance(0.01)
    sim.body.velocities = sim.body.velocities.numpy() + [0.5, 0, 0] * ~sim.body.constrained[:, None]
    sim.advance(0.01)
    sim.body.release(sim.body.constrained)
    sim.advance(0.01)


def test_long_runs_drift_far_less_than_is_tolerated(device):
    """Undamped oscillation: thousands of steps, tens of checks."""
    sim = wc.Simulation(beam(device, young=3e4))
    energies = energy_range(sim, 4.0, 8)
    fallen = sim.guard.state["scale"][0]
    assert sim.steps > 2000
    assert np.ptp(energies) < 0.1 * fallen
