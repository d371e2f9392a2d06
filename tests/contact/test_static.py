"""Static answers of bodies that rest on obstacles."""

import numpy as np
import pytest
from soft_surfaces import DOWN, block, weight

import warp_corot as wc


@pytest.mark.parametrize("above", [0.0, 0.01])
def test_a_block_rests_on_the_ground(device, above):
    """Only the ground holds it; it may begin above the ground."""
    body, ground = block(device, above), wc.Ground()
    report = wc.solve_static(body, gravity=DOWN, obstacles=ground, contact=wc.Contact(friction=0.1))
    assert report.converged
    assert report.residual < 1e-3
    wrench = ground.wrench.numpy()[0].astype(float)
    np.testing.assert_allclose(wrench[:3], [0.0, 0.0, -weight(body)], atol=1e-3 * weight(body))
    assert body.positions.numpy()[:, 2].min() == pytest.approx(0.0, abs=1e-6)
    assert not body.velocities.numpy().any()


@pytest.mark.parametrize("law", [wc.Corotated(), wc.NeoHookean(), wc.Linear()])
def test_a_beam_on_a_floor_is_where_long_runs_end(device, law):
    """Without friction there is one answer; the floor carries the rest of the weight."""
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=1)
    ends, loads = [], []
    for static in (True, False):
        body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), device=device)
        body.fix(mesh.points[:, 2] == 0.0)
        floor = wc.Ground((0.0, 1.0, 0.0), -0.02, friction=0.0)
        given = {"model": law, "gravity": (0.0, -9.81, 0.0), "obstacles": floor}
        if static:
            report = wc.solve_static(body, **given)
            assert report.converged
            assert report.residual < 1e-3
        else:
            sim = wc.Simulation(body, integrator=wc.BackwardEuler(dt=0.05, linear_tolerance=1e-6), **given)
            sim.advance_steps(120)
        ends.append(body.displacements.numpy().astype(float))
        loads.append(floor.wrench.numpy()[0].astype(float))
        carried = body.reactions.numpy().astype(float).sum(axis=0) - loads[-1][:3]
        np.testing.assert_allclose(carried, [0.0, weight(body), 0.0], atol=1e-3 * weight(body))
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-4 * np.abs(ends[1]).max())
    np.testing.assert_allclose(loads[0][:3], loads[1][:3], atol=2e-3 * np.abs(loads[1][:3]).max())


def test_worlds_and_what_is_refused(device):
    body, ground = block(device, 0.001, cells=(1, 1, 1), worlds=2), wc.Ground(friction=0.0)
    report = wc.solve_static(body, gravity=DOWN, obstacles=ground)
    assert report.world_converged.tolist() == [True, True]
    np.testing.assert_allclose(ground.wrench.numpy()[:, 2], -weight(body), rtol=1e-3)
    with pytest.raises(wc.InputError, match="it must be a shape at rest"):
        wc.solve_static(body, gravity=DOWN, obstacles=wc.Tool(wc.Sphere(0.01)))
    with pytest.raises(wc.InputError, match="load_steps is 2"):
        wc.solve_static(body, gravity=DOWN, obstacles=ground, load_steps=2)
    report = wc.solve_static(body, gravity=(0.0, 0.0, 9.81), obstacles=ground, iterations=5)
    assert not report.converged
    assert "falls as a whole" in report.message
    assert np.abs(body.displacements.numpy()).max() < 0.01


def test_a_ball_that_begins_inside_is_met_where_it_is(device):
    """Nothing but the ball loads the block."""
    mesh = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.03, level=3)
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), device=device)
    body.fix(mesh.points[:, 2] == 0.0)
    ball = wc.Sphere(0.02, position=(0.031, 0.024, 0.045), friction=0.0)
    report = wc.solve_static(body, gravity=(0.0, 0.0, 0.0), obstacles=ball)
    assert report.converged
    assert report.iterations < 40
    assert report.residual < 1e-4
    wrench = ball.wrench.numpy()[0].astype(float)[:3]
    np.testing.assert_allclose(body.reactions.numpy().astype(float).sum(axis=0), wrench, atol=1e-3 * wrench[2])
    pushed = sum(contact.force for contact in report.contacts)
    np.testing.assert_allclose(pushed, -wrench, atol=1e-3 * wrench[2])
    for contact in report.contacts:
        assert abs(contact.gap) < 1e-6


def test_a_corner_that_is_pressed_far_into_the_same_body_comes_to_rest(device):
    """In the first step, it goes much farther than an element."""
    from scipy.spatial.transform import Rotation

    block, cube = wc.TetForest.box((1, 1, 1), 0.02, 4), wc.TetForest.box((1, 1, 1), 0.012, 3)
    turned = Rotation.from_euler("yx", [33.0, 40.0], degrees=True).apply(cube.points)
    turned += np.array([0.0118, 0.0087, 0.026]) - turned[np.argmin(turned[:, 2])]
    points = np.concatenate([block.points, turned])
    mesh = wc.TetMesh(points, np.concatenate([block.tets, cube.tets + len(block.points)]))
    body = wc.SoftBody(mesh, wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    top = points[:, 2] > 0.036
    body.displacements = np.where(top[:, None], [0.0, 0.0, -0.0072], 0.0)
    body.fix(top | (points[:, 2] < 1e-9))
    report = wc.solve_static(body, gravity=(0, 0, -10), contact=wc.Contact(friction=0.0, self_contact=True))
    assert report.converged, report.message
    assert len(report.contacts) == 1
