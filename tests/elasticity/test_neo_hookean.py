"""Neo-Hookean outside the plain law: below J = 0.5 its volumetric energy is a parabola."""

import numpy as np
import oracle
import pytest
from cases import oracle_mesh, place, simulation

import warp_corot as wc

#: J below which the volumetric energy is its own Taylor polynomial.
CONTINUED_BELOW = 0.5
MU, LAM = oracle.lame(5e3, 0.4)
MATERIAL = {"young": 5e3, "poisson": 0.4, "density": 1000.0}


def random_gradients(rng, count, low, high):
    """F [count, 3, 3] with principal stretches from low to high, negative ones if low is negative."""
    turns = oracle.polar(rng.standard_normal((2, count, 3, 3)))
    return turns[0] * rng.uniform(low, high, (count, 1, 3)) @ turns[1]


def stiffness(F):
    """Largest singular value of dP/dF [T] (Pa), by central differences of P."""
    step, count = 1e-5, len(F)
    columns = []
    for i, j in np.ndindex(3, 3):
        d = np.zeros((3, 3))
        d[i, j] = step
        difference = oracle.neo_hookean(F + d, MU, LAM)[1] - oracle.neo_hookean(F - d, MU, LAM)[1]
        columns.append(difference.reshape(count, 9) / (2 * step))
    return np.linalg.norm(np.stack(columns, axis=-1), ord=2, axis=(1, 2))


def test_stiffness_is_bounded_however_crushed_and_turned_over(rng):
    """At most mu + 2 s |U'| + U'' |cof F|^2 for stretches of magnitude up to s = 1, with U'' at most that at J = 0.5
    and U' steepest at J = -1. (The second derivative of det F is at most 2 s.) At rest it is 2 mu + 3 lambda."""
    F = random_gradients(rng, 5000, -1.0, 1.0)
    assert np.linalg.det(F).min() < -0.8
    curvature = 4 * (MU + LAM * (1 + np.log(2)))
    slope = 2 * (MU + LAM * np.log(2)) + 1.5 * curvature
    bound = MU + 2 * slope + 3 * curvature
    assert bound == pytest.approx(29 * MU + 43.4 * LAM, rel=0.01)
    assert stiffness(F).max() < bound
    # Crushed to any volume, but not inverted.
    rest = 2 * MU + 3 * LAM
    crushed = F[(np.linalg.det(F) > 0) & (np.linalg.det(F) < 0.5)]
    print(stiffness(F).max() / rest, stiffness(crushed).max() / rest)
    assert stiffness(crushed).max() < 5 * rest
    assert stiffness(np.eye(3)[None]) == pytest.approx(rest, rel=1e-6)


def test_stress_is_the_derivative_of_the_energy(rng):
    """On both sides of J = 0.5 and across it."""
    F = random_gradients(rng, 300, -1.5, 1.5)
    F[:100] *= np.cbrt(CONTINUED_BELOW / np.linalg.det(F[:100]))[:, None, None]
    _, P = oracle.neo_hookean(F, MU, LAM)
    d = 1e-4 * rng.standard_normal(F.shape)
    slope = oracle.neo_hookean(F + d, MU, LAM)[0] - oracle.neo_hookean(F - d, MU, LAM)[0]
    work = 2 * np.sum(P * d, axis=(1, 2))
    assert np.abs(slope - work).max() < 1e-6 * np.abs(work).max()


def single_elements(F, rng):
    """A mesh of elements without common nodes, and displacements that give each its F."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + rng.uniform(-0.1, 0.1, (len(F), 4, 3))
    mesh = wc.TetMesh(corners.reshape(-1, 3), np.arange(4 * len(F)).reshape(-1, 4))
    return mesh, (corners @ np.swapaxes(F, 1, 2)).reshape(-1, 3) - mesh.points


def forces_of(F, device, rng):
    """The solver's forces on each element, and the same mesh and positions for the oracle."""
    mesh, u = single_elements(F, rng)
    sim, body = simulation(mesh, "neo_hookean", device, dt=1e-5, material=MATERIAL)
    place(body, u)
    x = mesh.points + body.displacements.numpy().astype(float)
    return sim.forces().numpy().reshape(len(F), 4, 3), oracle_mesh(mesh), x


def test_each_element_equals_the_oracle(device, rng):
    """From inverted to threefold stretch, element by element, with a tenth of them at J = 0.5 within rounding."""
    F = random_gradients(rng, 3000, -1.0, 3.0)
    F[:300] = random_gradients(rng, 300, 0.5, 1.5)
    F[:300] *= np.cbrt(CONTINUED_BELOW / np.linalg.det(F[:300]))[:, None, None]
    forces, mesh, x = forces_of(F, device, rng)
    expected = oracle.evaluate("neo_hookean", mesh, x, MU, LAM)[1].reshape(-1, 4, 3)
    gradient = mesh.deformation_gradients(x)
    # Rounding of J, of the size of |F|^3, enters by U'' |cof F|.
    size = np.linalg.norm(gradient, axis=(1, 2))
    scale = (LAM + MU) * (1 + size**5) * mesh.volumes
    assert (np.abs(forces - expected).max(axis=(1, 2)) < 1e-5 * scale).all()


def test_plain_law_where_half_the_volume_is_left(device, rng):
    """P = mu (F - F^-T) + lambda ln J F^-T."""
    F = random_gradients(rng, 1000, 0.8, 1.4)
    forces, mesh, x = forces_of(F, device, rng)
    gradient = mesh.deformation_gradients(x)
    J = np.linalg.det(gradient)
    assert J.min() > CONTINUED_BELOW
    inverse = np.swapaxes(np.linalg.inv(gradient), 1, 2)
    P = MU * (gradient - inverse) + (LAM * np.log(J))[:, None, None] * inverse
    expected = -np.einsum("t,tij,taj->tai", mesh.volumes, P, mesh.gradients)
    assert np.abs(forces - expected).max() < 1e-5 * np.abs(expected).max()
