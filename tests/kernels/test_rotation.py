"""Polar rotations of any matrix, by every method."""

import numpy as np
import oracle
import pytest
from cases import MATERIAL, mixed_forest, oracle_mesh, place, random_displacement, simulation
from sequential import Bisection

import warp_corot as wc

METHODS = ("byers-xu", "svd")
# Error of the polar factor (Frobenius): median, 99th percentile, largest. The SVD of McAdams et al. stops after a fixed
# number of Jacobi sweeps, which leaves some matrices with nearly equal singular values unfinished: it is a baseline.
ACCURACY = {"byers-xu": (5e-7, 2e-6, 2e-5), "svd": (1e-6, 1e-3, 0.2)}


def matrices(rng, count):
    """Random matrices, float32 [count, 3, 3]: a tenth mirrored on purpose, others singular, huge, tiny."""
    rotations = oracle.polar(rng.standard_normal((count, 3, 3)))
    other = oracle.polar(rng.standard_normal((count, 3, 3)))
    sigma = np.exp(rng.normal(0, 0.5, (count, 3)))
    sigma[: count // 10, 2] *= -1
    kinds = np.array_split(np.arange(count // 10, count), 9)
    sigma[kinds[0], 2] = 0
    sigma[kinds[1], 1:] = 0
    sigma[kinds[2]] = 0
    sigma[kinds[3]] *= 1e30
    sigma[kinds[4]] *= 1e-15
    sigma[kinds[5]] *= 1e-30
    sigma[kinds[6]] *= 1e-40  # denormal
    sigma[kinds[7], 2] *= 10.0 ** rng.uniform(-12, 0, len(kinds[7]))
    F = np.einsum("tij,tj,tkj->tik", rotations, sigma, other)
    F[kinds[3]][::2] *= -1
    return rng.permutation(F.astype(np.float32))


def gap(F):
    """(sigma_2 + sign(det F) sigma_3) / sigma_1: how well the rotation is defined; 0 if it is not."""
    _, sigma, _ = np.linalg.svd(F)
    sign = np.sign(np.linalg.det(F / np.maximum(sigma[:, :1, None], 1e-300)))
    return (sigma[:, 1] + sign * sigma[:, 2]) / np.maximum(sigma[:, 0], 1e-300)


def assert_rotations(R):
    assert np.isfinite(R).all()
    R = R.astype(float)
    assert np.abs(np.linalg.det(R) - 1).max() < 1e-5
    assert np.abs(np.swapaxes(R, 1, 2) @ R - np.eye(3)).max() < 1e-5


def check_random_matrices(method, device, rng, count):
    F = matrices(rng, count)
    R = wc.polar_rotation(F, method=method, device=device)
    assert R.shape == F.shape
    assert R.dtype == np.float32
    assert_rotations(R)
    well = gap(F.astype(float)) > 0.1
    assert 0.4 < well.mean() < 0.95
    error = np.linalg.norm(R - oracle.polar(F.astype(float)), axis=(1, 2))[well]
    half, most, worst = np.percentile(error, [50, 99, 100])
    print(f"{method} on {device}: error (Frobenius) {half:.1e} median, {most:.1e} 99 %, {worst:.1e} largest")
    assert all(value < bound for value, bound in zip((half, most, worst), ACCURACY[method], strict=True))


@pytest.mark.parametrize("method", METHODS)
def test_random_matrices(method, device, rng):
    check_random_matrices(method, device, rng, 50_000)


@pytest.mark.slow
@pytest.mark.parametrize("method", METHODS)
def test_a_million_random_matrices(method, device, rng):
    check_random_matrices(method, device, rng, 1_000_000)


@pytest.mark.parametrize("method", METHODS)
def test_not_a_number_gives_some_rotation(method, device):
    F = np.tile(np.eye(3, dtype=np.float32), (27, 1, 1))
    for index, value in enumerate([np.nan, np.inf, -np.inf]):
        for entry in range(9):
            F[9 * index + entry].flat[entry] = value
    assert_rotations(wc.polar_rotation(F, method=method, device=device))


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("scale", [1e-40, 1e-30, 1e-15, 1.0, 1e15, 1e30, 3e38])
def test_scale_does_not_matter(method, scale, device, rng):
    """The rotation of s F is that of F, for every s that float32 represents (except digits lost to denormals)."""
    F = np.eye(3) + 0.3 * rng.uniform(-1, 1, (500, 3, 3))
    scaled = (scale / np.abs(F).max() * F).astype(np.float32)
    R = wc.polar_rotation(scaled, method=method, device=device)
    assert np.linalg.norm(R - oracle.polar(scaled.astype(float)), axis=(1, 2)).max() < ACCURACY[method][2]


@pytest.mark.parametrize("method", METHODS)
def test_rotation_follows_the_matrix(method, device, rng):
    """R(Q F) = Q R(F) and R(F Q) = R(F) Q for rotations Q, inverted matrices too."""
    F = rng.standard_normal((2000, 3, 3))
    F = F[gap(F) > 0.2]
    Q = oracle.polar(rng.standard_normal(F.shape))
    of, left, right = (wc.polar_rotation(A.astype(np.float32), method=method, device=device) for A in (F, Q @ F, F @ Q))
    assert np.linalg.norm(left - Q @ of, axis=(1, 2)).max() < 2 * ACCURACY[method][2]
    assert np.linalg.norm(right - of @ Q, axis=(1, 2)).max() < 2 * ACCURACY[method][2]


@pytest.mark.parametrize("method", METHODS)
def test_continuous_through_inversion(method, device, rng):
    """An element pushed through its own plane rotates no faster than its matrix changes.

    |dR| <= 2 |dF| / (sigma_2 + sign(det) sigma_3), and along these paths that sum is at least 0.2.
    """
    steps = 400
    for _ in range(20):
        start, end = np.eye(3) + 0.2 * rng.standard_normal((2, 3, 3))
        start, end = start @ np.diag([1, 0.9, 0.4]), end @ np.diag([1, 0.9, -0.4])
        t = np.linspace(0, 1, steps + 1)[:, None, None]
        F = (1 - t) * start + t * end
        scaled_gap = gap(F) * np.linalg.norm(F, 2, axis=(1, 2))
        if scaled_gap.min() < 0.2 or np.linalg.det(F).min() > 0:
            continue
        R = wc.polar_rotation(F.astype(np.float32), method=method, device=device).astype(float)
        bound = 2 * np.linalg.norm(end - start) / steps / scaled_gap.min()
        assert np.linalg.norm(np.diff(R, axis=0), axis=(1, 2)).max() < 1.1 * bound + 2e-5


def test_fixed_iterations(device, rng):
    """A fixed number of iterations is obeyed: the error falls with it, faster and faster, to float32's digits."""
    F = np.eye(3) + 0.3 * rng.uniform(-1, 1, (2000, 3, 3))
    exact = oracle.polar(F)
    errors = [
        np.abs(wc.polar_rotation(F.astype(np.float32), iterations=n, device=device) - exact).max() for n in range(2, 8)
    ]
    assert errors[0] > 1e-3  # two iterations are not enough, so the count is obeyed
    assert errors[0] > 3 * errors[1] > 30 * errors[2]
    assert max(errors[3:]) < 2e-6


def test_bad_arguments(device):
    with pytest.raises(wc.InputError, match="newton"):
        wc.polar_rotation(np.eye(3)[None], method="newton", device=device)
    with pytest.raises(wc.InputError, match="3, 3"):
        wc.polar_rotation(np.ones((5, 3, 2)), device=device)
    with pytest.raises(wc.InputError, match="iterations"):
        wc.polar_rotation(np.eye(3)[None], iterations=0, device=device)
    with pytest.raises(wc.InputError, match="rotation"):
        wc.Corotated(rotation="newton")
    with pytest.raises(wc.InputError, match="level"):
        wc.Corotated(rotation_level=-1)


def test_empty(device):
    assert wc.polar_rotation(np.zeros((0, 3, 3), np.float32), device=device).shape == (0, 3, 3)


# --- rotations of tree levels -----------------------------------------------------------------------------------------


def ancestor_rotations(forest, u, level):
    """The rotation each leaf gathers [T, 3, 3]: its ancestor's at ``level``, its own when it lies above that level.

    Ancestors are found from geometry alone: the tetrahedron of the sequential bisection at ``level`` that has the
    leaf's centroid inside. All its vertices are nodes of the mesh.
    """
    cells = np.rint(forest.points.max(0) / 0.064).astype(int)
    coarse = Bisection(cells, level)
    corners = np.array([coarse.points(leaf, 0.064) for leaf in sorted(coarse.leaves)])
    centroids = forest.points[forest.tets].mean(1)
    node_of = {tuple(np.rint(p / 0.064 * 2**20).astype(int)): n for n, p in enumerate(forest.points)}
    own = oracle_mesh(forest).deformation_gradients(forest.points + u)
    R = oracle.polar(own)
    barycentric = np.linalg.inv(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2))
    for leaf in np.flatnonzero(forest.levels >= level):
        weights = np.einsum("tij,tj->ti", barycentric, centroids[leaf] - corners[:, 0])
        inside = (weights > 0).all(1) & (weights.sum(1) < 1)
        (tet,) = np.flatnonzero(inside)
        nodes = [node_of[tuple(np.rint(p / 0.064 * 2**20).astype(int))] for p in corners[tet]]
        ancestor = oracle.Mesh(forest.points, [nodes])
        R[leaf] = oracle.polar(ancestor.deformation_gradients(forest.points + u)[0])
    return R


def twisted(x):
    """A twist about the z axis by 20 radians a metre, so that every part of the body has a different rotation."""
    cos, sin = np.cos(20 * x[:, 2]), np.sin(20 * x[:, 2])
    return np.stack([cos * x[:, 0] - sin * x[:, 1], sin * x[:, 0] + cos * x[:, 1], x[:, 2]], axis=1)


@pytest.mark.parametrize("level", range(7))
@pytest.mark.parametrize("kind", ["uniform", "mixed"])
def test_shared_rotations_equal_the_oracle(kind, level, device, rng):
    """Every descendant of a tetrahedron of level L has that tetrahedron's rotation, from its four vertices."""
    forest = wc.TetForest.box((1, 1, 2), 0.064, 6) if kind == "uniform" else mixed_forest(cells=(1, 1, 2))
    if kind == "mixed":
        assert forest.levels.min() < 5 <= forest.levels.max()
    sim, body = simulation(forest, wc.Corotated(rotation_level=level), device)
    x = twisted(forest.points + random_displacement(forest, rng, 0.1))
    u = (x - forest.points).astype(np.float32)
    place(body, u)
    reference = oracle_mesh(forest)
    R = ancestor_rotations(forest, u.astype(float), level)
    lame = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
    energies, expected = oracle.evaluate("corotated", reference, forest.points + u.astype(float), *lame, R=R)
    assert np.abs(sim.forces().numpy() - expected).max() < 1e-5 * np.abs(expected).max()
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=1e-5)


def test_level_of_the_leaves_is_own_rotation(device, rng):
    """rotation_level at or below the leaves' own level changes nothing."""
    forest = wc.TetForest.box((1, 1, 1), 0.064, 4)
    u = random_displacement(forest, rng, 0.1)
    forces = []
    for level in (None, 4, 9):
        sim, body = simulation(forest, wc.Corotated(rotation_level=level), device)
        place(body, u)
        forces.append(sim.forces().numpy())
    for other in forces[1:]:
        assert np.abs(other - forces[0]).max() < 1e-5 * np.abs(forces[0]).max()


def test_general_meshes_have_no_levels(device):
    mesh = wc.TetMesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], [[0, 1, 2, 3]])
    with pytest.raises(wc.InputError, match="level"):
        simulation(mesh, wc.Corotated(rotation_level=2), device)
