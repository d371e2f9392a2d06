"""The forces of tools by one block of threads are those by launches for each part."""

import numpy as np
import pytest

import warp_corot as wc

DOWN = (0.0, 0.0, -9.81)


def pressed(device, *, together, itself):
    """A capsule and a box press a cube that stands on the ground, with friction."""
    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 5), wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    capsule, box = wc.Tool(wc.Capsule(0.01, 0.06)), wc.Tool(wc.Box((0.02, 0.02, 0.05)))
    capsule.follow([0.0, 0.04], [(0.05, 0.055, 0.111), (0.06, 0.055, 0.1)], (0.0, np.sqrt(0.5), 0.0, np.sqrt(0.5)))
    box.follow([0.0, 0.04], [(0.02, 0.02, 0.126), (0.02, 0.025, 0.116)])
    contact = wc.Contact(friction=0.4, self_contact=itself)
    integrator = wc.SymplecticEuler(viscosity=1e-3)
    obstacles = [capsule, box, wc.Ground()]
    sim = wc.Simulation(body, obstacles=obstacles, contact=contact, gravity=DOWN, integrator=integrator)
    sim.contact.rigid.together = together
    sim.advance(0.04)
    wrenches = np.array([each.wrench.numpy()[0] for each in obstacles])
    return body.displacements.numpy().astype(float), wrenches


@pytest.mark.parametrize("itself", [False, True])
def test_one_block_finds_the_same_forces(device, itself):
    """But for rounding, which the compiler may do in another order."""
    (one, felt_by_one), (many, felt_by_many) = (
        pressed(device, together=together, itself=itself) for together in (True, False)
    )
    assert np.linalg.norm(felt_by_one[:2, :3], axis=1).min() > 0.05
    np.testing.assert_allclose(one, many, rtol=0.0, atol=1e-4 * np.abs(many).max())
    np.testing.assert_allclose(felt_by_one, felt_by_many, rtol=0.0, atol=1e-2 * np.abs(felt_by_many).max())


def squeezed(device, *, together, own):
    """Two balls or two blocks, one on the other, pressed onto the ground by a plate."""
    soft = wc.Isotropic(2e4, 0.4, 1000.0)
    if own:
        mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.02), target_elements=200)
        high = wc.TetForest.from_domain(wc.Domain.sphere(0.02, centre=(0.0, 0.0, 0.0384)), target_elements=200)
        floor, top = -0.0194, 0.0573
    else:
        mesh = wc.TetForest.box((1, 1, 1), 0.04, 3, origin=(-0.02, -0.02, 0.0))
        high = wc.TetForest.box((1, 1, 1), 0.03, 2, origin=(-0.015, -0.015, 0.0401))
        floor, top = 0.0, 0.0701
    bodies = [wc.SoftBody(each, soft, device=device) for each in (mesh, high)]
    plate = wc.Tool(wc.Box((0.06, 0.06, 0.01)))
    plate.follow([0.0, 0.02], [(0.0, 0.0, top + 0.0052), (0.0, 0.0, top + 0.0022)])
    ground = wc.Ground(offset=floor)
    integrator = wc.SymplecticEuler(viscosity=1e-3)
    sim = wc.Simulation(
        bodies, obstacles=[plate, ground], contact=wc.Contact(friction=0.4), gravity=DOWN, integrator=integrator
    )
    sim.contact.rigid.together = together
    sim.advance(0.02)
    assert any(point.other is bodies[0] or point.other is bodies[1] for point in sim.contacts())
    wrenches = np.array([each.wrench.numpy()[0] for each in (plate, ground)])
    return np.concatenate([body.displacements.numpy().astype(float) for body in bodies]), wrenches


@pytest.mark.parametrize("own", [False, True], ids=["nodes", "own surfaces"])
def test_one_block_finds_the_same_forces_of_soft_surfaces(device, own):
    (one, felt_by_one), (many, felt_by_many) = (
        squeezed(device, together=together, own=own) for together in (True, False)
    )
    most = np.abs(felt_by_many).max()
    assert most > 0.05
    np.testing.assert_allclose(one, many, rtol=0.0, atol=1e-3 * np.abs(many).max())
    np.testing.assert_allclose(
        felt_by_one[:, :3], felt_by_many[:, :3], rtol=0.0, atol=1e-2 * np.abs(felt_by_many).max()
    )
