"""Blades that cut while they move: what is separated, what it costs, and what is refused."""

import numpy as np
import pytest
import warp as wp
from cut_cases import assert_cut_sound

import warp_corot as wc

TOUGHNESS = 4.0


def block(device, level=6, **options):
    """A bar held at both ends."""
    material = wc.Isotropic(3e4, 0.4, 1000.0, **({"toughness": TOUGHNESS} | options))
    body = wc.SoftBody(wc.TetForest.box((3, 1, 1), 0.04, level), material, device=device)
    body.fix("x == xmin or x == xmax")
    return body


def falling(depth=0.06, *, x=0.061, seconds=0.2, tilt=0.0, **options):
    """A blade that goes down through the middle of a bar."""
    blade = wc.Blade([(0, 0, -0.01), (tilt, 0, 0.05)], position=(x, 0.045, 0), **options)
    blade.follow([0.0, seconds], [(x, 0.045, 0), (x, 0.045 - depth, 0)])
    return blade


def cut(body, blade, seconds=0.2, **options):
    steps = wc.SymplecticEuler(damping=options.pop("damping", 5.0))
    sim = wc.Simulation(body, gravity=(0, 0, 0), cuts=[blade], integrator=options.pop("integrator", steps), **options)
    sim.advance(seconds)
    return sim


def test_a_blade_cuts_through(device):
    body, blade = block(device), falling()
    cut(body, blade)
    assert body.pieces == 2
    assert_cut_sound(body.changing.forest)
    # But for the rim, the area is that of the plane in which the blade moves.
    assert body.cut_area == pytest.approx(0.04**2, rel=0.03)
    np.testing.assert_array_equal(blade.wrench.numpy()[0], 0.0)
    # The same elements are separated as by a plane.
    other = block(device)
    sim = wc.Simulation(other, gravity=(0, 0, 0))
    sim.cut(wc.Plane((1, 0, 0), 0.061))
    assert len(np.unique(np.stack([body.mesh.pieces(), other.mesh.pieces()]), axis=1).T) <= 3


def test_the_force_on_a_blade_is_the_toughness_times_its_length(device):
    body, blade = block(device), falling(0.035, seconds=0.15)
    sim = wc.Simulation(body, gravity=(0, 0, 0), cuts=[blade], integrator=wc.SymplecticEuler(damping=20.0))
    felt = []
    sim.on_step(lambda sim: felt.append(sim.dt * blade.wrench.numpy()[0]) if sim.time > 0.03 else None)
    sim.advance(0.15)
    mean = np.sum(felt, axis=0) / 0.12
    # The last edge of an element is owed.
    assert mean[1] == pytest.approx(TOUGHNESS * 0.04, rel=0.2)
    assert np.abs(mean[[0, 2]]).max() < 0.1 * mean[1]
    # It acts in the middle of the body, and torques are about the blade's origin.
    assert mean[5] == pytest.approx(0.0, abs=1e-3)
    assert mean[3] == pytest.approx(-0.02 * mean[1], rel=0.1)


@pytest.mark.parametrize("seed", range(2))
def test_the_work_of_a_blade_is_that_of_the_cut_and_what_moves(seed, device):
    assert_energy_is_balanced(seed, device)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2, 22))
def test_the_work_of_random_cuts_is_balanced(seed, device):
    assert_energy_is_balanced(seed, device)


def assert_energy_is_balanced(seed, device):
    """A straight blade goes in a random direction to a random depth, through a body without damping."""
    rng = np.random.default_rng(seed)
    body = block(device, level=int(rng.integers(6, 8)))
    way = np.array([0.25 * rng.normal(), -1.0, 0.25 * rng.normal()])
    way /= np.linalg.norm(way)
    edge = np.cross(way, rng.normal(size=3) * [1.0, 0.2, 1.0])
    edge *= 0.09 / np.linalg.norm(edge)
    begin = np.array([0.06, 0.02, 0.02]) + rng.normal(size=3) * [0.012, 0.004, 0.004] - 0.04 * way
    blade = wc.Blade([-edge, edge], position=begin)
    blade.follow([0.0, 0.2], [begin, begin + rng.uniform(0.05, 0.1) * way])
    sim = cut(body, blade, damping=0.0)
    energy, (edges,) = sim.energy(), sim.blades.of_bodies
    # What the edge owes for the last row of elements that it has cut.
    owed = edges.surface.debt.numpy().sum()
    assert 0.0 < owed < 0.25 * TOUGHNESS * body.cut_area
    cost = TOUGHNESS * body.cut_area + energy.elastic + energy.kinetic
    assert blade.work + owed == pytest.approx(cost, rel=0.02)


def test_a_cut_that_stops_halfway_opens_under_load(device):
    body, blade = block(device, toughness=0.0), falling(0.025)
    body.release("x == xmax")
    sim = cut(body, blade)
    assert body.pieces == 1
    assert 0.3 < body.cut_area / 0.04**2 < 0.7
    points = body.mesh.points
    body.load(points[:, 0] > 0.12 - 1e-9, [0.0, -0.002, 0.0])
    doubled = [np.flatnonzero((points == p).all(axis=1)) for p in points[np.abs(points[:, 0] - 0.06) < 0.011]]
    lips = [pair for pair in doubled if len(pair) == 2 and points[pair[0], 1] > 0.039]
    sim.advance(0.2)
    x = body.positions.numpy()
    gaps = [np.linalg.norm(x[a] - x[b]) for a, b in lips]
    assert len(lips)
    assert min(gaps) > 1e-4


def test_elements_at_the_blade_are_refined(device):
    body, blade = block(device), falling(level=9)
    cut(body, blade)
    assert body.pieces == 2
    mesh = assert_cut_sound(body.changing.forest)
    centre = mesh.points[mesh.tets].mean(axis=1)
    assert mesh.levels[np.abs(centre[:, 0] - 0.061) < 0.002].min() >= 8
    assert mesh.levels[np.abs(centre[:, 0] - 0.061) > 0.04].max() == 6


def test_a_slanted_blade_cuts_without_gaps(device):
    body, blade = block(device, toughness=0.0), falling(tilt=0.015, x=0.055)
    cut(body, blade)
    assert body.pieces == 2
    assert_cut_sound(body.changing.forest)


def test_a_body_that_moves_through_a_blade_is_cut(device):
    body = block(device, toughness=0.0)
    blade = wc.Blade([(0, 0, -0.01), (0, 0, 0.05)], position=(0.061, 0.045, 0))
    body.prescribe("x == xmin or x == xmax", times=[0.0, 0.2], displacements=[[0, 0, 0], [0, 0.055, 0]])
    cut(body, blade)
    assert body.pieces == 2


def test_a_blade_that_touches_nothing_cuts_nothing(device):
    body = block(device)
    beside = falling(x=0.2)
    still = wc.Blade([(0, 0, -0.01), (0, 0, 0.05)], position=(0.06, 0.02, 0))
    sim = wc.Simulation(body, gravity=(0, 0, 0), cuts=[beside, still])
    sim.advance(0.2)
    assert body.cut_area == 0.0
    assert beside.work == still.work == 0.0


def test_a_blade_is_moved_by_hand(device):
    body = block(device)
    blade = wc.Blade([(0, 0, -0.01), (0, 0, 0.05)], position=(0.061, 0.045, 0), speed=0.3)
    sim = wc.Simulation(body, gravity=(0, 0, 0), cuts=blade)
    blade.move((0.061, -0.015, 0))
    sim.advance(0.1)
    assert 0.0 < body.cut_area < 0.04**2
    sim.advance(0.2)
    assert body.pieces == 2


@pytest.mark.parametrize(
    "way", [*(pytest.param(way, marks=pytest.mark.slow) for way in ("follow", "move")), "use_poses"]
)
def test_a_handle_and_an_edge_are_one_scalpel(way, device):
    """A tool and a blade that are given the same motion: the edge cuts, and the handle presses what it meets."""
    body = block(device, toughness=0.5)
    upright = (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))  # their z axis is along y
    handle = wc.Tool(wc.Capsule(radius=0.004, length=0.04), speed=0.5)
    blade = wc.Blade([(0, 0, -0.024), (0, 0, -0.075)], speed=0.5)
    before, behind, down = (0.061, 0.067, -0.02), (0.061, 0.067, 0.06), (0.061, 0.061, 0.02)
    poses = wp.zeros(1, dtype=wp.transform, device=device)

    def move(place):
        for each in (handle, blade):
            each.move(place, upright)

    move(before)
    poses.assign(np.float32([[*before, *upright]]))
    sim = wc.Simulation(body, gravity=(0, 0, 0), obstacles=[handle], cuts=[blade])
    for each in (handle, blade):
        if way == "follow":
            each.follow([0.0, 0.2, 0.4], [before, behind, down], upright)
        elif way == "use_poses":
            each.use_poses(poses)
    for time, place, pieces in ((0.2, behind, 2), (0.4, down, 2)):
        if way == "move":
            move(place)
        poses.assign(np.float32([[*place, *upright]]))
        sim.advance_until(time)
        np.testing.assert_allclose(handle.present_pose, blade.present_pose, atol=1e-6)
        np.testing.assert_allclose(handle.present_pose[0, :3], place, atol=1e-4)
        assert body.pieces == pieces
    assert handle.wrench.numpy()[0][1] > 1e-3
    assert blade.work > 0.0


def test_reset_heals_and_begins_again(device):
    body, blade = block(device), falling()
    sim = cut(body, blade)
    area, work, nodes = body.cut_area, blade.work, body.node_count
    sim.reset()
    assert body.pieces == 1
    assert blade.work == 0.0
    sim.advance(0.2)
    assert (body.cut_area, body.node_count) == pytest.approx((area, nodes), rel=0.05)
    assert blade.work == pytest.approx(work, rel=0.05)


@pytest.mark.parametrize("level", [None, 7])
def test_checkpoints_go_on_with_the_cut(level, device, tmp_path):
    body, blade = block(device), falling(level=level)
    sim = cut(body, blade, 0.1)
    assert 0.0 < body.cut_area < 0.04**2
    sim.save(tmp_path / "half.npz")
    again = wc.Simulation.load(tmp_path / "half.npz", device=device)
    (other,) = again.blades.blades
    for each in (sim, again):
        each.advance(0.1)
    assert again.body.pieces == body.pieces == 2
    assert again.body.cut_area == pytest.approx(body.cut_area)
    x, y = (each.positions.numpy() for each in (again.body, body))
    if body.device.is_cpu:
        assert other.work == pytest.approx(blade.work)
        np.testing.assert_allclose(x, y, atol=1e-7)
    else:  # nodes are copied, and forces summed, in any order: the numbers of copies differ, and digits of the work
        assert other.work == pytest.approx(blade.work, rel=0.01)
        np.testing.assert_allclose(np.sort(x, axis=0), np.sort(y, axis=0), atol=2e-4)
    again.reset()
    assert again.body.pieces == 1


def test_checkpoints_of_bodies_that_are_only_cut_are_not_remeshed(device, tmp_path):
    body = block(device)
    sim = wc.Simulation(body, gravity=(0, -50, 0))
    sim.cut(wc.Plane((1, 0, 0), 0.061))
    sim.save(tmp_path / "cut.npz")
    again = wc.Simulation.load(tmp_path / "cut.npz", device=device)
    assert again.remesh == (None,)
    for each in (sim, again):
        each.advance(0.05)
    np.testing.assert_allclose(again.body.positions.numpy(), body.positions.numpy(), atol=1e-7)
    assert again.cut(wc.Plane((1, 0, 0), 0.03)) > 0.0


def test_implicit_steps_are_cut(device):
    body, blade = block(device), falling()
    cut(body, blade, integrator=wc.BackwardEuler(dt=0.004))
    assert body.pieces == 2
    assert_cut_sound(body.changing.forest)
    assert blade.work == pytest.approx(TOUGHNESS * body.cut_area, rel=0.2)


def test_bad_blades_are_refused_in_one_line(device):
    for edge, said in [
        ([(0, 0, 0)], "at least two"),
        ([(0, 0, 0), (0, 0, 0)], "two equal points"),
        ([(0, 0, 0), (0, np.nan, 0)], "finite"),
        ("abc", "must be numbers"),
    ]:
        with pytest.raises(wc.InputError, match=said):
            wc.Blade(edge)
    blade = wc.Blade([(0, 0, 0), (0, 0, 0.04)])
    with pytest.raises(wc.InputError, match="positions has shape"):
        blade.follow([0, 1], [(0, 0, 0)])
    with pytest.raises(wc.InputError, match="no simulation has this tool"):
        _ = blade.wrench
    for cuts in (3, [wc.Ground()]):
        with pytest.raises(wc.InputError, match="a cut is"):
            wc.Simulation(block(device), cuts=cuts)
    with pytest.raises(wc.InputError, match="given twice"):
        wc.Simulation(block(device), cuts=[blade, blade])
    with pytest.raises(wc.InputError, match=r"edge is 1e\+09 m long"):
        wc.Simulation(block(device), cuts=[wc.Blade([(0, 0, 0), (0, 0, 1e9)])])
    fast = falling(seconds=0.001)
    with pytest.raises(wc.InputError, match=r"a blade goes .* mm in a step"):
        wc.Simulation(block(device), cuts=[fast])
    sim = wc.Simulation(block(device), gravity=(0, 0, 0), cuts=[blade])
    blade.follow([0.0, 1.0], [(0, 0, 0), (0, 0, 0.01)])
    with pytest.raises(wc.InputError, match=r"a blade goes .* mm in a step"):
        blade.follow([0.0, 0.001], [(0, 0, 0), (0, 0.06, 0)])
    with pytest.raises(wc.InputError, match="finite"):
        blade.follow([0.0, 1.0], [(0, 0, 0), (0, np.nan, 0)])
    sim.advance(0.5)  # along the last good path
    np.testing.assert_allclose(blade.present_pose[0, :3], [0, 0, 0.005], atol=1e-3)
    with pytest.raises(wc.InputError, match="two simulations"):
        wc.Simulation(block(device), cuts=[blade])
    with pytest.raises(wc.InputError, match="toughness is -1"):
        wc.Isotropic(1e4, 0.3, 1000.0, toughness=-1.0)
