"""Clusters of pairs of elements: their tables, and the kernels' forces."""

import numpy as np
import oracle
import pytest
import warp as wp
from pairs import add_dilatations, add_forces

import warp_corot as wc
from warp_corot.discretization.clusters import paired
from warp_corot.discretization.elements import device_elements
from warp_corot.elasticity.clusters import ClusterScatter
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.clusters.pairs import SLOT_BITS, SLOT_MASK, WORD_SLOTS
from warp_corot.kernels.corotated.algebraic import corotated_stress
from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS, QUAD_BYTES

MU, LAM = 900.0, 4000.0


@pytest.fixture(scope="module")
def ball() -> wc.TetForest:
    """A graded ball with elements of every type and frame."""
    return wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.0125, max_level=6)


@pytest.fixture(scope="module")
def moved(ball) -> np.ndarray:
    """Displacements that strain elements by some tenths, float32 [N, 3]."""
    x = ball.points
    bent = np.column_stack([8.0 * x[:, 1] * x[:, 2], 6.0 * x[:, 0] ** 2, 5.0 * x[:, 0] * x[:, 1]])
    noise = np.random.default_rng(1).standard_normal(x.shape)
    shortest = 0.0125 / 4
    return (bent + 0.05 * shortest * noise).astype(np.float32)


def in_four(u: np.ndarray) -> np.ndarray:
    return np.column_stack([u, np.zeros(len(u), np.float32)])


def wanted_forces(mesh: wc.TetForest, u: np.ndarray, share: np.ndarray | float = 1.0) -> np.ndarray:
    of = oracle.Mesh(mesh.points, mesh.tets)
    ones = np.ones(len(mesh.tets)) * share
    return oracle.continuum(oracle.DENSITIES["corotated"], of, mesh.points + u, MU * ones, LAM * ones)[1]


@pytest.mark.parametrize("of_forest", [True, False])
def test_pairs_have_the_oracles_forces(ball, moved, of_forest, device):
    share = np.random.default_rng(3).uniform(0.5, 2.0, len(ball.tets))
    mesh = ball if of_forest else wc.TetMesh(ball.points, ball.tets)
    scatter = ClusterScatter(device_elements(mesh, wp.get_device(device)), isotropic_law(corotated_stress))
    assert scatter.count * scatter.layout.threads < 0.62 * len(ball.tets) + scatter.layout.threads
    material = isotropic_material([*(wp.array(v * share, dtype=wp.float32, device=device) for v in (MU, LAM)), 1])
    u = wp.array(in_four(moved), dtype=wp.vec4, device=device)
    f = wp.zeros_like(u)
    add_forces(scatter, material, u, f)
    wanted = wanted_forces(ball, moved, share)
    assert np.abs(f.numpy()[:, :3] - wanted).max() < 2e-6 * np.abs(wanted).max()


@pytest.mark.parametrize("of_forest", [True, False])
def test_pairs_that_have_moved_far_keep_their_digits(ball, moved, of_forest, device):
    """Displacements of hundreds of elements, like at the end of a hanging beam: only their differences matter."""
    mesh = ball if of_forest else wc.TetMesh(ball.points, ball.tets)
    far = in_four(moved + np.float32([3.0, -7.0, 5.0]))
    scatter = ClusterScatter(device_elements(mesh, wp.get_device(device)), isotropic_law(corotated_stress))
    material = isotropic_material([*(wp.array([v], dtype=wp.float32, device=device) for v in (MU, LAM)), 0])
    u = wp.array(far, dtype=wp.vec4, device=device)
    f = wp.zeros_like(u)
    add_forces(scatter, material, u, f)
    wanted = wanted_forces(ball, far[:, :3].astype(np.float64), np.ones(len(ball.tets)))
    assert np.abs(f.numpy()[:, :3] - wanted).max() < 2e-6 * np.abs(wanted).max()


@pytest.mark.parametrize("of_forest", [True, False])
@pytest.mark.parametrize("stride", [0, 1])
def test_pairs_measure_their_groups(ball, moved, of_forest, stride, device, rng):
    """They find the means of J - 1, weighted by lambda and volume, of groups whose elements lie anywhere."""
    mesh = ball if of_forest else wc.TetMesh(ball.points, ball.tets)
    scatter = ClusterScatter(device_elements(mesh, wp.get_device(device)), isotropic_law(corotated_stress))
    group_of = rng.permutation(len(ball.tets)) // 9
    lam = LAM * rng.uniform(0.5, 2.0, len(ball.tets)) if stride else np.full(1, LAM)
    listed = wp.array(group_of[scatter.clusters.elements.numpy()], dtype=wp.int32, device=device)
    sums = wp.zeros(int(group_of.max()) + 1, dtype=wp.vec4, device=device)
    u = wp.array(in_four(moved), dtype=wp.vec4, device=device)
    add_dilatations(scatter, listed, stride, wp.array(lam, dtype=wp.float32, device=device), u, sums)
    F = oracle.Mesh(ball.points, ball.tets).deformation_gradients(ball.points + moved)
    weight = lam * ball.volumes
    theta = np.bincount(group_of, weight * (np.linalg.det(F) - 1)) / np.bincount(group_of, weight)
    found = sums.numpy()[:, 0] / sums.numpy()[:, 1]
    assert np.abs(found - theta).max() < 1e-5 * np.abs(theta).max()


@pytest.mark.parametrize("shuffled", [False, True])
def test_tasks_of_pairs_add_up_every_slot_once(ball, shuffled):
    """Consecutive neighbours fill the threads; if none are neighbours, fewer pairs fit."""
    order = np.arange(len(ball.tets), dtype=np.int32)
    if shuffled:
        order = np.random.default_rng(5).permutation(order)
    elements = device_elements(ball, wp.get_device("cpu"))
    scatter = ClusterScatter(elements, isotropic_law(corotated_stress), chosen=order)
    pair_count = np.count_nonzero(scatter.pairs.records.numpy()[: scatter.pairs.count, 2] >> 16)
    assert (scatter.count < 1.1 * pair_count / scatter.layout.threads + 1) != shuffled
    threads, zero = scatter.layout.threads, scatter.layout.zero
    nodes = scatter.clusters.nodes.numpy().reshape(-1, threads)
    words = scatter.clusters.slots.numpy().astype(np.int64)
    slots = ((words[:, :, None] >> (SLOT_BITS * np.arange(WORD_SLOTS))) & SLOT_MASK).reshape(*nodes.shape, -1)
    halves = scatter.pairs.records.numpy()[: scatter.pairs.count].astype("<u4").view("<u2").reshape(-1, 8)
    volumes = scatter.pairs.records.numpy()[: scatter.pairs.count, 2] >> 16
    pairs = (halves[:, :5] // QUAD_BYTES).reshape(len(nodes), threads, 5)
    for cluster in range(scatter.count):
        used = slots[cluster] < zero
        assert (slots[cluster] < zero + BANK_GROUPS).all()
        assert not used[nodes[cluster] < 0].any()
        of, at = slots[cluster][used], np.repeat(nodes[cluster], used.sum(axis=1))
        assert len(np.unique(of)) == len(of)
        real = np.flatnonzero(volumes.reshape(len(nodes), threads)[cluster])
        assert len(of) == 5 * len(real)
        np.testing.assert_array_equal(at, nodes[cluster][pairs[cluster, of % threads, of // threads]])


def test_no_element_is_in_two_pairs(ball):
    order = np.random.default_rng(4).permutation(len(ball.tets))
    for tets in (ball.tets, ball.tets[order]):
        pairs = paired(tets)
        places = pairs[pairs >= 0]
        np.testing.assert_array_equal(np.sort(places), np.arange(len(tets)))
        both = tets[pairs[pairs[:, 1] >= 0]]
        assert all(len(set(a) & set(b)) == 3 for a, b in both.tolist())
