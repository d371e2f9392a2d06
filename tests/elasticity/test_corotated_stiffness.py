"""Corotated K p against R K R^T assembled in float64 from the oracle's rotations and small-strain stiffness.

The exact K, with the derivative of the rotations, is in ``test_stiffness_products``.
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import CUBE, MATERIAL, MESHES, edge_scale, jittered, mixed_forest, oracle_mesh, random_displacement
from shortened import crossed
from tangents import (
    assert_diagonal,
    assert_equal,
    assert_keeps_translations,
    assert_symmetric,
    difference,
    on_device,
    own_rotations,
    product,
    rotated_product,
)

import warp_corot as wc
from warp_corot.elasticity.corotated.tangents import RotatedTangent, SubtreeTangent, subtrees_of

MU, LAM = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
CASES = ("level 3", "level 4", "level 5", "mixed levels", "general")
OWN = {
    "byers-xu": {},
    "svd": {"rotation": "svd"},
    "leaf by leaf": {"subtrees": False},
}


def bound(mesh, device, **options):
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    return wc.Corotated(dilatation="element", **options).bind(body)


def turned(mesh, rng, amount):
    u = random_displacement(mesh, rng, amount)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    return ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)


def places(mesh, u):
    return mesh.points + u.astype(float)


def with_own_rotations(mesh, u, p):
    reference = oracle_mesh(mesh)
    return rotated_product(reference, own_rotations(reference, places(mesh, u)), MU, LAM, p)


def is_short(options, case):
    return case != "general" or options == "byers-xu"


@pytest.mark.parametrize(("options", "case"), crossed(OWN, CASES, is_short))
def test_own_rotations(options, case, device, rng):
    mesh = MESHES[case]()
    field = bound(mesh, device, **OWN[options])
    u, p = turned(mesh, rng, 0.1), random_displacement(mesh, rng, 1.0)
    assert_equal(product(field, u, p), with_own_rotations(mesh, u, p))
    assert_symmetric(field, mesh, u, rng)
    assert_keeps_translations(field, u, rng)


@pytest.mark.parametrize(
    ("options", "make"),
    crossed(["byers-xu", "svd"], [mixed_forest, jittered], lambda o, m: m is mixed_forest or o == "byers-xu"),
)
def test_diagonal_blocks_are_those_of_the_product(make, options, device, rng):
    mesh = make()
    u = turned(mesh, rng, 0.1)
    assert_diagonal(bound(mesh, device, **OWN[options]), u, rng.choice(len(u), 5, replace=False))


@pytest.mark.parametrize("case", ["level 3", "general"])
def test_inverted_elements(case, device, rng):
    """Nearly undefined rotations differ between methods: nodes of these elements are left out."""
    mesh = MESHES[case]()
    u, p = random_displacement(mesh, rng, 0.9), random_displacement(mesh, rng, 1.0)
    F = oracle_mesh(mesh).deformation_gradients(places(mesh, u))
    assert (np.linalg.det(F) < -0.1).sum() > 5
    sigma = np.linalg.svd(F, compute_uv=False)
    gap = sigma[:, 1] + sigma[:, 2] * np.sign(np.linalg.det(F))
    well = np.ones(len(mesh.points), bool)
    well[mesh.tets[gap < 0.1 * sigma[:, 0]]] = False
    assert well.sum() > 10
    assert_equal(product(bound(mesh, device), u, p), with_own_rotations(mesh, u, p), well)


@pytest.mark.parametrize("is_exact", [False, True])
@pytest.mark.parametrize("case", ["mixed levels", "general"])
def test_without_strain_both_are_the_derivative_of_the_forces(case, is_exact, device, rng):
    """The derivative of rotations is proportional to the stress: it vanishes in a body that is only rotated."""
    mesh = MESHES[case]()
    u, p = turned(mesh, rng, 0.0), random_displacement(mesh, rng, 1.0)
    reference = oracle_mesh(mesh)
    expected = difference(
        lambda x: oracle.evaluate("corotated", reference, x, MU, LAM)[1], reference.points + u.astype(float), p
    )
    assert_equal(product(bound(mesh, device), u, p, exact=is_exact), expected)


def test_semidefinite_unless_exact(device, rng):
    """p . K p >= 0 in any state; the exact K of a compressed body is negative in some directions."""
    mesh = mixed_forest()
    field = bound(mesh, device)
    u = (-0.5 * mesh.points + random_displacement(mesh, rng, 0.1)).astype(np.float32)
    values = []
    for options in ({}, {"exact": True}):
        values.append([np.sum(p * product(field, u, p, **options)) for p in rotations_of_elements(mesh, rng)])
    assert min(values[0]) > 0
    assert min(values[1]) < 0


def rotations_of_elements(mesh, rng):
    """Displacements that rotate the neighbourhood of a node, which compression favours."""
    for node in rng.choice(len(mesh.points), 20):
        offset = mesh.points - mesh.points[node]
        near = np.linalg.norm(offset, axis=1, keepdims=True) < 2 * edge_scale(mesh)
        yield (near * np.cross(rng.standard_normal(3), offset)).astype(np.float32)


@pytest.mark.parametrize("is_fast", [True, False])
@pytest.mark.parametrize("rotation_level", [0, 2, 3])
@pytest.mark.parametrize("make", [lambda: wc.TetForest.box((1, 1, 1), CUBE, 5), mixed_forest], ids=["uniform", "mixed"])
def test_rotations_of_ancestors(make, rotation_level, is_fast, device, rng):
    mesh = make()
    field = bound(mesh, device, rotation_level=rotation_level, subtrees=is_fast)
    u, p = turned(mesh, rng, 0.1), random_displacement(mesh, rng, 1.0)
    above = oracle.Mesh(mesh.points, mesh.tree.tets[mesh.ancestors(rotation_level)])
    rotations = own_rotations(above, places(mesh, u))
    assert_equal(product(field, u, p), rotated_product(oracle_mesh(mesh), rotations, MU, LAM, p))
    assert_symmetric(field, mesh, u, rng)
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False))


@pytest.mark.parametrize("level", [6, *(pytest.param(level, marks=pytest.mark.slow) for level in (7, 8))])
def test_rotations_within_a_tolerance(level, device, rng):
    """Forces of subtrees have their root's rotation if it is close; K has each element's own."""
    tolerance = 0.1
    mesh = wc.TetForest.box((1, 1, 1), CUBE, level)
    # Strains grow along the body: only some subtrees share their root's rotation.
    amount = np.where(mesh.points[:, 2:] < 0.5 * CUBE, 0.01, 0.12)
    scale = edge_scale(mesh) * amount * rng.uniform(-1, 1, mesh.points.shape)
    turn = oracle.polar(rng.standard_normal((3, 3)))
    u = ((mesh.points + scale) @ turn.T - mesh.points).astype(np.float32)
    p = random_displacement(mesh, rng, 1.0)
    reference, x = oracle_mesh(mesh), places(mesh, u)
    own = own_rotations(reference, x)
    near, share = near_rotations(mesh, x, own, tolerance)
    assert 0.1 < share < 0.9
    # On CUDA bodies with few leaves have own rotations at any tolerance; forces show which.
    field = bound(mesh, device, rotation_level=tolerance)
    forces = field.elastic_forces(on_device(u, field)).numpy()[:, :3]
    expected = [oracle.evaluate("corotated", reference, x, MU, LAM, R=R)[1] for R in (near, own)]
    errors = [np.abs(forces - f).max() / np.abs(f).max() for f in expected]
    if field.device.is_cpu:
        assert errors[0] < 1e-5 < errors[1]
    assert_equal(product(field, u, p), rotated_product(reference, own, MU, LAM, p))
    assert_diagonal(field, u, rng.choice(len(u), 2, replace=False))


def near_rotations(mesh, x, own, tolerance):
    """The rotation of each leaf: its ancestor's three levels up if in all eight leaves R^T F - I has a skew part of at
    most the tolerance and a symmetric part of at most 1/2. Also returns the number of these leaves."""
    roots, subtree = np.unique(mesh.tree.above(mesh.tree.leaves, 3), return_inverse=True)
    assert 8 * len(roots) == len(mesh.tets)
    R = own_rotations(oracle.Mesh(mesh.points, mesh.tree.tets[roots]), x)[subtree]
    E = np.swapaxes(R, 1, 2) @ oracle_mesh(mesh).deformation_gradients(x) - np.eye(3)
    symmetric, skew = 0.5 * (E + np.swapaxes(E, 1, 2)), 0.5 * (E - np.swapaxes(E, 1, 2))
    apart = np.maximum(np.linalg.norm(skew, axis=(1, 2)) / tolerance, np.linalg.norm(symmetric, axis=(1, 2)) / 0.5)
    most = np.zeros(len(roots))
    np.maximum.at(most, subtree, apart)
    assert np.abs(most - 1.0).min() > 1e-4  # rounding does not decide
    is_near = (most <= 1.0)[subtree]
    return np.where(is_near[:, None, None], R, own), is_near.mean()


@pytest.mark.slow
@pytest.mark.parametrize("level", [3, 4, 5])
def test_products_over_subtrees_are_the_same(level, device, rng):
    """As large bodies on CUDA have them: subtrees of each type in two worlds, with a modulus for each element."""
    mesh = wc.TetForest.box((1, 1, 1), CUBE, level)
    young = MATERIAL["young"] * rng.uniform(0.5, 2.0, len(mesh.tets))
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.3, MATERIAL["density"]), worlds=2, device=device)
    field = wc.Corotated(dilatation="element").bind(body)
    batches = subtrees_of(field.plan)
    assert batches
    u, p = (np.concatenate([turned(mesh, rng, 0.2) for _ in range(2)]) for _ in range(2))
    found = []
    for tangent in (RotatedTangent(field), SubtreeTangent(field, batches)):
        tangent.prepare(on_device(u, field))
        tangent.take(on_device(u, field))
        y, blocks = on_device(np.zeros_like(p), field), wp.zeros(len(u), dtype=wp.mat33, device=device)
        tangent.add_product(on_device(p, field), y)
        tangent.add_diagonal(blocks)
        found.append((y.numpy()[:, :3], blocks.numpy()))
    assert_equal(found[1][0], found[0][0])
    np.testing.assert_array_equal(found[1][1], found[0][1])


def test_large_bodies_on_cuda_have_products_over_subtrees(device, monkeypatch):
    monkeypatch.setattr("warp_corot.elasticity.corotated.fields.FEWEST", 1)
    field = bound(wc.TetForest.box((1, 1, 1), CUBE, 6), device)
    assert isinstance(field.tangent(), SubtreeTangent) == field.device.is_cuda
    assert not isinstance(field.tangent(exact=True), SubtreeTangent)
    assert subtrees_of(bound(mixed_forest(), device).plan) is None
