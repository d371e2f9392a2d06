"""The corotated stress in closed form against the polar decomposition in float64, for strains of every size."""

import numpy as np
import oracle
import pytest
import warp as wp

from warp_corot.kernels.corotated.corotated import corotated_energy, corotated_stress, stretch_stress
from warp_corot.kernels.elements.simd8 import LAW_HEADERS

wp.set_module_options({"extra_build_options": LAW_HEADERS})

MU, LAM = 1.0, 9.0


@wp.kernel(enable_backward=False)
def stresses(
    a: wp.array[wp.mat33], mu: float, lam: float, p: wp.array[wp.mat33], q: wp.array[wp.mat33], ok: wp.array[wp.int32]
):
    i = wp.tid()
    of_near, trusted = stretch_stress(a[i], mu, lam)
    p[i] = of_near
    q[i] = corotated_stress(a[i], mu, lam)
    ok[i] = int(trusted)


def stress_of(A, device):
    """The stress in closed form, that for any A, and where the former is reliable."""
    p, q = (wp.empty(len(A), dtype=wp.mat33, device=device) for _ in range(2))
    ok = wp.empty(len(A), dtype=wp.int32, device=device)
    inputs = [wp.array(A, dtype=wp.mat33, device=device), MU, LAM]
    wp.launch(stresses, len(A), inputs=inputs, outputs=[p, q, ok], device=device)
    return p.numpy(), q.numpy(), ok.numpy().astype(bool)


@wp.kernel(enable_backward=False)
def energies(a: wp.array[wp.mat33], mu: float, lam: float, density: wp.array[wp.float32]):
    i = wp.tid()
    density[i] = corotated_energy(a[i], mu, lam)


def assert_energies(A, device, most):
    """Relative to the energy of each, whatever part of it lambda makes: for lambda of zero and for a large one."""
    F = np.eye(3) + A.astype(float)
    strain = np.swapaxes(oracle.polar(F), 1, 2) @ F - np.eye(3)
    strain = 0.5 * (strain + np.swapaxes(strain, 1, 2))
    for lam in (0.0, LAM):
        found = wp.empty(len(A), dtype=wp.float32, device=device)
        inputs = [wp.array(A, dtype=wp.mat33, device=device), MU, lam]
        wp.launch(energies, len(A), inputs=inputs, outputs=[found], device=device)
        traces = np.trace(strain, axis1=1, axis2=2)
        exact = MU * np.sum(strain**2, axis=(1, 2)) + 0.5 * lam * traces**2
        assert (np.abs(found.numpy() - exact) / exact).max() < most


def expected(A):
    F = np.eye(3) + A.astype(float)
    R = oracle.polar(F)
    strain = np.swapaxes(R, 1, 2) @ F - np.eye(3)
    return R @ (2 * MU * strain + LAM * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3))


def relative_error(P, exact):
    return np.linalg.norm(P - exact, axis=(1, 2)) / np.linalg.norm(exact, axis=(1, 2))


def of_stretches(rng, low, high, count=5000):
    """Displacement gradients of random rotations and principal stretches."""
    turn, axes = (oracle.polar(rng.standard_normal((count, 3, 3))) for _ in range(2))
    sigma = np.exp(rng.uniform(np.log(low), np.log(high), (count, 3)))
    return (turn @ np.einsum("tij,tj,tkj->tik", axes, sigma, axes) - np.eye(3)).astype(np.float32)


@pytest.mark.parametrize("size", [1e-6, 1e-4, 1e-2, 0.1, 0.3])
def test_small_strains_keep_their_digits(size, device, rng):
    """Relative to the stress: C - I is a sum of terms that are no larger than it is."""
    A = (size * rng.uniform(-1, 1, (5000, 3, 3))).astype(np.float32)
    P, Q, ok = stress_of(A, device)
    assert ok.all()
    # In float64 the reference itself loses 1e-16 / size.
    assert relative_error(P, expected(A)).max() < 1e-5
    # Two places of one function, where a compiler may fuse other products and sums.
    np.testing.assert_allclose(P, Q, rtol=0, atol=3e-7 * np.abs(P).max())


@pytest.mark.parametrize(("low", "high"), [(0.8, 1.25), (0.5, 2.0), (0.35, 4.0)])
def test_large_strains_and_rotations(low, high, device, rng):
    """Relative to the modulus times the stretch: C - I of a rotated F has the rounding of numbers of order C."""
    A = of_stretches(rng, low, high)
    exact = expected(A)
    P, Q, ok = stress_of(A, device)
    assert ok.mean() > 0.99
    scale = LAM * high**2
    assert np.abs(P - exact)[ok].max() < 1e-5 * scale
    assert np.abs(Q - exact).max() < 1e-5 * scale


def test_turned_over_and_flat(device, rng):
    """Inverted and flat F with defined rotations."""
    F = rng.standard_normal((5000, 3, 3))
    _, sigma, _ = np.linalg.svd(F)
    F = F[sigma[:, 1] + np.sign(np.linalg.det(F)) * sigma[:, 2] > 0.1 * sigma[:, 0]]
    A = (F - np.eye(3)).astype(np.float32)
    exact = expected(A)
    _, Q, ok = stress_of(A, device)
    assert 0.3 < ok.mean() < 0.8
    assert np.abs(Q - exact).max() < 1e-4 * np.abs(exact).max()


def test_anything_is_finite(device, rng):
    """Zero, tiny and huge F; unreliable elements add nothing."""
    F = np.concatenate([s * rng.standard_normal((100, 3, 3)) for s in (0.0, 1e-30, 1e-15, 1.0, 1e15)])
    P, Q, ok = stress_of((F - np.eye(3)).astype(np.float32), device)
    assert (P[~ok] == 0).all()
    assert np.isfinite(Q).all()


@pytest.mark.parametrize("size", [1e-6, 1e-4, 1e-2, 0.1, 0.3])
def test_energies_of_small_strains_keep_their_digits(size, device, rng):
    assert_energies((size * rng.uniform(-1, 1, (5000, 3, 3))).astype(np.float32), device, 1e-5)


def test_energies_of_turned_strains(device, rng):
    """In float32 F has the strain only to 1e-7."""
    assert_energies(of_stretches(rng, 0.95, 1.05), device, 2e-4)
    assert_energies(of_stretches(rng, 0.4, 3.0), device, 2e-4)


def test_energies_of_crushed_and_turned_over_elements(device, rng):
    A = of_stretches(rng, 0.01, 3.0)
    assert_energies(A[np.linalg.det(np.eye(3) + A) > 1e-4], device, 1e-4)
    F = np.eye(3) + of_stretches(rng, 0.3, 3.0)
    F[:, 0] *= -1.0
    s = np.linalg.svd(F, compute_uv=False)
    definite = s[:, 1] - s[:, 2] > 0.05 * s[:, 0]
    assert definite.mean() > 0.5
    assert_energies((F[definite] - np.eye(3)).astype(np.float32), device, 1e-4)
