"""Gradients of static answers of bodies that touch themselves, against central differences of other answers."""

import numpy as np
import pytest

import warp_corot as wc

CONTACT = wc.Contact(friction=0.0, self_contact=True)


def rotation():
    a, b = np.radians(40.0), np.radians(33.0)
    about_x = np.array(((1, 0, 0), (0, np.cos(a), -np.sin(a)), (0, np.sin(a), np.cos(a))))
    about_y = np.array(((np.cos(b), 0, np.sin(b)), (0, 1, 0), (-np.sin(b), 0, np.cos(b))))
    return about_y @ about_x


def pieces():
    """A body of two pieces: a block, and above it a cube that points down to the middle of one of its triangles."""
    low, high = wc.TetForest.box((1, 1, 1), 0.02, 3), wc.TetForest.box((1, 1, 1), 0.012, 3)
    corners = low.points[wc.SoftBody(low, wc.Isotropic(2e4, 0.4, 1000.0), device="cpu").surface_triangles]
    centres = corners[(corners[:, :, 2] > 0.0199).all(axis=1)].mean(axis=1)
    at = centres[np.argmin(np.linalg.norm(centres[:, :2] - 0.0105, axis=1))]
    turned = high.points @ rotation().T
    turned += at + np.array((0.0, 0.0, 0.006)) - turned[np.argmin(turned[:, 2])]
    tets = np.concatenate([low.tets, high.tets + len(low.points)])
    return wc.TetMesh(np.concatenate([low.points, turned]), tets)


@pytest.mark.parametrize("axes", [(0,), pytest.param((1, 2), marks=pytest.mark.slow)])
def test_derivatives_are_those_of_other_answers(device, rng, axes):
    """The held top of the cube moves its corner into the block, which a load pushes aside."""
    mesh = pieces()
    x = mesh.points
    low, top = x[:, 2] < 1e-9, x[:, 2] > 0.036
    weights = np.where((low | top)[:, None], 0.0, rng.normal(size=x.shape) / len(x))
    loaded = int(np.argmin(np.abs(x - 0.02).sum(axis=1)))

    def body(young=2e4, poisson=0.4, by=(0.0, 0.0, 0.0), load=(0.0, 0.0, 0.0)):
        made = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), device=device)
        u = np.zeros(x.shape)
        u[top] = np.array((0.0, 0.0, -0.0066)) + by
        made.displacements = u
        made.fix(low | top)
        made.load([loaded], np.array((0.02, 0.01, -0.02)) + load)
        return made

    def value(**changes):
        made = body(**changes)
        report = wc.solve_static(made, gravity=(0.0, 0.0, 0.0), contact=CONTACT)
        assert report.converged
        assert len(report.contacts) == len(found.report.contacts) == 1
        return np.sum(weights * made.positions.numpy().astype(float))

    found = wc.static_gradient(
        body(),
        lambda at: (float(np.sum(weights * at.numpy())), weights),
        wrt=("young", "poisson", "boundary", "loads"),
        gravity=(0.0, 0.0, 0.0),
        contact=CONTACT,
    )
    assert found.report.contacts[0].normal_force > 0.01
    assert found.young == pytest.approx((value(young=2.02e4) - value(young=1.98e4)) / 400.0, rel=2e-3)
    # The last digit of the gap makes 0.2 to 0.3 % of a difference.
    differences = [(value(poisson=0.4 + h) - value(poisson=0.4 - h)) / (2.0 * h) for h in np.linspace(3e-3, 5e-3, 15)]
    assert found.poisson == pytest.approx(np.mean(differences), rel=2e-3)
    moved = found.boundary[top].sum(axis=0)
    for axis in np.eye(3)[list(axes)]:
        slope = (value(by=4e-5 * axis) - value(by=-4e-5 * axis)) / 8e-5
        assert moved @ axis == pytest.approx(slope, abs=2e-3 * np.abs(moved).max())
        slope = (value(load=5e-3 * axis) - value(load=-5e-3 * axis)) / 1e-2
        assert found.loads[loaded] @ axis == pytest.approx(slope, abs=2e-3 * np.abs(found.loads[loaded]).max())


def test_friction_with_itself_is_refused(device):
    body = wc.SoftBody(pieces(), wc.Isotropic(2e4, 0.4, 1000.0), device=device)
    body.fix("z < 1e-9")
    with pytest.raises(wc.InputError, match=r"touches itself with friction 0\.3"):
        wc.static_gradient(body, lambda x: (0.0, np.ones((len(x), 3))), contact=wc.Contact(self_contact=True))
