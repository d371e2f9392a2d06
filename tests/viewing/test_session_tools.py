"""A session with rigid tools, and of several worlds: hands on tools, switches, and the world that is shown."""

import numpy as np
import pytest
from hands import TOP, block

import warp_corot as wc
from warp_corot.viewing.commands import TISSUES, present, switched
from warp_corot.viewing.session import Session

UP = np.array([0.0, 0.0, 0.004])


def still(of, seconds):
    """A frame after this much simulated time, whatever the wall clock says."""
    of.take_commands()
    of.sim.advance(seconds)
    return of.frame()


def with_tool(device="cpu", **options):
    """A ball of 4 cm that lies on the top of a block."""
    tool = wc.Tool(wc.Sphere(radius=0.02, position=(0.05, 0.05, 0.2202)))
    return Session(block(device, obstacles=[tool, wc.Ground(offset=-0.5)], **options)), tool


@pytest.mark.parametrize(
    "what",
    [{"models": [wc.NeoHookean()]}, {"remesh": [wc.OnlineRemesh()]}],
    ids=["law", "remeshing"],
)
def test_switched_a_tool_goes_on(what, device):
    page, tool = with_tool(device)
    former = page.sim
    page.press_tool(1, 0)
    page.move(1, (0.0, 0.0, -0.005))
    still(page, 0.6)  # until it hardly vibrates
    before, force = tool.present_pose.copy(), tool.wrench.numpy()[0, 2]
    page.ask(lambda: page.switch(**what))
    page.take_commands()
    assert page.note == ""
    assert page.sim is not former
    np.testing.assert_allclose(tool.present_pose, before, atol=1e-9)
    frame = still(page, 0.6)
    assert frame.poses[0][2] == pytest.approx(0.2152, abs=1e-6)
    assert tool.wrench.numpy()[0, 2] == pytest.approx(force, rel=0.2)
    page.press_tool(1, 0)
    page.move(1, (0.0, 0.0, 0.002))
    assert still(page, 0.2).poses[0][2] == pytest.approx(0.2172, abs=1e-6)
    page.reset()
    assert page.frame().poses[0][2] == pytest.approx(0.2202, abs=1e-6)


def test_a_refused_switch_leaves_tools_and_grasps_as_they_were():
    page, tool = with_tool()
    page.change(hand="grasp", radius=0.02)
    page.press_tool(1, 0)
    former = page.sim
    page.ask(lambda: page.switch(models=[wc.Corotated(rotation_level=99)]))
    page.take_commands()
    assert page.note
    assert page.sim is former
    assert len(former.grasps) == 1
    page.move(1, (0.0, 0.0, 0.005))
    assert still(page, 0.3).forces[1][2] > 0.01
    assert tool.present_pose[0][2] == pytest.approx(0.2252, abs=1e-6)


def test_grasps_of_the_users_go_on_and_those_of_hands_do_not():
    page, tool = with_tool()
    top = page.sim.body.mesh.points[:, 2] > 0.199
    middle = np.linalg.norm(page.sim.body.mesh.points[:, :2] - 0.05, axis=1) < 0.02
    mine = wc.Grasp(page.sim.body, np.flatnonzero(top & middle), tool=tool)
    page.change(hand="grasp", radius=0.02)
    page.press_tool(1, 0)
    assert len(page.sim.grasps) == 2
    page.switch(models=[wc.NeoHookean()])
    (grasp,) = page.sim.grasps
    assert grasp is not mine
    np.testing.assert_array_equal(grasp.nodes, mine.nodes)
    tool.move((0.05, 0.05, 0.2252))
    still(page, 0.3)
    np.testing.assert_allclose(page.sim.body.displacements.numpy()[grasp.nodes, 2], 0.005, atol=1e-5)


def test_a_tool_on_keyframes_goes_on_at_their_time():
    page, tool = with_tool()
    tool.follow([0.0, 1.0], [(0.05, 0.05, 0.22), (0.05, 0.05, 0.24)])
    page.sim.advance(0.5)
    page.switch(models=[wc.NeoHookean()])
    page.sim.advance(0.25)
    assert tool.present_pose[0][2] == pytest.approx(0.235, abs=1e-4)


def with_worlds(**options):
    """A block in two worlds, with a ball on its top; in the second world a force pulls the top along x."""
    mesh = wc.TetForest.box(cells=(1, 1, 2), cell_size=0.1, level=6)
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), worlds=2, device="cpu")
    body.fix("z == zmin")
    body.load("z == zmax", (0.001, 0.0, 0.0))
    body.world(0).loads.zero_()
    tool = wc.Tool(wc.Sphere(radius=0.02, position=(0.05, 0.05, 0.2202)))
    integrator = wc.SymplecticEuler(damping=20.0)
    return Session(wc.Simulation(body, obstacles=tool, integrator=integrator, gravity=(0, 0, 0), **options)), tool


def test_worlds_are_shown_one_at_a_time():
    page, _ = with_worlds()
    still(page, 0.3)
    body = page.sim.body
    for world in (1, 0):
        page.ask(lambda world=world: page.change(world=world, colors="displacement"))
        page.take_commands()
        frame = page.frame()
        moved = np.linalg.norm(body.world(world).displacements.numpy(), axis=1).max()
        largest = np.linalg.norm(frame.positions[0] - page.shown[0].rest, axis=1).max()
        assert largest == pytest.approx(moved, rel=1e-3, abs=1e-7)
        assert (largest > 1e-4) == (world == 1)
    highest = []
    for world in (0, 1):
        page.change(world=world)
        for source in ("stress", "contact pressure", "level"):
            values = page.sources[source].values(page.sim, page.shown[0])
            assert values.shape == (len(page.shown[0].rest),)
            highest.append(values.max())
    assert highest[3] > 2.0 * highest[0]


def test_a_hand_holds_the_tissue_of_the_shown_world():
    page, _ = with_worlds()
    page.change(world=1)
    page.press(1, 0, TOP)
    page.move(1, UP)
    frame = still(page, 0.3)
    assert frame.forces[1][2] > 0.0
    low, high = (np.abs(page.sim.body.world(k).displacements.numpy()[:, 2]).max() for k in (0, 1))
    assert high > 10.0 * low
    page.change(world=0)
    assert not page.hands


def test_a_tool_is_felt_in_the_shown_world():
    page, tool = with_worlds()
    page.change(world=1)
    page.press_tool(1, 0)
    page.move(1, (0.0, 0.0, -0.005))
    force = still(page, 0.2).forces[1]
    np.testing.assert_allclose(force, -tool.wrench.numpy()[1][:3], rtol=1e-6)
    page.switch(models=[wc.NeoHookean()])
    assert page.sim.worlds == 2
    assert still(page, 0.1).poses[0][2] == pytest.approx(0.2152, abs=1e-6)


def test_a_visitor_moves_a_tool_and_feels_the_tissue(device):
    page, tool = with_tool(device)
    page.press_tool(1, 0)
    page.move(1, (0.0, 0.0, -0.01))
    frame = still(page, 0.3)
    assert frame.poses[0][2] == pytest.approx(0.2102, abs=1e-6)
    (force,) = frame.forces.values()
    np.testing.assert_allclose(force, -tool.wrench.numpy()[0][:3], rtol=1e-6)
    assert force[2] < -0.1
    np.testing.assert_allclose(frame.ends[1][0], frame.ends[1][1], atol=1e-6)
    page.let_go(1)
    assert still(page, 0.05).poses[0][2] == pytest.approx(0.2102, abs=1e-6)
    page.press_tool(2, 0)
    assert list(page.hands) == [2]
    page.move(2, (0.0, 0.0, 0.03))
    page.let_go(2)
    assert still(page, 0.3).forces
    page.release_all()
    assert not page.frame().forces


def test_a_visitor_grasps_with_a_tool(device):
    page, _ = with_tool(device)
    page.change(hand="grasp", radius=0.02)
    page.press_tool(1, 0)
    page.move(1, (0.0, 0.0, 0.005))
    page.let_go(1)
    frame = still(page, 0.3)
    (force,) = frame.forces.values()
    assert force[2] > 0.01
    (grasp,) = page.sim.grasps
    moved = page.sim.body.displacements.numpy()[grasp.nodes]
    np.testing.assert_allclose(moved[:, 2], 0.005, atol=1e-5)
    page.release_all()
    assert page.sim.grasps == ()
    assert still(page, 0.5).forces == {}
    assert np.abs(page.sim.body.displacements.numpy()).max() < 5e-4


def test_tools_that_a_visitor_cannot_move_are_named():
    page, tool = with_tool()
    page.ask(lambda: page.press_tool(1, 1))
    page.take_commands()
    assert "does not move" in page.note
    tool.follow([0.0, 1.0], [(0.05, 0.05, 0.25), (0.05, 0.05, 0.2)])
    page.ask(lambda: page.press_tool(1, 0))
    page.take_commands()
    assert "follows keyframes" in page.note
    page, tool = with_tool()
    tool.move((0.05, 0.05, 0.5))
    still(page, 0.5)
    page.change(hand="grasp")
    page.ask(lambda: page.press_tool(1, 0))
    page.take_commands()
    assert "no tissue is within" in page.note


@pytest.mark.parametrize("name", ["ball", "rod"])
def test_a_visitor_puts_a_tool_into_the_scene_presses_with_it_and_takes_it_away(name):
    page = Session(block())
    former = page.sim
    page.use_tool(name, (0.05, 0.05, 0.15))  # inside the block
    assert page.tool == name
    (tool,) = page.sim.obstacles
    assert page.sim.time == former.time
    still(page, 0.05)
    assert np.linalg.norm(tool.wrench.numpy()) == 0.0  # it begins clear of the body
    page.press_tool(1, 0)
    page.move(1, np.array([0.05, 0.05, 0.19]) - tool.present_pose[0, :3])
    assert np.linalg.norm(still(page, 0.5).forces[1]) > 0.01
    page.use_tool("")
    assert (page.tool, page.sim.obstacles, page.sim.contact) == ("", (), None)
    assert not page.hands


def test_a_visitor_cuts_with_a_knife_and_takes_it_away():
    page = Session(block())
    page.use_tool("knife", (0.3, 0.05, 0.1))
    (knife,) = page.given
    assert page.frame().poses[0][0] > 0.1
    page.press_tool(1, 0)
    place = knife.present_pose[0, :3].copy()
    page.move(1, np.array([-0.1, 0.0512, 0.1]) - place)
    whole = page.frame().triangles[0]
    shown = page.number
    frame = still(page, 1.0)
    assert page.number > shown
    assert page.sim.body.cut_area > 0.005
    assert len(frame.triangles[0]) > len(whole)
    assert list(page.hands) == [1]  # it is still held
    assert page.note == ""
    pieces = page.sim.body.pieces
    page.use_tool("ball", (0.3, 0.05, 0.1))
    assert (len(page.given), page.sim.blades) == (1, None)
    assert page.sim.body.pieces == pieces
    page.reset()


def test_a_tool_of_the_page_leaves_those_of_the_user_where_they_are():
    page, tool = with_tool()
    tool.move((0.05, 0.05, 0.2152))
    still(page, 0.2)
    before = tool.present_pose.copy()
    page.use_tool("ball", (0.3, 0.0, 0.1))
    page.use_tool("rod", (-0.3, 0.0, 0.1))
    assert len(page.sim.obstacles) == 3
    np.testing.assert_allclose(tool.present_pose, before, atol=1e-9)
    assert tool.wrench.numpy().shape == (1, 6)
    page.ask(lambda: page.use_tool("saw"))
    page.take_commands()
    assert "name is 'saw'" in page.note
    assert (len(page.sim.obstacles), page.tool) == (3, "rod")
    page.use_tool("")
    assert len(page.sim.obstacles) == 2


def test_tissues_are_those_of_their_sources():
    page = Session(block())
    liver = next(each for each in TISSUES if each.name == "liver")
    page.switch(**switched(page.sim, present(page.sim) | {"young": liver.young, "density": liver.density}, (0, 0, 0)))
    material = page.sim.body.material
    assert (material.young, material.density) == (pytest.approx(5.5e3), pytest.approx(1060.0))
    assert material.poisson == pytest.approx(0.4)
    assert switched(page.sim, present(page.sim), (0, 0, 0)) == {}
    assert not present(page.sim)["weight"]
    page.switch(**switched(page.sim, present(page.sim) | {"weight": True}, (0.0, 0.0, -9.81)))
    page.sim.advance(0.1)
    assert page.sim.body.displacements.numpy()[:, 2].min() < -1e-4
