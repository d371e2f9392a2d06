"""The rotation of any F without a guess, well defined or not: the maximiser of tr(R^T F)."""

import numpy as np
import oracle
import pytest
import warp as wp

from warp_corot.kernels.math.quaternion import robust_rotation

COUNT = 20_000


@wp.kernel(enable_backward=False)
def robust_rotations(f: wp.array[wp.mat33], r: wp.array[wp.mat33]):
    i = wp.tid()
    r[i] = robust_rotation(f[i])


def rotations(F, device):
    r = wp.empty(len(F), dtype=wp.mat33, device=device)
    wp.launch(robust_rotations, len(F), [wp.array(F, dtype=wp.mat33, device=device)], [r], device=device)
    return r.numpy().astype(float)


def signed(rng, spread, mirrored):
    """Singular values around one, with the sign of det F on the smallest, as in the following functions."""
    sigma = np.sort(np.exp(rng.normal(0.0, spread, (COUNT, 3))))[:, ::-1]
    return sigma * [1, 1, -1 if mirrored else 1]


def nearly(rng, sigma, largest):
    """Off by any power of ten up to ``largest``."""
    return sigma * (1 + 10.0 ** rng.uniform(-8, np.log10(largest), (COUNT, 3)) * rng.choice([-1, 1], (COUNT, 3)))


STRETCHES = {
    "the right way round": lambda rng: signed(rng, 0.5, False),
    "turned over": lambda rng: signed(rng, 0.5, True),
    "strongly stretched": lambda rng: signed(rng, 2.0, True),
    "flat": lambda rng: signed(rng, 0.5, True) * [1, 1, 0],
    "nearly flat": lambda rng: signed(rng, 0.5, True) * np.c_[np.ones((COUNT, 2)), 10.0 ** rng.uniform(-8, 0, COUNT)],
    "a line": lambda rng: signed(rng, 0.5, False) * [1, 0, 0],
    "nearly a line": lambda rng: signed(rng, 0.5, True) * np.c_[np.ones(COUNT), 10.0 ** rng.uniform(-8, 0, (COUNT, 2))],
    "two alike": lambda rng: nearly(rng, np.array([2, 1, -1]), 0.3),
    "three alike": lambda rng: nearly(rng, np.array([1, 1, -1]), 0.1),
}


def matrices(sigma, rng):
    first, second = (oracle.polar(rng.standard_normal((len(sigma), 3, 3))) for _ in range(2))
    return np.einsum("tij,tj,tkj->tik", first, sigma, second).astype(np.float32)


def exact(F):
    """The rotation, its trace and sigma_2 + sign(det F) sigma_3, by the SVD; F of order one."""
    U, sigma, Vt = np.linalg.svd(F.astype(float))
    sign = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= sign[:, None]
    sigma[:, 2] *= sign
    return U @ Vt, sigma.sum(1), sigma[:, 1] + sigma[:, 2]


@pytest.mark.parametrize("kind", STRETCHES)
def test_the_maximiser_of_every_matrix(kind, device, rng):
    """The result is a rotation with the largest trace, and, where that is unique, the right one.

    Where singular values meet, many rotations have the largest trace: the trace may be off by 5e-3 of |F| there.
    """
    F = matrices(STRETCHES[kind](rng), rng)
    R = rotations(F, device)
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 3e-6
    assert (np.linalg.det(R) > 0.99).all()
    best, trace, gap = exact(F)
    norm = np.linalg.norm(F, axis=(1, 2))
    lost = (trace - np.einsum("tij,tij->t", R, F)) / norm
    assert lost.max() < 6e-3
    error = np.linalg.norm(R - best, axis=(1, 2))
    assert error[gap > 0.1 * norm].max(initial=0.0) < 1e-5
    assert lost[gap > 0.1 * norm].max(initial=0.0) < 2e-6
    if kind != "three alike":
        assert error[gap > 0.01 * norm].max(initial=0.0) < 2e-4


@pytest.mark.parametrize("scale", [1e-42, 1e-30, 1e-15, 1e15, 1e30, 3e38])
def test_the_size_of_the_matrix_does_not_matter(scale, device, rng):
    """From denormals to the largest float."""
    F = matrices(signed(rng, 0.3, True)[:1000], rng)
    F /= np.abs(F).max(axis=(1, 2), keepdims=True)
    best, _, gap = exact(F)
    R = rotations((F * scale).astype(np.float32), device)
    digits = 1e-5 if scale > 1e-38 else 5e-2
    assert np.linalg.norm(R - best, axis=(1, 2))[gap > 0.2].max() < digits


def test_zero_and_invalid_matrices_give_the_identity(device):
    F = np.tile(np.eye(3, dtype=np.float32), (31, 1, 1))
    for entry in range(9):
        for k, value in enumerate((np.nan, np.inf, -np.inf)):
            F[9 * k + entry].flat[entry] = value
    F[27:] = 0.0
    F[28] = np.nan
    assert np.array_equal(rotations(F, device), np.tile(np.eye(3), (31, 1, 1)))


def test_the_rotation_is_a_function_of_the_matrix_alone(device, rng):
    """It does not depend on neighbours or on earlier calls."""
    F = np.concatenate([matrices(make(rng)[:2000], rng) for make in STRETCHES.values()])
    order = rng.permutation(len(F))
    R = rotations(F, device)
    assert np.array_equal(rotations(F[order], device), R[order])


def test_continuous_on_the_way_through_inversion(device, rng):
    """|dR| <= 2 |dF| / (sigma_2 + sign(det F) sigma_3), along paths from one side to the other."""
    t = np.linspace(0.0, 1.0, 401)[:, None, None]
    seen = 0
    for _ in range(40):
        start, end = np.eye(3) + 0.2 * rng.standard_normal((2, 3, 3))
        F = (1 - t) * (start @ np.diag([1, 0.9, 0.4])) + t * (end @ np.diag([1, 0.9, -0.4]))
        _, _, gap = exact(F)
        if gap.min() < 0.2 or np.linalg.det(F).min() > 0:
            continue
        seen += 1
        R = rotations(F.astype(np.float32), device)
        bound = 2 * np.linalg.norm(F[1] - F[0]) / gap.min()
        assert np.linalg.norm(np.diff(R, axis=0), axis=(1, 2)).max() < 1.1 * bound + 1e-5
    assert seen > 10
