"""Patches that a tool holds."""

import numpy as np
import pytest
import warp as wp

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
CALM, EULER = wc.SymplecticEuler(viscosity=2e-3), wc.BackwardEuler(dt=0.01)
BOTH = pytest.mark.parametrize("integrator", [CALM, EULER], ids=["explicit", "implicit"])


def held_block(device, worlds=1, stiffness=None, gravity=(0.0, 0.0, 0.0), fixed=True, integrator=CALM):
    mesh = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.02, level=3)
    body = wc.SoftBody(mesh, SOFT, device=device, worlds=worlds)
    if fixed:
        body.fix("z == zmin")
    tool = wc.Tool(wc.Sphere(0.002, position=(0.02, 0.02, 0.03)), speed=0.1)
    sim = wc.Simulation(body, obstacles=[tool], gravity=gravity, integrator=integrator)
    return body, tool, sim, wc.Grasp(body, "z == zmax", tool=tool, stiffness=stiffness)


@BOTH
def test_a_grasped_patch_goes_along(device, integrator):
    body, tool, sim, grasp = held_block(device, integrator=integrator)
    top = body.mesh.points[:, 2] > 0.0199
    tool.move((0.02, 0.022, 0.032))
    sim.advance(0.3)
    np.testing.assert_allclose(body.displacements.numpy()[top], np.tile((0.0, 0.002, 0.002), (top.sum(), 1)), atol=1e-6)
    felt, held = grasp.wrench.numpy()[0].astype(float), body.reactions.numpy().astype(float).sum(axis=0)
    assert felt[2] < -0.1
    np.testing.assert_allclose(felt[:3], held, atol=1e-3 * np.abs(held).max())


@BOTH
def test_a_turning_tool_turns_the_patch(device, integrator):
    body, tool, sim, _grasp = held_block(device, integrator=integrator)
    top = body.mesh.points[:, 2] > 0.0199
    angle = 0.1
    tool.move((0.02, 0.02, 0.03), (0.0, 0.0, np.sin(angle / 2), np.cos(angle / 2)))
    sim.advance(0.3)
    rest = body.mesh.points[top] - (0.02, 0.02, 0.0)
    turned = rest @ np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    np.testing.assert_allclose(body.displacements.numpy()[top], turned - rest, atol=2e-6)


@BOTH
def test_a_hanging_body_pulls_with_its_weight(device, integrator):
    body, _tool, sim, grasp = held_block(
        device, worlds=2, gravity=(0.0, 0.0, -9.81), fixed=False, integrator=integrator
    )
    sim.advance(0.6)
    weight = 9.81 * body.masses.sum() / 2
    np.testing.assert_allclose(grasp.wrench.numpy()[:, 2], -weight, rtol=1e-3)


@BOTH
def test_a_springy_hold_gives_way(device, integrator):
    """A rigid patch on a spring: the motion of the tool is shared between the spring and the body."""
    body, tool, sim, grasp = held_block(device, stiffness=200.0, integrator=integrator)
    tool.move((0.02, 0.02, 0.034))
    sim.advance(0.4)
    top = body.mesh.points[:, 2] > 0.0199
    given = 0.004 - body.displacements.numpy()[top, 2].astype(float).mean()
    assert 1e-4 < given < 0.004
    assert -grasp.wrench.numpy()[0, 2] == pytest.approx(200.0 * given, rel=1e-3)


@BOTH
def test_a_released_patch_falls_back(device, integrator):
    body, tool, sim, grasp = held_block(device, integrator=integrator)
    tool.move((0.02, 0.02, 0.033))
    sim.advance(0.1)
    assert grasp.is_holding
    grasp.release()
    grasp.release()
    sim.advance(0.5)
    assert not grasp.is_holding
    assert not grasp.wrench.numpy().any()
    assert np.abs(body.displacements.numpy()).max() < 1e-4


@BOTH
def test_an_array_opens_and_closes_a_grasp_in_each_world(device, integrator):
    """A gripper above the edge of the upper side holds what is within reach, from where it is when it closes."""
    worlds, reach = 3, 0.016
    body, tool, sim, grasp = held_block(device, worlds=worlds, integrator=integrator)
    grasp.release()
    closed = wp.array([1, 0, 0], dtype=wp.int32, device=device)
    grasp = wc.Grasp(body, "z == zmax", tool=tool, closed=closed, reach=reach)
    points = body.mesh.points
    near = (points[:, 2] > 0.0199) & (np.linalg.norm(points - (0.02, 0.02, 0.03), axis=1) <= reach)
    assert 0 < near.sum() < (points[:, 2] > 0.0199).sum()
    up = np.tile((0.0, 0.0, 0.002), (near.sum(), 1))

    def moved(world):
        return body.displacements.numpy().reshape(worlds, -1, 3)[world]

    tool.move((0.02, 0.02, 0.032))
    sim.advance(0.3)
    np.testing.assert_allclose(moved(0)[near], up, atol=1e-6)
    assert (moved(1) == 0.0).all()
    # The second world takes hold of the body at rest; the first one lets go.
    closed.assign([0, 1, 0])
    sim.advance(0.02)
    tool.move((0.02, 0.02, 0.034))
    sim.advance(0.4)
    np.testing.assert_allclose(moved(1)[near], up, atol=1e-6)
    assert np.abs(moved(0)).max() < 1e-5
    assert (grasp.wrench.numpy()[[0, 2]] == 0.0).all()
    # A reset opens it, and it closes where the tool begins, which has its way before it.
    sim.reset([1])
    sim.advance(0.02)
    tool.move((0.02, 0.02, 0.03))
    sim.advance(0.3)
    np.testing.assert_allclose(moved(1)[near], np.zeros_like(up), atol=2e-6)


@BOTH
def test_a_grasped_patch_is_remeshed(device, integrator):
    """New nodes between held nodes are held; where elements are merged, the remaining nodes are held."""
    body = wc.SoftBody(wc.TetForest.box((2, 2, 1), 0.02, 1), SOFT, device=device)
    body.fix("z == zmin")
    tool = wc.Tool(wc.Sphere(0.002, position=(0.02, 0.02, 0.03)), speed=0.1)
    every = 32 if integrator is CALM else 4
    remesh = wc.OnlineRemesh(every=every, max_level=5, refine_above=1.04, simplify_below=1.01)
    sim = wc.Simulation(body, obstacles=[tool], gravity=(0.0, 0.0, 0.0), integrator=integrator, remesh=remesh)
    grasp = wc.Grasp(body, "z == zmax", tool=tool)
    counts = [len(grasp.nodes)]
    for height, turn in ((0.032, 0.1), (0.03, 0.0)):
        tool.move((0.02, 0.02, height), (0.0, 0.0, np.sin(turn), np.cos(turn)))
        sim.advance(0.2)
        x = body.mesh.points
        top = x[:, 2] > 0.0199
        np.testing.assert_array_equal(grasp.nodes, np.flatnonzero(top))
        c, s = np.cos(2 * turn), np.sin(2 * turn)
        expected = (x[top] - (0.02, 0.02, 0.03)) @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + (0.02, 0.02, height)
        np.testing.assert_allclose(body.positions.numpy()[top], expected, atol=5e-6)
        felt, held = grasp.wrench.numpy()[0].astype(float), body.reactions.numpy().astype(float).sum(axis=0)
        np.testing.assert_allclose(felt[:3], held, atol=0.01)
        counts.append(len(grasp.nodes))
    assert counts[1] > counts[0]
    assert counts[2] < counts[1]
    grasp.release()
    sim.advance(0.01)
    assert not grasp.wrench.numpy().any()


def test_bad_grasps_are_refused(device):
    body, tool, _sim, _grasp = held_block(device)
    with pytest.raises(wc.InputError, match="simulation"):
        wc.Grasp(body, "z == zmax", tool=wc.Tool(wc.Sphere(0.01)))
    with pytest.raises(wc.InputError, match="stiffness"):
        wc.Grasp(body, "z == zmax", tool=tool, stiffness=0.0)
    with pytest.raises(wc.InputError, match="surface"):
        wc.Grasp(body, np.zeros(body.node_count, bool), tool=tool)


def test_a_grasp_that_opens_is_not_saved_and_wants_its_array(device, tmp_path):
    body, tool, sim, _grasp = held_block(device, worlds=2)
    with pytest.raises(wc.InputError, match=r"closed is .* must be a Warp array int32 \[2\]"):
        wc.Grasp(body, "z == zmax", tool=tool, closed=wp.ones(3, dtype=wp.int32, device=device))
    with pytest.raises(wc.InputError, match="reach is 0"):
        wc.Grasp(body, "z == zmax", tool=tool, reach=0.0)
    wc.Grasp(body, "z == zmax", tool=tool, closed=wp.ones(2, dtype=wp.int32, device=device))
    with pytest.raises(wc.InputError, match="cannot be saved"):
        sim.save(tmp_path / "grasp.npz")
