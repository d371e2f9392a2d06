"""Active stress along fibres: closed forms, the float64 oracle, keyframes on the device."""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import MESHES, oracle_mesh, place, random_displacement
from fibres import MUSCLE, Bar, muscle, random_axes, simulated, wood

import warp_corot as wc

E_ALONG, NU_ALONG = MUSCLE["young_along"], MUSCLE["poisson_along"]
TIMES, STRESS = np.array([0.002, 0.004, 0.007]), np.array([0.0, 30.0, -10.0])


@pytest.mark.parametrize("axis", [0, 2])
def test_an_unloaded_bar_contracts(axis, device):
    """By sigma / E along the fibres, and swells by nu sigma / E across."""
    bar = Bar(muscle(np.eye(3)[axis]), device)
    bar.body.activate(1e-3 * E_ALONG)
    strain, spread = bar.strain()
    expected = np.full(3, 1e-3 * NU_ALONG)
    expected[axis] = -1e-3
    assert np.diag(strain) == pytest.approx(expected, rel=5e-3)
    assert spread < 5e-6


def held_bar(material, device, dt=1e-5, **options):
    """A bar along z with both ends fixed, and the nodes of the upper end."""
    mesh = wc.TetForest.box((1, 1, 2), 0.1, 3)
    sim, body = simulated(mesh, material, device, dt=dt, **options)
    top = mesh.points[:, 2] > 0.2 - 1e-9
    body.fix(top | (mesh.points[:, 2] < 1e-9))
    return sim, body, top


def test_supports_of_an_isometric_bar_carry_the_active_stress(device):
    """At fixed length the pull on each support is sigma A from the first step on, and nothing moves."""
    sim, body, top = held_bar(muscle([0, 0, 1]), device)
    body.activate(2e3)
    for _ in range(3):
        sim.advance_steps(20)
        pull = body.reactions.numpy()[top].sum(axis=0)
        assert pull == pytest.approx([0, 0, 2e3 * 0.1**2], abs=1e-4 * 2e3 * 0.1**2)
    assert np.abs(body.displacements.numpy()).max() < 1e-6 * 0.1


@pytest.mark.parametrize("amount", [0.1, 0.9])
@pytest.mark.parametrize("name", ["level 3", "mixed levels", "general"])
def test_forces_equal_the_oracle(name, amount, device, rng):
    """P = s (F d) d^T in each element, inverted ones too; without net force or torque."""
    mesh = MESHES[name]()
    axes, stress = random_axes(rng, len(mesh.tets)), rng.uniform(-1e4, 1e4, len(mesh.tets))
    sim, body = simulated(mesh, wood(axes), device)
    u = random_displacement(mesh, rng, amount)
    place(body, u)
    passive, energy = sim.forces().numpy(), sim.energy().elastic
    body.activate(stress)
    active = sim.forces().numpy().astype(float) - passive

    def density(F, s, d):
        return np.zeros(len(F)), oracle.active(F, s, d)

    x = mesh.points + u.astype(float)
    _, expected = oracle.continuum(density, oracle_mesh(mesh), x, stress, axes[:, 0])
    assert np.abs(active - expected).max() < 2e-6 * (np.abs(expected).max() + np.abs(passive).max())
    assert sim.energy().elastic == energy  # active stress has none
    assert np.abs(active.sum(axis=0)).max() < 1e-6 * np.abs(active).sum()
    assert np.abs(np.cross(x, active).sum(axis=0)).max() < 1e-6 * np.linalg.norm(active, axis=1).sum() * np.abs(x).max()


def test_von_mises_stress(device, rng):
    """At rest active stress is uniaxial, so the von Mises stress is its magnitude."""
    sim, body = simulated(MESHES["general"](), muscle([1, 2, 3]), device)
    stress = rng.uniform(-1e4, 1e4, len(body.mesh.tets))
    body.activate(stress)
    assert sim.von_mises() == pytest.approx(np.abs(stress), abs=1e-4 * 1e4)


def test_stable_step(device):
    """The step includes the current activation about the rest shape: weak activation makes no difference; one that
    adds fifteen times Young's modulus along the fibres makes the step about a third."""
    steps = []
    for stress in (0.0, 10.0, 15 * E_ALONG):
        body = wc.SoftBody(MESHES["level 4"](), muscle([0, 0, 1]), device=device)
        body.activate(stress)
        steps.append(wc.Simulation(body).stable_dt)
    assert steps[1] == pytest.approx(steps[0], rel=1e-3)
    assert 2 < steps[0] / steps[2] < 4


@pytest.mark.parametrize("single", [True, False])
def test_keyframes_are_followed(single, device):
    """In single steps and in recorded runs, the support of an isometric bar carries the stress of each time."""
    dt = 5e-5
    sim, body, top = held_bar(muscle([0, 0, 1]), device, dt=dt)
    body.activate(wc.Activation(TIMES, STRESS))
    for _ in range(8):
        if single:
            for _ in range(23):
                sim.step()
        else:
            sim.advance_steps(23)
        expected = np.interp((sim.steps - 1) * dt, TIMES, STRESS)  # a step uses the forces at its beginning
        assert body.activation.numpy() == pytest.approx(expected, abs=1e-4)
        assert body.reactions.numpy()[top, 2].sum() == pytest.approx(expected * 0.1**2, abs=2e-3 * 30 * 0.1**2)
    assert sim.time > TIMES[-1]


def test_elements_and_worlds_of_their_own(device, rng):
    """Keyframes for some elements in some worlds; a later call replaces those of elements, others are set by hand."""
    sim, body, _ = held_bar(muscle([0, 0, 1]), device, dt=1e-4, worlds=3)
    count = len(body.mesh.tets)
    keys = rng.uniform(0, 50, (3, 4))
    body.activation.fill_(7.0)
    body.activate(wc.Activation(TIMES, keys), [0, 1, 2, 3], worlds=[0, 2])
    body.activate(wc.Activation(TIMES, STRESS), [3], worlds=2)
    body.activate([[1.0, 2.0]], np.arange(count) >= count - 2, worlds=1)
    body.activate([[5.0], [6.0], [8.0]], [1])
    sim.advance_steps(31)
    expected = np.full((3, count), 7.0)
    now = [np.interp(30e-4, TIMES, keys[:, k]) for k in range(4)]
    expected[0, :4] = expected[2, :4] = now
    expected[2, 3] = np.interp(30e-4, TIMES, STRESS)
    expected[1, -2:] = 1.0, 2.0
    expected[:, 1] = 5.0, 6.0, 8.0
    assert body.activation.numpy().reshape(3, count) == pytest.approx(expected, rel=1e-5)


def test_written_between_recorded_steps(device):
    """Activation that begins, changes and ends after steps were recorded acts from the next step on."""
    sim, body, top = held_bar(muscle([0, 0, 1]), device)
    for stress in (None, 100.0, 50.0, 0.0):
        if stress is not None:
            wp.copy(body.activation, wp.full_like(body.activation, stress))
        sim.advance_steps(70)
        assert body.reactions.numpy()[top, 2].sum() == pytest.approx((stress or 0.0) * 0.1**2, abs=1e-3)


def test_another_number_needs_no_new_recording(device):
    """A step's launches depend on the existing keyframes, not on the stress."""
    _, body, _ = held_bar(muscle([0, 0, 1]), device)
    body.activate(1.0)
    recorded = [body.launch_revision]
    for stress, elements, changes in (
        (2.0, None, False),
        (wc.Activation(TIMES, STRESS), [3, 4], True),
        (5.0, [0, 1], False),
        (5.0, [1, 3], True),
        (6.0, None, True),
        (7.0, None, False),
    ):
        body.activate(stress, elements)
        recorded.append(body.launch_revision)
        assert (recorded[-1] != recorded[-2]) == changes


def test_reset_begins_anew(device):
    """A reset world restarts its keyframes, the others continue."""
    sim, body, _ = held_bar(muscle([0, 0, 1]), device, dt=1e-4, worlds=2)
    body.activate(wc.Activation(TIMES, STRESS))
    sim.advance_steps(30)
    sim.reset([1])
    sim.advance_steps(26)
    stress = body.activation.numpy().reshape(2, -1)
    assert stress[0] == pytest.approx(np.interp(55e-4, TIMES, STRESS), rel=1e-5)
    assert stress[1] == pytest.approx(np.interp(25e-4, TIMES, STRESS), rel=1e-5)


def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, device):
    sim, body, _ = held_bar(muscle([0, 1, 1]), device, dt=1e-4, worlds=2, deterministic=True)
    body.activate(40.0, worlds=0)
    body.activate(wc.Activation(TIMES, STRESS), [3, 4, 5], worlds=1)
    sim.advance_steps(33)
    sim.save(tmp_path / "state.npz")
    resumed = wc.Simulation.load(tmp_path / "state.npz")
    for run in (sim, resumed):
        run.advance_steps(30)
    for name in ("displacements", "activation", "reactions"):
        np.testing.assert_array_equal(getattr(body, name).numpy(), getattr(resumed.body, name).numpy())


REFUSED = {
    "isotropic": (
        lambda: wc.SoftBody(MESHES["level 3"](), wc.Isotropic(1.0, 0.3, 1.0), device="cpu").activate(1.0),
        "needs a material with a direction, TransverselyIsotropic, Orthotropic or FibreReinforced; the body's is",
    ),
    "one time": (lambda: wc.Activation([0.0], [1.0]), r"times of shape \(1,\) must be at least two"),
    "times backwards": (lambda: wc.Activation([1.0, 0.0], [1.0, 2.0]), "increasing"),
    "stress of other times": (
        lambda: wc.Activation([0.0, 1.0], [1.0]),
        r"stress has shape \(1,\); it must be finite, \[2\]",
    ),
    "NaN keyframe": (lambda: wc.Activation([0.0, 1.0], [1.0, np.nan]), "must be finite"),
    "words": (lambda: wc.Activation("now", "much"), "must be numbers"),
    "other columns": (
        lambda: fibres().activate(wc.Activation([0.0, 1.0], np.ones((2, 5))), [1, 2]),
        r"stress of an Activation has shape \(2, 5\); there are 2 elements",
    ),
    "other length": (lambda: fibres().activate(np.ones(5)), r"an array of shape \(5,\); it must be a number, \[48\]"),
    "no number": (lambda: fibres().activate("hard"), "stress is 'hard'; it must be a number"),
    "NaN": (lambda: fibres().activate(np.nan), "must be finite"),
    "no element": (lambda: fibres().activate(1.0, [48]), "element 48 is out of range: there are 48"),
    "no world": (lambda: fibres().activate(1.0, worlds=1), "world 1 is out of range: there are 1"),
}


def fibres():
    return wc.SoftBody(MESHES["level 3"](), muscle([0, 0, 1]), device="cpu")


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_refused(case):
    make, message = REFUSED[case]
    with pytest.raises(wc.InputError, match=message):
        make()
