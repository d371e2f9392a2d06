"""The springs of hands: forces that act and react, work that is counted, at the cost of their patches."""

import numpy as np
import pytest
import warp as wp
from hands import TOP, block

import warp_corot as wc
from warp_corot.viewing.hands import HANDS, HARDEST, MOST_HANDS, MOST_POINTS, DragHand, Springs, patch_around
from warp_corot.viewing.shown import ELEMENTS, Shown, surfaces_of

EULER = wc.BackwardEuler(dt=1 / 60)
#: Options of blocks.
FREE, DAMPED = {"damping": 0.0, "dt": 1e-3}, {"integrator": wc.BackwardEuler(dt=1 / 60, damping=20.0)}


def under_hands(sim):
    shown = [Shown(body, surfaces_of(body.mesh)[ELEMENTS]) for body in sim.bodies]
    return Springs(sim, shown), shown[0]


class Stiff(DragHand):
    """A spring as stiff as with the longest step, whatever the step is."""

    def __init__(self, springs, shown, pick, radius):
        dt = springs.sim.dt
        super().__init__(springs, shown, pick, radius, strength=(dt / 4e-3) ** 2)


def hand_at(sim, kind=DragHand, radius=0.02, place=TOP):
    springs, shown = under_hands(sim)
    return kind(springs, shown, shown.pick(0, place), radius)


@pytest.mark.parametrize("steps", [{}, DAMPED], ids=["explicit", "implicit"])
@pytest.mark.parametrize("kind", HANDS)
def test_the_supports_bear_what_the_hand_pulls(kind, steps, device):
    sim = block(device, **steps)
    hand = hand_at(sim, HANDS[kind])
    hand.move(np.array([0.0, 0.004, 0.003]))
    sim.advance(2.0)
    force = hand.force
    assert np.linalg.norm(force) > 0.02
    np.testing.assert_allclose(sim.body.reactions.numpy().sum(axis=0), -force, atol=2e-3 * np.linalg.norm(force))
    start, end = hand.ends
    assert not steps or np.linalg.norm(end - start) < 0.005
    assert not steps or sim.solves.linear_iterations / sim.solves.steps < 40


@pytest.mark.parametrize(
    ("kind", "count", "off", "steps"),
    [("drag", 50, 1e-3, FREE), ("grasp", 50, 1e-3, FREE), ("grasp", 6, 5e-3, {"integrator": EULER})],
)
def test_a_body_in_space_has_the_momentum_that_the_hand_gave(kind, count, off, steps, device):
    sim = block(device, held=False, **steps)
    hand = hand_at(sim, HANDS[kind])
    hand.move(np.array([0.0, 0.01, 0.0]))
    given = np.zeros(3)
    for _ in range(count):
        sim.advance_steps(1)
        given += sim.dt * hand.force
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    assert np.linalg.norm(given) > 1e-4
    np.testing.assert_allclose(momentum, given, atol=off * np.linalg.norm(given))


def test_nothing_but_the_patch_is_pulled(device):
    sim = block(device, level=9, held=False, damping=0.0)
    hand = hand_at(sim)
    hand.move(np.array([0.0, 0.0, 0.01]))
    sim.step()  # elastic forces have carried it no farther yet
    moved = np.linalg.norm(sim.body.velocities.numpy(), axis=1) > 0.0
    assert 3 < moved.sum() < 30
    assert np.linalg.norm(sim.body.mesh.points[moved] - TOP, axis=1).max() < 0.02


def test_the_work_of_the_hand_is_the_energy_of_the_body(device):
    """Without damping, kinetic and elastic energy equal the work of the spring, also at the ends of runs."""
    found = []
    for dt in (8e-4, 2e-4):  # velocities are half a step behind displacements
        sim = block(device, damping=0.0, dt=dt)
        hand = hand_at(sim, Stiff, radius=0.03)
        hand.move(np.array([0.0, 0.003, 0.002]))
        for _ in range(20):
            sim.advance(0.0048)
        work, energy = sum(float(each.numpy()[0].sum()) for each in sim.system.accounts), sim.energy()
        assert work > 1e-5
        found.append(abs(energy.kinetic + energy.elastic - work) / work)
    assert found[1] < 0.01
    assert found[1] < 0.5 * found[0]


def test_a_sudden_pull_from_rest_is_no_error(device, recwarn):
    sim = block(device, damping=0.0)
    hand = hand_at(sim)
    hand.move(np.array([0.0, 0.02, 0.01]))
    for _ in range(30):
        sim.advance(0.004)
    assert not [w for w in recwarn if issubclass(w.category, wc.StabilityWarning)]


def test_pulling_to_and_fro_is_no_fault(device, recwarn):
    sim = block(device, damping=1.0)
    hand = hand_at(sim, radius=0.03)
    for k in range(60):
        hand.move(0.05 * np.array([0.0, np.sin(0.9 * k), np.cos(0.7 * k)]))
        sim.advance(0.02)
    assert not [w for w in recwarn if issubclass(w.category, wc.StabilityWarning)]
    assert np.abs(sim.body.displacements.numpy()).max() < 0.1


@pytest.mark.parametrize(("steps", "time"), [({}, 0.05), (DAMPED, 0.5)], ids=["explicit", "implicit"])
def test_the_force_has_a_limit(steps, time, device):
    sim = block(device, **steps)
    hand = hand_at(sim)
    hand.move(np.array([0.0, 0.0, 10.0]))
    sim.advance(time)
    limit = HARDEST * 5e3 * hand.patch.area
    assert np.linalg.norm(hand.force) == pytest.approx(limit, rel=1e-3)
    assert not steps or sim.solves.unfinished == 0


def test_a_hand_that_lets_go_pulls_no_more(device):
    sim = block(device)
    hand = hand_at(sim)
    hand.move(np.array([0.0, 0.005, 0.0]))
    sim.advance(0.2)
    assert np.linalg.norm(hand.force) > 0.0
    hand.release()
    hand.release()
    sim.advance(3.0)
    assert np.linalg.norm(hand.force) == 0.0
    assert np.abs(sim.body.displacements.numpy()).max() < 5e-5


def test_recorded_steps_take_up_hands_and_leave_them(device):
    """A hand after many recorded steps pulls in the next one, and the same steps serve all later hands."""
    sim = block(device)
    sim.advance(0.2)
    springs, shown = under_hands(sim)
    hand = DragHand(springs, shown, shown.pick(0, TOP), 0.02)
    revision = sim.system.launch_revision
    hand.move(np.array([0.0, 0.005, 0.0]))
    sim.advance(0.1)
    assert np.linalg.norm(hand.force) > 0.0
    hand.release()
    second = DragHand(springs, shown, shown.pick(0, (0.1, 0.05, 0.1)), 0.02)
    second.move(np.array([0.005, 0.0, 0.0]))
    sim.advance(0.1)
    assert np.linalg.norm(second.force) > 0.0
    assert sim.system.launch_revision == revision
    springs.close()
    assert sim.system.forces == []
    sim.advance(3.0)
    assert np.abs(sim.body.displacements.numpy()).max() < 5e-5


def test_the_number_of_hands_is_limited():
    sim = block()
    springs, shown = under_hands(sim)
    pick = shown.pick(0, TOP)
    hands = [DragHand(springs, shown, pick, 0.02) for _ in range(MOST_HANDS)]
    with pytest.raises(LookupError, match="8 hands hold the body already"):
        DragHand(springs, shown, pick, 0.02)
    hands[3].release()
    DragHand(springs, shown, pick, 0.02)


def test_a_patch_is_near_and_limited():
    sim = block(level=9)
    _, shown = under_hands(sim)
    pick = shown.pick(0, TOP + np.array([0.001, 0.002, 0.0]))
    point = patch_around(shown, pick, 0.0)
    assert set(point.points) == set(shown.triangles[pick.triangle])
    np.testing.assert_allclose(point.shares @ shown.rest[point.points], TOP + np.array([0.001, 0.002, 0.0]), atol=1e-6)
    large = patch_around(shown, pick, 10.0)
    assert len(large.points) <= MOST_POINTS
    assert large.shares.sum() == pytest.approx(1.0)
    assert large.area == pytest.approx(10 * 0.1**2)


def test_a_hand_goes_along_with_a_mesh_that_changes(device):
    refined = wc.OnlineRemesh(refine_above=1.02, simplify_below=1.005, every=5)
    if device != "cpu" and not wp.is_conditional_graph_supported():
        pytest.skip("remeshing needs conditional graphs")
    sim = block(device, remesh=refined)
    hand = hand_at(sim, radius=0.03)
    hand.move(np.array([0.0, 0.0, 0.03]))
    before = sim.body.element_count
    sim.advance(0.5)
    assert sim.body.element_count > before
    start, end = hand.ends
    assert 0.2 < start[2] < end[2]
    force = hand.force
    assert force[2] > 0.05
    stiffness = hand.stiffness
    hand.fit()
    assert hand.stiffness != stiffness
