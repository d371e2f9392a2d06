"""K p of anisotropic materials, which is exact, and of active stress, against differences of the oracle's forces."""

import numpy as np
import oracle
import pytest
from cases import MESHES, mixed_forest, oracle_mesh, random_displacement
from fibres import made, random_axes, wood, wood_tensor
from tangents import (
    assert_diagonal,
    assert_equal,
    assert_keeps_translations,
    assert_symmetric,
    difference,
    product,
)

import warp_corot as wc

CASES = ("level 3", "level 4", "level 5", "mixed levels", "general")
#: Kernels of general meshes are the same code of another kind of elements, and compile for seconds.
SHORTENED = [pytest.param(case, marks=pytest.mark.slow) if case == "general" else case for case in CASES]
SHORTENED_ENDS = [SHORTENED[0], SHORTENED[-1]]


def bound(mesh, material, device, model=None, **options):
    body = wc.SoftBody(mesh, material, device=device, **options)
    return (model or wc.Corotated()).bind(body), body


def turned(mesh, rng, amount):
    u = random_displacement(mesh, rng, amount)
    return ((mesh.points + u) @ random_axes(rng).T - mesh.points).astype(np.float32)


def definiteness(F):
    """(s1 + s2)(s2 + s3)(s3 + s1) / |s|^3; below 0.4 the law blends into the isotropic one [T]."""
    s = np.linalg.svd(F, compute_uv=False)
    s[:, 2] *= np.sign(np.linalg.det(F))
    return np.prod(s + np.roll(s, 1, axis=1), axis=1) / np.linalg.norm(s, axis=1) ** 3


def expected(mesh, tensor, u, p, active=None):
    """The expected product; ``active`` are the stress [T] and direction [T, 3] of active fibres."""
    reference = oracle_mesh(mesh)
    tensor = np.broadcast_to(tensor, (len(mesh.tets), 3, 3, 3, 3))

    def density(F, mu, lam):
        psi, P = oracle.anisotropic(F, tensor)
        return psi, P if active is None else P + oracle.active(F, *active)

    return difference(
        lambda x: oracle.continuum(density, reference, x, None, None)[1], reference.points + u.astype(float), p
    )


@pytest.mark.parametrize("case", SHORTENED)
@pytest.mark.parametrize("kind", ["muscle", "wood field"])
def test_product_equals_differences_of_the_oracles_forces(kind, case, device, rng):
    mesh = MESHES[case]()
    material, tensor = made(kind, mesh, rng)
    field, _ = bound(mesh, material, device)
    u, p = turned(mesh, rng, 0.1), random_displacement(mesh, rng, 1.0)
    assert_equal(product(field, u, p), expected(mesh, tensor, u, p))
    assert_symmetric(field, mesh, u, rng)
    assert_keeps_translations(field, u, rng)
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False))


def separate(rng, count, stretches):
    """Elements without common nodes, their stretches [count, 3] in random orientations, and a nodal p."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + rng.uniform(-0.1, 0.1, (count, 4, 3))
    mesh = wc.TetMesh(0.1 * corners.reshape(-1, 3), np.arange(4 * count).reshape(-1, 4))
    F = random_axes(rng, count) * stretches[:, None] @ random_axes(rng, count)
    x = np.einsum("tij,tnj->tni", F, mesh.points[mesh.tets]).reshape(-1, 3)
    points = mesh.points[mesh.tets].reshape(-1, 3)
    order = mesh.tets.ravel()
    u = np.empty_like(points)
    u[order] = x - points
    return mesh, u.astype(np.float32)


def test_elements_where_the_law_goes_over_to_the_isotropic_one(device, rng):
    """Single elements, crushed and inverted ones included: in the blend, K has the derivatives of both laws
    and of their weights. Where rotations are nearly undefined, float32's K is bounded but inexact: left out."""
    count = 1000
    stretches = np.exp(rng.uniform(np.log(0.2), np.log(3.0), (count, 3)))
    stretches[:, 2] *= np.where(rng.random(count) < 0.3, -0.3, 1.0)
    mesh, u = separate(rng, count, stretches)
    axes = random_axes(rng, count)
    field, _ = bound(mesh, wood(axes), device)
    p = random_displacement(mesh, rng, 1.0)
    found, reference = product(field, u, p), expected(mesh, wood_tensor(axes), u, p)
    F = oracle_mesh(mesh).deformation_gradients(mesh.points + u.astype(float))
    definite = definiteness(F)
    between, isotropic = (definite > 0.05) & (definite < 0.395), definite < 0.05
    # Within a difference step of the border of the laws, where the second derivative jumps.
    apart = np.abs(definite - 0.4) > 5e-3
    assert between.sum() > 100
    assert isotropic.sum() > 10
    error, largest = (np.linalg.norm(v[mesh.tets], axis=(1, 2)) for v in (found - reference, reference))
    error /= largest
    print(f"{error[between & apart].max():.1e} between, {error[(definite > 0.4) & apart].max():.1e} beyond")
    assert np.isfinite(found).all()
    assert error[(definite > 0.4) & apart].max() < 1e-5
    assert error[between & apart].max() < 1e-4


@pytest.mark.parametrize("case", SHORTENED_ENDS)
def test_active_stress(case, device, rng):
    """s (F d) d^T is linear in F: its part of K is exact and uses the current stress."""
    mesh = MESHES[case]()
    count = len(mesh.tets)
    material, tensor = made("muscle field", mesh, rng)
    field, body = bound(mesh, material, device)
    u, p = turned(mesh, rng, 0.1), random_displacement(mesh, rng, 1.0)
    passive = product(field, u, p)
    stress = rng.uniform(-2e3, 2e3, count)
    body.activate(stress)
    direction = body.material.direction / np.linalg.norm(body.material.direction, axis=-1, keepdims=True)
    reference = expected(mesh, tensor, u, p, (stress.astype(np.float32).astype(float), direction))
    found = product(field, u, p)
    assert_equal(found, reference)
    assert np.abs(found - passive).max() > 1e-2 * np.abs(found).max()
    assert_symmetric(field, mesh, u, rng)


def test_filled_share_and_worlds(device, rng):
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=3)
    assert np.mean(mesh.fill != 1.0) > 0.2
    axes = random_axes(rng, 2, len(mesh.tets))
    field, _ = bound(mesh, wood(axes), device, worlds=2)
    states = [(turned(mesh, rng, 0.1), random_displacement(mesh, rng, 1.0)) for _ in range(2)]
    u, p = (np.concatenate(values) for values in zip(*states, strict=True))
    tensors = wood_tensor(axes) * mesh.fill[:, None, None, None, None]
    reference = np.concatenate([expected(mesh, t, *state) for t, state in zip(tensors, states, strict=True)])
    assert_equal(product(field, u, p), reference)
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False))


def test_other_rotations_give_the_same(device, rng):
    mesh = mixed_forest()
    material, _ = made("wood", mesh, rng)
    u, p = turned(mesh, rng, 0.1), random_displacement(mesh, rng, 1.0)
    products = [product(bound(mesh, material, device, each)[0], u, p) for each in (wc.Corotated(rotation="svd"), None)]
    assert_equal(*products)
