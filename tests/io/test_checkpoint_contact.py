"""A resumed run with contact, tools and grasps equals the uninterrupted one."""

import numpy as np
import pytest

import warp_corot as wc

SOFT = wc.Isotropic(young=2e4, poisson=0.4, density=1000.0)
DOWN = (0.0, 0.0, -9.81)
BOX_POINTS = np.array([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
SIDES = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
BOX_TRIANGLES = [corners for a, b, c, d in SIDES for corners in ((a, b, c), (a, c, d))]


def block(device, z, level=2, **options):
    mesh = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.02, level=level, origin=(0.0, 0.0, z))
    return wc.SoftBody(mesh, SOFT, device=device, **options)


def pressed(device):
    """Two bodies on a slope, one on the other, under tools that slide, hold and wait."""
    low, high = block(device, 0.0001), block(device, 0.0203, level=3)
    probe = wc.Tool(wc.Capsule(0.004, 0.02, friction=0.6))
    probe.follow([0.0, 0.06], [(0.02, 0.02, 0.059), (0.03, 0.02, 0.056)], quaternions=(0.1, 0.0, 0.0, 1.0))
    pincers = wc.Tool(wc.Sphere(0.001, position=(0.0, 0.0, 0.1)), speed=0.3)
    floor = wc.TriangleMesh((BOX_POINTS - (0.5, 0.5, 1.015)) * 0.2, BOX_TRIANGLES)
    ball = wc.SignedDistance(lambda p: np.linalg.norm(p, axis=1) - 0.1, (-0.2, -0.2, -0.2), upper=(0.2, 0.2, 0.2))
    ball.position = np.array([0.02, 0.02, -0.3])
    sim = wc.Simulation(
        [low, high],
        obstacles=[floor, wc.Ground((0.1, 0.0, 1.0), -0.001), probe, pincers, ball],
        contact=wc.Contact(friction=0.4, self_contact=True, flat_edges=True),
        gravity=DOWN,
        integrator=wc.SymplecticEuler(viscosity=1e-3),
    )
    wc.Grasp(low, "(z == zmax) & (x == xmin)", tool=pincers, stiffness=50.0)
    wc.Grasp(high, "(z == zmax) & (x == xmin) & (y < 0.01)", tool=pincers)
    pincers.move((0.0, 0.0, 0.103))
    return sim


def remeshed(device):
    """A body that is refined where a ball presses it."""
    body = wc.SoftBody(wc.TetForest.box(cells=(2, 2, 1), cell_size=0.02, level=2), SOFT, device=device)
    body.fix("z == zmin")
    probe = wc.Tool(wc.Sphere(0.008))
    probe.follow([0.0, 0.04], [(0.02, 0.02, 0.0281), (0.02, 0.02, 0.023)])
    options = wc.OnlineRemesh(refine_above=1.005, simplify_below=1.001, max_level=5, every=16)
    contact = wc.Contact(flat_edges=True)
    return wc.Simulation(body, obstacles=[probe], contact=contact, gravity=(0, 0, 0), remesh=options)


@pytest.mark.parametrize("make", [pytest.param(pressed, marks=pytest.mark.slow), remeshed])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, make):
    whole, parted = make("cpu"), make("cpu")
    whole.advance(0.03)
    parted.advance(0.03)
    count = len(parted.body.mesh.tets)
    parted.save(tmp_path / "state.npz")
    resumed = wc.Simulation.load(tmp_path / "state.npz")
    assert [type(each) for each in resumed.obstacles] == [type(each) for each in whole.obstacles]
    assert len(resumed.grasps) == len(whole.grasps)
    assert resumed.contact.options == whole.contact.options
    for one, other in zip(parted.bodies, resumed.bodies, strict=True):
        np.testing.assert_array_equal(one.contact_forces.numpy(), other.contact_forces.numpy())
        np.testing.assert_array_equal(one.contact_pressure.numpy(), other.contact_pressure.numpy())
    for sim in (whole, resumed):
        sim.advance(0.01)
        for grasp in sim.grasps[:1]:
            grasp.release()
        sim.advance(0.02)
    assert resumed.steps == whole.steps
    assert resumed.time == whole.time
    for one, other in zip(whole.bodies, resumed.bodies, strict=True):
        assert np.abs(one.contact_forces.numpy()).max() > 0.0
        for name in ("positions", "velocities", "reactions", "contact_forces"):
            a, b = getattr(one, name).numpy(), getattr(other, name).numpy()
            np.testing.assert_array_equal(a, b, err_msg=name)
    for one, other in zip(whole.obstacles, resumed.obstacles, strict=True):
        np.testing.assert_array_equal(one.wrench.numpy(), other.wrench.numpy())
    for one, other in zip(whole.grasps, resumed.grasps, strict=True):
        np.testing.assert_array_equal(one.wrench.numpy(), other.wrench.numpy())
    assert make is pressed or len(whole.body.mesh.tets) != count


def test_a_tool_that_followed_an_array_stays_at_its_last_target(tmp_path):
    sim = pressed("cpu")
    sim.advance(0.01)
    sim.obstacles[2].move((0.02, 0.02, 0.06))
    sim.save(tmp_path / "state.npz")
    again = wc.Simulation.load(tmp_path / "state.npz")
    again.advance(0.02)
    np.testing.assert_allclose(again.obstacles[2].present_pose[0, :3], (0.02, 0.02, 0.06), atol=1e-6)


def test_a_users_own_shape_is_refused(tmp_path):
    class Egg(wc.Sphere):
        pass

    sim = wc.Simulation(block("cpu", 0.0), obstacles=Egg(0.01), gravity=DOWN)
    with pytest.raises(wc.InputError, match="a Egg cannot be saved"):
        sim.save(tmp_path / "sim.npz")
    assert not list(tmp_path.iterdir())
