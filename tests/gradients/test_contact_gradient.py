"""Gradients of static answers in contact without friction, against central differences of other static answers."""

import numpy as np
import pytest

import warp_corot as wc

CONTACT = wc.Contact(friction=0.0)


def on_floor(device):
    """A beam whose free end lies on a floor."""
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=2)
    return mesh, mesh.points[:, 2] == 0.0, lambda at: wc.Ground((0.0, 1.0, 0.0), -0.02 + at[1]), (0.0, -9.81, 0.0)


def under_a_ball(device):
    """A ball smaller than the elements, which presses between their nodes."""
    mesh = wc.TetForest.box(cells=(2, 2, 1), cell_size=0.03, level=3)
    at = np.array((0.031, 0.024, 0.046))
    return mesh, mesh.points[:, 2] == 0.0, lambda by: wc.Sphere(0.02, position=at + by), (0.0, 0.0, 0.0)


def organ(device):
    """A ball of tissue, whose own surface is between nodes, under another one."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.03, device=device), target_elements=400, device=device)
    at = np.array((0.01, 0.005, 0.047))
    return mesh, mesh.points[:, 2] < -0.012, lambda by: wc.Sphere(0.02, position=at + by), (0.0, 0.0, 0.0)


@pytest.mark.parametrize("scene", [on_floor, under_a_ball, organ])
def test_derivatives_are_those_of_other_answers(device, scene, rng):
    mesh, held, obstacle, gravity = scene(device)
    outwards = mesh.points - mesh.points.mean(axis=0)
    outwards *= 10.0 / np.abs(outwards).max()
    weights = (rng.normal(size=mesh.points.shape) + 0.5 + outwards) / len(mesh.points)

    def objective(x):
        return float(np.sum(weights * x.numpy())), weights

    def body(poisson=0.4):
        made = wc.SoftBody(mesh, wc.Isotropic(5e3, poisson, 1000.0), device=device)
        made.fix(held)
        return made

    def value(poisson=0.4, by=(0.0, 0.0, 0.0), gravity=gravity):
        rested = body(poisson)
        report = wc.solve_static(rested, gravity=gravity, obstacles=obstacle(np.array(by)), contact=CONTACT)
        assert report.converged
        assert len(report.contacts) == len(found.report.contacts)
        return np.sum(weights * rested.positions.numpy().astype(float))

    # Young's modulus changes nothing where the obstacle alone loads the body.
    names = ("poisson", "gravity", "obstacles", "loads")
    given = {"gravity": gravity, "obstacles": obstacle(np.zeros(3)), "contact": CONTACT}
    found = wc.static_gradient(body(), objective, wrt=names, **given)
    assert found.report.contacts
    slope = (value(poisson=0.402) - value(poisson=0.398)) / 0.004
    assert found.poisson == pytest.approx(slope, rel=2e-3)
    for axis in (1,) if scene is on_floor else range(3):
        by = 1e-4 * np.eye(3)[axis]
        slope = (value(by=by) - value(by=-by)) / 2e-4
        assert found.obstacles[0, axis] == pytest.approx(slope, rel=2e-3, abs=2e-3 * np.abs(found.obstacles).max())
    if scene is on_floor:
        by = np.array((0.0, 0.05, 0.0))
        slope = (value(gravity=gravity + by) - value(gravity=gravity - by)) / 0.1
        assert found.gravity[1] == pytest.approx(slope, rel=2e-3)
    # A load on a node of a flat floor that pushes it onto the floor changes nothing but the floor's force.
    if scene is on_floor:
        touching = [contact.nodes[0] for contact in found.report.contacts]
        assert np.abs(found.loads[touching, 1]).max() < 1e-5 * np.abs(found.loads).max()


def test_boundary_rest_and_worlds(device, rng):
    """In two worlds. Who moves the rest shape along the floor moves everything; towards it, all but the floor."""
    mesh, held, obstacle, gravity = on_floor(device)
    weights = rng.normal(size=(2 * len(mesh.points), 3)) / len(mesh.points)
    young = np.array([[5e3], [6e3]])

    def answer(moved=0.0, worlds=2):
        body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), device=device, worlds=worlds)
        body.fix(held)
        u = np.zeros((2, len(mesh.points), 3))
        u[:, held, 1] = moved
        body.displacements = u.reshape(-1, 3)
        return body, wc.static_gradient(
            body,
            lambda x: (float(np.sum(weights * x.numpy())), weights),
            wrt=("boundary", "rest", "young", "obstacles"),
            gravity=gravity,
            obstacles=obstacle(np.zeros(3)),
            contact=CONTACT,
        )

    _, found = answer()
    h = 4e-4
    slope = (answer(h)[1].value - answer(-h)[1].value) / (2.0 * h)
    assert found.boundary[:, 1].sum() == pytest.approx(slope, abs=1e-3 * found.obstacles[0, 1])
    # Who moves floor and clamp together moves everything.
    everything = found.boundary[:, 1].sum() + found.obstacles[0, 1]
    assert everything == pytest.approx(weights[:, 1].sum(), rel=1e-3, abs=1e-4)
    assert found.young.shape == (2, 1)
    moved = weights.sum(axis=0) - found.obstacles[0] * (0.0, 1.0, 0.0)
    np.testing.assert_allclose(found.rest.sum(axis=0), moved, atol=1e-3 * np.abs(found.obstacles).max())


def test_places_that_friction_holds_stay_where_they_are(device, rng):
    """The same derivatives as with these nodes fixed, of other answers without contact."""
    mesh, held, obstacle, gravity = on_floor(device)
    weights = rng.normal(size=mesh.points.shape) / len(mesh.points)
    names = ("young", "poisson", "gravity", "obstacles", "loads")
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), device=device)
    body.fix(held)
    found = wc.static_gradient(
        body,
        lambda x: (float(np.sum(weights * x.numpy())), weights),
        wrt=names,
        gravity=gravity,
        obstacles=obstacle(np.zeros(3)),
        contact=wc.Contact(friction=2.0),
    )
    stuck = sorted({node for contact in found.report.contacts for node in contact.nodes})
    assert max(np.linalg.norm(contact.friction_force) for contact in found.report.contacts) > 1e-3
    rested = body.displacements.numpy().astype(float)
    pushed = np.argmax(np.abs(found.loads).sum(axis=1))

    def value(young=5e3, poisson=0.4, gravity=gravity, by=(0.0, 0.0, 0.0), load=(0.0, 0.0, 0.0)):
        other = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), device=device)
        u = rested.copy()
        u[stuck] += by
        other.displacements = u
        other.fix(held)
        other.fix(stuck)
        other.load([pushed], load)
        # Differences of answers in float32 scatter by half a percent.
        report = wc.solve_static(other, gravity=gravity, precision="float64")
        assert report.converged
        return np.sum(weights * (mesh.points + report.displacements))

    size = np.abs(found.obstacles).max()
    assert found.young == pytest.approx((value(young=5.1e3) - value(young=4.9e3)) / 200.0, rel=2e-3)
    assert found.poisson == pytest.approx((value(poisson=0.402) - value(poisson=0.398)) / 0.004, rel=2e-3)
    for axis in np.eye(3):
        slope = (value(by=4e-4 * axis) - value(by=-4e-4 * axis)) / 8e-4
        assert found.obstacles[0] @ axis == pytest.approx(slope, abs=2e-3 * size)
        more = (value(gravity=gravity + 0.05 * axis) - value(gravity=gravity - 0.05 * axis)) / 0.1
        assert found.gravity @ axis == pytest.approx(more, abs=2e-3 * np.abs(found.gravity).max())
        loads = (value(load=1e-3 * axis) - value(load=-1e-3 * axis)) / 2e-3
        assert found.loads[pushed] @ axis == pytest.approx(loads, abs=2e-3 * np.abs(found.loads[pushed]).max())
    assert not found.loads[stuck].any()


def test_what_has_no_gradient_is_refused(device):
    mesh, held, obstacle, gravity = on_floor(device)
    body = wc.SoftBody(mesh, wc.Isotropic(5e3, 0.4, 1000.0), device=device)
    body.fix(held)
    given = {"gravity": gravity, "obstacles": obstacle(np.zeros(3))}

    def objective(x):
        return 0.0, np.ones_like(x.numpy())

    with pytest.raises(wc.InputError, match=r"\d of \d contacts slip; gradients need friction that sticks"):
        wc.static_gradient(body, objective, contact=wc.Contact(friction=0.01), **given)
    with pytest.raises(wc.InputError, match="it must be a Contact"):
        wc.static_gradient(body, objective, contact="none", **given)
    far = wc.static_gradient(
        body,
        objective,
        wrt=("obstacles", "young"),
        gravity=(0.0, 0.0, 0.0),
        obstacles=wc.Ground((0.0, 1.0, 0.0), -1.0),
        contact=CONTACT,
    )
    assert not far.obstacles.any()
