"""Shared helpers for tests of stiffness products: products and diagonal blocks of a field, and float64 references.

K p is a sum of float32 terms: derivatives of the stress times differences of p, some ten roundings of 6e-8 each. The
largest error found is 1.1e-6 of the largest value, for nearly incompressible neo-Hookean elements in a large rotation,
where lambda is 49 mu and amplifies a rounding of J; a wrong weight, sign or index is 1e-2 or more.
"""

import numpy as np
import oracle
import warp as wp
from cases import random_displacement

TOLERANCE = 5e-6  # of the largest value
#: Of a difference of fourth order: small against strains of order one, and far above float64's rounding.
STEP = 1e-4


def on_device(values, field, places=None):
    """vec4 [places] of float32 [n, 3]; zero beyond."""
    padded = np.zeros((places or len(values), 4), np.float32)
    padded[: len(values), :3] = values
    return wp.array(padded, dtype=wp.vec4, device=field.device)


def product(field, u, p, *, places=None, **options):
    """K(u) p [n, 3]."""
    y = on_device(np.zeros_like(p), field, places)
    field.add_stiffness(on_device(u, field, places), on_device(p, field, places), y, **options)
    found = y.numpy()
    assert not found[:, 3].any()
    return found[:, :3]


def tangent(field, u, *, places=None, **options):
    """K at displacements u."""
    made = field.tangent(**options)
    for step in (made.prepare, made.take):
        step(on_device(u, field, places))
    return made


def diagonal(field, u, *, places=None, **options):
    """The diagonal blocks of K(u) [n, 3, 3]."""
    blocks = wp.zeros(places or len(u), dtype=wp.mat33, device=field.device)
    tangent(field, u, places=places, **options).add_diagonal(blocks)
    return blocks.numpy()


def difference(forces, x, p):
    """-(df/dx) p of forces(x) by central differences of fourth order, all float64."""
    p = p.astype(float)
    near, far = (forces(x + k * STEP * p) - forces(x - k * STEP * p) for k in (1, 2))
    return (far - 8 * near) / (12 * STEP)


def rotated_product(mesh, rotations, mu, lam, p):
    """The paper's R K R^T p [N, 3], with a rotation [T, 3, 3] for each of the oracle mesh's elements."""
    K = oracle.stiffness(mesh, mu, lam).reshape(-1, 4, 3, 4, 3)
    turned = np.einsum("tji,tnj->tni", rotations, p.astype(float)[mesh.tets])
    return mesh.assemble(np.einsum("tij,tajbk,tbk->tai", rotations, K, turned))


def own_rotations(mesh, x):
    return oracle.polar(mesh.deformation_gradients(x))


def assert_equal(found, expected, nodes=slice(None), tolerance=TOLERANCE):
    error = np.abs(found - expected)[nodes].max() / np.abs(expected).max()
    print(f"{error:.1e} of the largest value")
    assert np.isfinite(found).all()
    assert error < tolerance


def assert_symmetric(field, mesh, u, rng, **options):
    """p . K q = q . K p, to the digits of the terms of these sums."""
    p, q = (random_displacement(mesh, rng, 1.0) for _ in range(2))
    pairs = [(a.astype(float) * product(field, u, b, **options)).ravel() for a, b in ((p, q), (q, p))]
    scale = max(np.linalg.norm(pair) for pair in pairs)
    error = abs(pairs[0].sum() - pairs[1].sum()) / scale
    print(f"asymmetry {error:.1e}")
    assert error < 2 * TOLERANCE


def assert_keeps_translations(field, u, rng, **options):
    """In any state, a translation changes no force, exactly, because differences of p are zero."""
    p = np.broadcast_to(rng.standard_normal(3), u.shape).astype(np.float32)
    assert not product(field, u, p, **options).any()


def assert_diagonal(field, u, nodes, **options):
    """The blocks are the products of K with unit vectors, at their own nodes."""
    blocks = diagonal(field, u, **options)
    assert np.isfinite(blocks).all()
    for node in nodes:
        for axis in range(3):
            unit = np.zeros_like(u)
            unit[node, axis] = 1.0
            found = product(field, u, unit, **options)[node]
            assert np.abs(found - blocks[node, :, axis]).max() < TOLERANCE * np.abs(blocks[node]).max()
