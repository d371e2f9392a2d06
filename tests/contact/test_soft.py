"""Soft bodies against one another and against themselves."""

import numpy as np
import pytest
from soft_surfaces import DOWN, block, force_on, horseshoe, roof, weight

import warp_corot as wc

CALM = wc.SymplecticEuler(viscosity=1e-3)


@pytest.mark.parametrize("alike", [True, False], ids=["alike", "unlike"])
def test_a_block_on_a_block_carries_its_weight(device, alike):
    """To 0.1 %, with equal and unequal meshes; the forces on both are opposite, to rounding."""
    low = block(device, 0.0)
    high = block(device, 0.0202) if alike else block(device, 0.0202, cells=(1, 1, 1), level=4, at=0.011)
    ground = wc.Ground()
    sim = wc.Simulation([low, high], obstacles=ground, gravity=DOWN, integrator=CALM)
    sim.advance(0.6)
    assert force_on(high)[2] == pytest.approx(weight(high), rel=1e-3)
    on_ground = ground.wrench.numpy()[0].astype(float)[:3]
    assert on_ground[2] == pytest.approx(-weight(high) - weight(low), rel=1e-3)
    np.testing.assert_allclose(force_on(low) + force_on(high) + on_ground, 0.0, atol=1e-6 * weight(low))


SLIDES = wc.SymplecticEuler(viscosity=2e-3)


@pytest.mark.parametrize("seconds", [1.0, pytest.param(120.0, marks=pytest.mark.slow)])
def test_a_soft_block_rests_on_a_soft_slope(device, seconds):
    """At 0.95 of the angle of friction, on a mesh that differs from its own."""
    angle = 0.95 * np.arctan(0.4)
    low, high = block(device, 0.0), block(device, 0.0200005, cells=(1, 1, 1), at=0.0107)
    low.fix("z == zmin")
    sim = wc.Simulation(
        [low, high],
        contact=wc.Contact(friction=0.4),
        gravity=(9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle)),
        integrator=wc.SymplecticEuler(viscosity=2e-3, damping=2.0),
    )
    sim.advance(0.6)
    before = high.positions.numpy().astype(float)
    sim.advance(seconds)
    assert np.abs(high.positions.numpy() - before).max() < 1e-6
    along = force_on(high)[0] / force_on(high)[2]
    assert along == pytest.approx(-np.tan(angle), rel=1e-3)


@pytest.mark.parametrize("integrator", [SLIDES, wc.BackwardEuler(dt=0.01)], ids=["explicit", "implicit"])
@pytest.mark.parametrize("share", [0.98, 1.05])
def test_a_soft_block_slips_on_a_soft_slope(device, integrator, share):
    """No node of the slope catches on the rims of the block, whose elements are as large but set off."""
    friction = 0.5
    angle = share * np.arctan(friction)
    gravity = 9.81 * np.array([np.sin(angle), 0.0, -np.cos(angle)])
    low = block(device, -0.0201, cells=(8, 3, 1), at=-0.01)
    high = block(device, 0.0, at=0.0047)
    low.fix("z == zmin")
    sim = wc.Simulation([low, high], contact=wc.Contact(friction=friction), gravity=gravity, integrator=integrator)
    shares = high.masses / high.masses.sum()
    sim.advance(0.4)
    began = shares @ high.velocities.numpy()[:, 0].astype(float)
    sim.advance(0.2)
    gained = shares @ high.velocities.numpy()[:, 0].astype(float) - began
    expected = max(gravity[0] + friction * gravity[2], 0.0)
    assert gained / 0.2 == pytest.approx(expected, abs=0.003 * 9.81)


def test_worlds_do_not_meet(device):
    """Blocks of several worlds are in the same place."""
    low, high = block(device, 0.0, worlds=2), block(device, 0.0202, worlds=2)
    lifted = high.positions.numpy()
    lifted[high.world_node_count :, 2] += 0.1
    high.positions = lifted
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=(0.0, 0.0, 0.0), integrator=CALM)
    high.velocities = np.tile((0.0, 0.0, -0.1), (high.node_count, 1))
    sim.advance(0.01)
    forces = high.contact_forces.numpy().reshape(2, -1, 3)
    assert forces[0, :, 2].sum() > 0.0
    assert not forces[1].any()


@pytest.mark.parametrize("speed", [0.2, 3.0])
def test_an_edge_does_not_pass_an_edge(device, speed):
    """Two beams on their edges cross where neither has a node; waves travel at 8 m/s."""
    low = roof(device, 0, 0.0)
    top = np.sqrt(2.0) * 0.01
    high = roof(device, 1, top + 0.0005)
    moved = high.positions.numpy()
    moved[:, :2] += 0.0017
    high.positions = moved
    low.fix("z < zmin + 0.003")
    high.velocities = np.tile((0.0, 0.0, -speed), (high.node_count, 1))
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=(0.0, 0.0, 0.0))
    start = sim.energy().total
    edges, touched = 0, 0.0
    for _ in range(20):
        sim.advance(0.0005)
        edges += sum(len(point.nodes) == 2 for point in sim.contacts())
        touched = max(touched, force_on(high)[2])
        np.testing.assert_allclose(force_on(low) + force_on(high), 0.0, atol=1e-5 * (touched + 1e-3))
        assert sim.energy().total <= 1.01 * start  # velocities are half a step behind
    assert touched > 0.0
    assert edges > 0
    # It has not fallen through: where they cross, the upper one is above the lower one.
    crossing = [
        np.linalg.norm((each.mesh.points - each.mesh.points.mean(axis=0)), axis=1) < 0.006 for each in (low, high)
    ]
    heights = [each.positions.numpy()[near, 2].mean() for each, near in zip((low, high), crossing, strict=True)]
    assert heights[1] - heights[0] > 0.5 * top


@pytest.mark.parametrize("itself", [True, False])
def test_a_folded_body_touches_itself(device, itself):
    """The arms of a horseshoe are bent together by more than the gap between them; without contact they would cross."""
    body = horseshoe(device)
    x = body.mesh.points
    arms = [np.flatnonzero((np.abs(x[:, 0] - side) < 1e-6) & (x[:, 2] > 0.03)) for side in (0.0, 0.05)]
    for nodes, sign in zip(arms, (1.0, -1.0), strict=True):
        body.prescribe(nodes, times=[0.0, 0.1], displacements=[(0, 0, 0), (sign * 0.007, 0, 0)])
    sim = wc.Simulation(body, contact=wc.Contact(self_contact=itself), gravity=(0.0, 0.0, 0.0), integrator=CALM)
    sim.advance(0.12)
    now = body.positions.numpy().astype(float)
    left = np.flatnonzero((np.abs(x[:, 0] - 0.02) < 1e-6) & (x[:, 2] > 0.015))
    right = np.flatnonzero((np.abs(x[:, 0] - 0.03) < 1e-6) & (x[:, 2] > 0.015))
    crossing = now[left, 0].max() - now[right, 0].min()
    if itself:
        assert crossing < 1e-5
        np.testing.assert_allclose(force_on(body), 0.0, atol=1e-5)
        assert np.abs(body.contact_forces.numpy()).max() > 1e-3
    else:
        assert crossing > 1e-3


def test_room_for_contacts_grows(device):
    """If there is too little room for the contacts, none is left out: the run is repeated with more room."""
    low, high = block(device, 0.0), block(device, 0.0202)
    ground = wc.Ground()
    sim = wc.Simulation([low, high], obstacles=ground, gravity=DOWN, integrator=CALM)
    sim.contact.pairs._make_room(3)
    sim.advance(0.1)
    assert sim.contact.pairs._room > 3
    assert 0 < sim.contact.search.pairs <= sim.contact.pairs.room
    assert high.positions.numpy()[:, 2].min() > 0.019


def test_more_contacts_than_memory_end_the_run_at_the_last_good_state(device, monkeypatch):
    low, high = block(device, 0.0), block(device, 0.0202)
    sim = wc.Simulation([low, high], contact=wc.Contact(), gravity=DOWN, integrator=CALM)
    sim.advance(0.001)
    sim.contact.pairs._make_room(3)
    before = high.positions.numpy()

    def refuse(room):
        raise RuntimeError(f"Failed to allocate {room} bytes")

    monkeypatch.setattr(sim.contact.pairs, "_rows_for", refuse)
    with pytest.raises(wc.UnstableError, match=r"^\d+ pairs of soft surfaces .* no memory .* larger where"):
        sim.advance(0.1)
    np.testing.assert_array_equal(high.positions.numpy(), before)
    monkeypatch.undo()
    sim.advance(0.01)


@pytest.mark.parametrize("speed", [0.2, 4.0])
def test_pairs_left_out_of_a_step_would_not_have_pushed(device, speed):
    """A block hits another one: they move as with all pairs in every round."""
    moved, live = [], []
    for closing in (None, 1e6):
        low, high = block(device, 0.0), block(device, 0.0204, at=0.003)
        velocities = high.velocities.numpy()
        velocities[:, 2] = -speed
        high.velocities.assign(velocities)
        integrator = wc.SymplecticEuler(dt=1e-4, viscosity=5e-4)
        # Rounding in another order would spread.
        given = {"gravity": (0, 0, 0), "contact": wc.Contact(), "deterministic": True}
        sim = wc.Simulation([low, high], integrator=integrator, **given)
        if closing is not None:
            sim.contact.law.closing = closing
        counts = []
        for _ in range(10):
            sim.advance_steps(10)
            counts.append(int(sim.contact.split.sums.live_count.numpy()[1]))
        moved.append(np.concatenate([each.displacements.numpy() for each in sim.bodies]))
        live.append(sum(counts))
    assert sim.bodies[0].velocities.numpy()[:, 2].mean() < -0.01 * speed
    # A slow block meets all pairs that were found for it.
    assert 0 < live[0] < live[1] + (speed < 1.0)
    np.testing.assert_allclose(*moved, rtol=0.0, atol=1e-5 * np.abs(moved[1]).max())


@pytest.mark.parametrize("integrator", [None, wc.BackwardEuler(dt=0.002)], ids=["explicit", "implicit"])
def test_a_bar_at_the_rim_of_a_block_is_not_pushed_aside(device, integrator):
    """It overlaps the top of the block by 0.5 mm. Its far side is 18 mm behind the block's side, but on top of it."""
    mesh = wc.TetForest.box((1, 1, 1), 0.1, level=0, up_axis="Z")
    bar = wc.TetMesh(mesh.points * [1.0, 0.15, 0.15] + [0.05, 0.003, 0.0995], mesh.tets, up_axis="Z")
    tissue = wc.Isotropic(young=1e5, poisson=0.3, density=1000.0)
    low, high = wc.SoftBody(mesh, tissue, device=device), wc.SoftBody(bar, tissue, device=device)
    low.fix("z < 0.001")
    sim = wc.Simulation([low, high], gravity=(0.0, 0.0, -9.81), contact=wc.Contact(friction=0.0), integrator=integrator)
    for _ in range(10):
        sim.advance_steps(1)
        pushed = high.contact_forces.numpy().sum(axis=0)
        assert np.abs(pushed[:2]).max() < 2e-3
    sim.advance(0.05)
    assert abs(high.masses @ high.velocities.numpy()[:, 1]) < 0.005 * high.masses.sum()
    assert high.positions.numpy()[:, 2].min() > 0.09
