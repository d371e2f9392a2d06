"""Hands in implicit steps: forces that act and react, and a page that a visitor drags on."""

import numpy as np
import pytest
from hands import TOP, block

import warp_corot as wc
from warp_corot.viewing.hands import HANDS, Springs
from warp_corot.viewing.session import Session
from warp_corot.viewing.shown import ELEMENTS, Shown, surfaces_of

EULER, DAMPED = wc.BackwardEuler(dt=1 / 60), wc.BackwardEuler(dt=1 / 60, damping=20.0)


def hand_at(sim, kind, place=TOP):
    shown = Shown(sim.body, surfaces_of(sim.body.mesh)[ELEMENTS])
    return HANDS[kind](Springs(sim, [shown]), shown, shown.pick(0, place), 0.02)


@pytest.mark.parametrize("kind", HANDS)
def test_the_supports_bear_what_the_hand_pulls(kind, device):
    sim = block(device, integrator=DAMPED)
    hand = hand_at(sim, kind)
    hand.move(np.array([0.0, 0.004, 0.003]))
    sim.advance(2.0)
    force = hand.force
    assert np.linalg.norm(force) > 0.02
    np.testing.assert_allclose(sim.body.reactions.numpy().sum(axis=0), -force, atol=2e-3 * np.linalg.norm(force))
    start, end = hand.ends
    assert np.linalg.norm(end - start) < 0.005
    assert sim.solves.linear_iterations / sim.solves.steps < 40


def test_a_body_in_space_has_the_momentum_that_the_hand_gave(device):
    sim = block(device, held=False, integrator=EULER)
    hand = hand_at(sim, "grasp")
    hand.move(np.array([0.0, 0.01, 0.0]))
    given = np.zeros(3)
    for _ in range(6):
        sim.advance_steps(1)
        given += EULER.dt * hand.force
    momentum = sim.body.masses @ sim.body.velocities.numpy()
    assert np.linalg.norm(given) > 1e-4
    np.testing.assert_allclose(momentum, given, atol=5e-3 * np.linalg.norm(given))


def test_a_hand_that_is_far_away_pulls_no_harder_than_its_limit(device):
    sim = block(device, integrator=DAMPED)
    hand = hand_at(sim, "drag")
    hand.move(np.array([0.0, 0.0, 10.0]))
    sim.advance(0.5)
    limit = hand._spring.limit
    assert np.linalg.norm(hand.force) == pytest.approx(limit, rel=1e-3)
    assert sim.solves.unfinished == 0


def test_a_visitor_drags_on_the_page():
    page = Session(block(integrator=DAMPED))
    page.ask(lambda: page.press("me", 0, TOP))
    page.ask(lambda: page.move("me", (0.0, 0.0, 0.004)))
    page.take_commands()
    page.sim.advance(0.5)
    frame = page.frame()
    assert frame.forces["me"][2] > 0.0
    page.ask(lambda: page.let_go("me"))
    page.take_commands()
    page.sim.advance(2.0)
    frame = page.frame()
    assert not frame.forces
    np.testing.assert_allclose(frame.positions[0], page.shown[0].rest, atol=5e-5)


def test_a_page_opens():
    pytest.importorskip("websockets")
    page = wc.view(block(integrator=EULER), port=0, wait=False)
    assert page.sim.integrator is EULER
    page.close()
