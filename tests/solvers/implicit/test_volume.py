"""Static answers of bodies that hardly change their volume, and what leads to them."""

import numpy as np
import pytest
from cases import CUBE

import warp_corot as wc
from warp_corot.solvers.implicit.static import limited, limits

GRAVITY = (0.0, -9.8, 0.0)


def forest(level=6):
    return wc.TetForest.box((1, 1, 3), CUBE, level)


def graded():
    return wc.TetForest.from_domain(wc.Domain.sphere(0.05, device="cpu"), 0.04, max_level=5, min_level=2)


def general():
    mesh = forest(3)
    return wc.TetMesh(mesh.points, mesh.tets)


def moved(mesh, worlds, rng):
    u = 0.05 * rng.standard_normal((worlds * len(mesh.points), 3)) * np.cbrt(mesh.volumes.min())
    return u.astype(np.float32)


@pytest.mark.parametrize("make", [forest, graded, general])
@pytest.mark.parametrize("dilatation", ["shared", "element"])
def test_a_limited_lambda_is_that_of_another_material(make, dilatation, device, rng):
    """Forces are those of elements of the smaller ratio, and afterwards they are the original ones."""
    mesh = make()
    young, poisson = rng.uniform(1e3, 2e3, len(mesh.tets)), rng.uniform(0.3, 0.4999, len(mesh.tets))
    u = moved(mesh, 2, rng)
    mu, ratio = young / (2.0 * (1.0 + poisson)), 2.0 * poisson / (1.0 - 2.0 * poisson)
    least = np.minimum(ratio, 4.0)
    nu = least / (2.0 * (1.0 + least))

    def forces(young, poisson, limit=None):
        body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), worlds=2, device=device)
        body.displacements = u
        field = wc.Corotated(dilatation=dilatation).bind(body)
        found = [field.elastic_forces(body.state.displacements).numpy().copy()]
        if limit is not None:
            with limited(field, limit):
                found.append(field.elastic_forces(body.state.displacements).numpy().copy())
            found.append(field.elastic_forces(body.state.displacements).numpy().copy())
        return found

    before, within, after = forces(young, poisson, 4.0)
    (right,) = forces(2.0 * mu * (1.0 + nu), nu)
    largest = np.abs(right).max()
    assert np.abs(within - right).max() < 1e-5 * largest
    assert np.abs(before - right).max() > 1e-2 * largest
    assert np.abs(after - before).max() <= (0.0 if device == "cpu" else 1e-5) * np.abs(before).max()


@pytest.mark.parametrize(
    ("poisson", "expected"), [(0.4, []), (0.49, [4.0]), (0.499, [4.0, 40.0]), (0.4999, [4.0, 40.0, 400.0])]
)
def test_limits_end_before_the_material(poisson, expected):
    body = wc.SoftBody(forest(3), wc.Isotropic(1e3, poisson, 1000.0), device="cpu")
    assert limits(wc.Corotated().bind(body)) == expected


@pytest.mark.parametrize("model", [wc.Corotated(), wc.NeoHookean()])
def test_soft_bodies_come_to_rest_in_few_iterations(model, device):
    """A beam of 3 kPa that hangs straight down; without intermediate states it took more than 700 iterations."""
    body = wc.SoftBody(forest(6), wc.Isotropic(3e3, 0.4999, 1060.0), device=device)
    body.fix("z == zmin")
    report = wc.solve_static(body, model=model, gravity=GRAVITY)
    assert report.converged
    assert report.iterations < 100  # 29 to 55 were seen; on CUDA sums come in any order, and the way differs
    volumes = np.abs(np.linalg.det(_edges(body))).sum() / 6.0
    assert volumes == pytest.approx(body.mesh.volumes.sum(), rel=5e-3)
    again = wc.solve_static(body, model=model, gravity=GRAVITY)
    assert again.iterations <= 3


def _edges(body):
    x = body.positions.numpy().astype(float)[body.mesh.tets]
    return x[:, 1:] - x[:, :1]
