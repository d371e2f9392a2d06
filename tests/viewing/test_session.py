"""A session without a browser: commands between advances, hands, switches, and time."""

import threading
import time

import numpy as np
import pytest
from hands import TOP, block, session

import warp_corot as wc
from warp_corot.viewing.session import RealTimeFactor, Session
from warp_corot.viewing.shown import ELEMENTS, INPUT, MARCHED, Plane

UP = np.array([0.0, 0.0, 0.004])


def ticks(of, count):
    for _ in range(count):
        of.advance()
        frame = of.frame()
    return frame


def still(of, seconds):
    """A frame after this much simulated time, whatever the wall clock says."""
    of.take_commands()
    of.sim.advance(seconds)
    return of.frame()


def test_a_drag_moves_tissue_and_tells_its_force(device):
    page = session(device)
    frame = ticks(page, 1)
    here = frame.positions[0][np.linalg.norm(frame.positions[0] - TOP, axis=1).argmin()]
    page.ask(lambda: page.press("me", 0, here))
    page.ask(lambda: page.move("me", UP))
    frame = still(page, 0.5)
    assert frame.forces["me"][2] > 0.0
    start, end = frame.ends["me"]
    assert TOP[2] < start[2] < end[2] < TOP[2] + 0.0041
    top = np.linalg.norm(page.shown[0].rest - TOP, axis=1).argmin()
    assert frame.positions[0][top, 2] > TOP[2] + 1e-4
    page.ask(lambda: page.let_go("me"))
    frame = still(page, 3.0)
    assert not frame.forces
    np.testing.assert_allclose(frame.positions[0], page.shown[0].rest, atol=5e-5)


def test_two_visitors_hold_the_body_at_the_same_time():
    page = session()
    page.ask(lambda: page.press(1, 0, TOP))
    page.ask(lambda: page.press(2, 0, (0.1, 0.05, 0.1)))
    page.ask(lambda: page.move(1, UP))
    page.ask(lambda: page.move(2, (0.003, 0.0, 0.0)))
    frame = still(page, 0.5)
    assert frame.forces[1][2] > 0.0
    assert frame.forces[2][0] > 0.0
    page.ask(lambda: page.let_go(1))
    assert set(still(page, 0.1).forces) == {2}


def test_commands_about_nothing_do_no_harm():
    page = session()
    for command in (lambda: page.move(1, UP), lambda: page.let_go(1), page.release_all):
        page.ask(command)
    page.ask(lambda: page.press(1, 0, TOP))
    page.ask(lambda: page.move(1, (np.nan, 0.0, 0.0)))
    frame = still(page, 0.1)
    assert np.isfinite(frame.forces[1]).all()
    assert page.note == ""


def test_commands_come_from_other_threads_in_their_order():
    page, done = session(), []
    threads = [
        threading.Thread(target=lambda k=k: [page.ask(lambda n=n: done.append((k, n))) for n in range(100)])
        for k in range(4)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert done == []
    page.take_commands()
    for k in range(4):
        assert [n for thread, n in done if thread == k] == list(range(100))


def test_what_is_grasped_stays_and_can_be_moved_on():
    page = session()
    page.ask(lambda: page.change(hand="grasp"))
    page.ask(lambda: page.press(1, 0, TOP))
    page.ask(lambda: page.move(1, UP))
    page.ask(lambda: page.let_go(1))
    frame = still(page, 0.5)
    (force,) = frame.forces.values()
    assert force[2] > 0.0
    page.ask(lambda: page.press(2, 0, frame.positions[0][np.linalg.norm(page.shown[0].rest - TOP, axis=1).argmin()]))
    page.ask(lambda: page.move(2, UP))
    frame = still(page, 0.5)
    assert len(frame.forces) == 1
    assert frame.forces[2][2] == pytest.approx(2.0 * force[2], rel=0.1)
    page.ask(page.release_all)
    assert not still(page, 0.1).forces


def test_a_press_goes_into_the_body_whichever_way_the_mouse_goes():
    for motion in ((0.004, 0.0, 0.0), (0.0, 0.0, 0.004)):
        page = session()
        page.change(hand="press")
        page.press(1, 0, TOP)
        page.move(1, motion)
        force = still(page, 0.5).forces[1]
        assert force[2] < 0.0
        assert abs(force[2]) > 10.0 * np.linalg.norm(force[:2])


def test_time_stands_still_and_goes_step_by_step():
    page = session()
    page.change(running=False)
    before = page.sim.total_steps
    ticks(page, 3)
    assert page.sim.total_steps == before
    page.ask(page.step)
    page.ask(page.step)
    ticks(page, 2)
    assert page.sim.total_steps == before + 2


def test_reset_goes_back_to_the_beginning():
    page = session()
    page.press(1, 0, TOP)
    page.move(1, UP)
    ticks(page, 5)
    page.ask(page.reset)
    page.ask(lambda: page.change(running=False))
    frame = ticks(page, 1)
    assert frame.time == 0.0
    assert not frame.forces
    np.testing.assert_allclose(frame.positions[0], page.shown[0].rest, atol=1e-7)


@pytest.mark.parametrize(
    ("rate", "speed", "reading", "expected"),
    [(3.0, 1.0, 0.002, 1.0), (3.0, 0.25, 0.002, 0.25), (0.1, 1.0, 0.002, 0.1), (1.2, 1.0, 0.010, 0.84)],
)
def test_time_runs_as_requested_or_as_fast_as_it_can(rate, speed, reading, expected, monkeypatch):
    """On a clock of the test: steps take their time at ``rate``, frames are read, and the page waits for the next one.
    The last case has no time to wait: it steps for the rest of each period."""
    clock, pace, period, due = 100.0, RealTimeFactor(), 1 / 30, 100.0
    monkeypatch.setattr("warp_corot.viewing.session.time.perf_counter", lambda: clock)
    simulated = 0.0
    for frame in range(600):
        wanted = pace.wanted(speed, period)
        hiccup = 0.05 if frame % 20 == 10 and expected == speed else 0.0  # something else needs the processor
        clock += wanted / rate + hiccup
        pace.took(wanted, wanted / rate + hiccup)
        clock += reading
        pace.showed(reading)
        simulated += wanted
        due = max(due + period, clock)
        clock = due
    assert simulated / (clock - 100.0) == pytest.approx(expected, rel=0.1)
    assert pace.is_slow(speed) == (expected < 0.9 * speed)


def test_slowed_down_it_goes_slower():
    page = session()
    page.change(speed=0.01)
    page.advance()
    started, before = time.perf_counter(), page.sim.time
    for _ in range(20):
        page.advance()
        time.sleep(0.005)
    assert 0.0 < page.sim.time - before < 0.02 * (time.perf_counter() - started)


@pytest.mark.parametrize("colors", ["stress", "displacement", "level", ""])
def test_colours(colors):
    page = session()
    page.change(colors=colors)
    page.press(1, 0, TOP)
    page.move(1, UP)
    frame = still(page, 0.3)
    if colors:
        kinds = len(np.unique(frame.shades[0]))
        assert len(frame.shades[0]) == len(frame.positions[0])
        assert kinds == 1 if colors == "level" else kinds > 5
    else:
        assert frame.shades == [None]
    assert frame.highest == {"level": 6.0, "": 0.0}.get(colors, frame.highest)


@pytest.mark.parametrize(("colors", "least"), [("stress", 0.01 * 5e3), ("displacement", 1e-3 * 0.2)])
def test_colours_of_nothing_but_rounding_are_the_first_one(colors, least):
    page = session()
    page.change(colors=colors)
    page.press(1, 0, TOP)
    page.move(1, UP)
    assert still(page, 0.3).highest > least
    page.reset()
    page.sim.advance(0.01)
    frame = page.frame()
    assert least <= frame.highest <= 3.0 * least  # a range that is a little too wide stays
    assert frame.shades[0].max() == 0


def test_levels_are_no_colours_without_a_tree():
    forest = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.1, level=3)
    body = wc.SoftBody(wc.TetMesh(forest.points, forest.tets), wc.Isotropic(5e3, 0.4, 1000.0), device="cpu")
    page = Session(wc.Simulation(body))
    assert not page.sources["level"].applies(body)
    page.change(colors="level")
    ticks(page, 1)


def test_a_cut_shows_what_is_inside_and_hands_let_go():
    page = session()
    page.press(1, 0, TOP)
    first = ticks(page, 1)
    page.ask(lambda: page.change(plane=Plane(0, 0.5)))
    frame = ticks(page, 1)
    assert frame.number > first.number
    assert not frame.forces
    assert page.shown[0].rest[:, 0].max() == pytest.approx(0.05)
    page.press(1, 0, (0.05, 0.05, 0.15))  # on the section
    page.move(1, (0.002, 0.0, 0.0))
    assert still(page, 0.3).forces[1][0] > 0.0


@pytest.mark.parametrize("name", [INPUT, MARCHED, ELEMENTS])
def test_surfaces(name):
    trimesh = pytest.importorskip("trimesh")
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    points, triangles = np.asarray(ball.vertices), np.asarray(ball.faces)
    domain = wc.Domain.from_surface((points, triangles))
    mesh = wc.TetForest.from_domain(domain, target_elements=2000)
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), device="cpu")
    page = Session(wc.Simulation(body), [mesh.bind(points, triangles)])
    assert list(page.surfaces[0]) == [INPUT, MARCHED, ELEMENTS]
    page.change(surface=name)
    frame = ticks(page, 1)
    if name == INPUT:
        assert len(frame.positions[0]) == len(points)
    pick = page.shown[0].pick(0, page.shown[0].positions[3])
    np.testing.assert_allclose(page.shown[0].at(pick, page.shown[0].rest), page.shown[0].rest[3], atol=1e-4)


def moving(device="cpu"):
    page = session(device)
    page.sim.body.load("z == zmax", (0.001, 0.0, 0.0))
    page.sim.advance(0.1)
    return page


@pytest.mark.parametrize(
    ("what", "of"),
    [
        ({"models": [wc.NeoHookean()]}, lambda sim: sim.models[0]),
        ({"models": [wc.Corotated(rotation_level=3)]}, lambda sim: sim.models[0].rotation_level),
        ({"materials": [wc.Isotropic(1e4, 0.3, 1000.0)]}, lambda sim: sim.body.material.young),
        ({"remesh": [wc.OnlineRemesh()]}, lambda sim: sim.remeshing.every),
    ],
    ids=["law", "rotations", "material", "remeshing"],
)
def test_switched_motion_goes_on(what, of, device):
    page = moving(device)
    former = page.sim
    before = of(former), former.time, former.body.positions.numpy().copy(), former.body.velocities.numpy().copy()
    page.press(1, 0, TOP)
    page.ask(lambda: page.switch(**what))
    page.take_commands()
    assert page.note == ""
    assert page.sim is not former
    assert of(page.sim) != before[0]
    assert page.sim.time == pytest.approx(before[1], abs=1e-12)
    np.testing.assert_allclose(page.sim.body.positions.numpy(), before[2], atol=1e-7)
    np.testing.assert_allclose(page.sim.body.velocities.numpy(), before[3], atol=1e-7)
    assert page.sim.body.constrained.sum() == former.body.constrained.sum()
    np.testing.assert_array_equal(page.sim.body.loads.numpy(), former.body.loads.numpy())
    assert not page.hands
    page.press(1, 0, TOP)
    page.move(1, UP)
    frame = still(page, 0.2)
    assert frame.forces[1][2] > 0.0


def test_switched_and_back_it_is_the_same_motion():
    """A motion that is continued with the same law ends where it would have ended."""
    one, other = moving(), moving()
    other.switch()
    for page in (one, other):
        page.sim.advance(0.5)
    found, expected = (page.sim.body.displacements.numpy() for page in (other, one))
    np.testing.assert_allclose(found, expected, atol=0.02 * np.abs(expected).max())


def test_keyframes_go_on_at_their_time():
    sim = block()
    sim.body.prescribe("z == zmax", times=[0.0, 1.0], displacements=[[0, 0, 0], [0.0, 0.0, 0.02]])
    page = Session(sim)
    sim.advance(0.5)
    page.switch(models=[wc.StVenantKirchhoff()])
    page.sim.advance(0.25)
    top = page.sim.body.mesh.points[:, 2] > 0.199
    np.testing.assert_allclose(page.sim.body.displacements.numpy()[top, 2], 0.015, atol=1e-4)


def test_what_is_refused_leaves_all_as_it_was():
    page = session()
    former = page.sim
    page.press(1, 0, TOP)
    page.ask(lambda: page.switch(models=[wc.Corotated(rotation_level=99)]))
    page.take_commands()
    assert page.note
    assert page.sim is former
    assert page.hands
    page.busy = True
    page.ask(page.reset)
    page.take_commands()
    assert "being saved" in page.note


def test_closed_the_simulation_is_free():
    page = session()
    page.press(1, 0, TOP)
    page.close()
    assert page.sim.system.forces == []
    page.sim.advance(0.1)


def test_stresses_are_averages_of_the_elements_around(device, rng):
    """As the pictures of ``simulate`` have them."""
    from warp_corot.io.pictures.colors import VertexAverage
    from warp_corot.mesh.topology import signed_volumes

    page = session(device)
    body, shown = page.sim.body, page.shown[0]
    mesh = body.mesh
    body.displacements = 1e-3 * rng.standard_normal(mesh.points.shape)
    found = page.sources["stress"].values(page.sim, shown)
    average = VertexAverage(mesh.tets, np.abs(signed_volumes(mesh.points, mesh.tets)), len(mesh.points))
    nodes, weights = shown.binding.nodes.numpy(), shown.binding.weights.numpy()
    expected = (weights * average(page.sim.von_mises())[nodes]).sum(axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-4)
    np.testing.assert_allclose(page.sources["level"].values(page.sim, shown), 6.0, rtol=1e-6)


def test_a_body_on_the_ground_shows_what_it_touches_and_is_switched_with_it():
    mesh = wc.TetForest.box(cells=(1, 1, 1), cell_size=0.1, level=6, origin=(0.0, 0.0, 0.001))
    body = wc.SoftBody(mesh, wc.Isotropic(5e4, 0.4, 1000.0), device="cpu")
    ball = wc.Sphere(radius=0.02, position=(0.3, 0.0, 0.0))
    integrator, down = wc.SymplecticEuler(damping=20.0), (0.0, 0.0, -9.81)
    sim = wc.Simulation(body, integrator=integrator, gravity=down, obstacles=[wc.Ground(), ball])
    page = Session(sim)
    assert page.sources["contact pressure"].applies(body)
    page.change(colors="contact pressure")
    for _ in range(2):
        frame = still(page, 0.5)
        values = page.sources["contact pressure"].values(page.sim, page.shown[0])
        low = page.shown[0].rest[:, 2] < 0.002
        inner = low & (np.abs(page.shown[0].rest[:, :2] - 0.05) < 0.03).all(axis=1)
        assert values[inner].mean() == pytest.approx(1000.0 * 9.81 * 0.1, rel=0.15)
        assert values[~low].max() < 0.3 * values[low].mean()
        assert frame.positions[0][:, 2].min() > -0.002
        np.testing.assert_allclose(frame.poses[1][:3], (0.3, 0.0, 0.0))
        page.switch(models=[wc.NeoHookean()])
    assert not session().sources["contact pressure"].applies(session().sim.body)


def test_a_visitor_drags_in_implicit_steps():
    page = Session(block(integrator=wc.BackwardEuler(dt=1 / 60, damping=20.0)))
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
