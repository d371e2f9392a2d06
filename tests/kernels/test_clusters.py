"""Clusters of elements: their tables, axis-aligned elements, and the kernels' forces."""

from types import SimpleNamespace

import numpy as np
import oracle
import pytest
import warp as wp
from pairs import add_dilatations, add_forces

import warp_corot as wc
from warp_corot.discretization.clusters import changing_clusters, find_tables, paired
from warp_corot.discretization.elements import device_elements
from warp_corot.discretization.plan import LeafCounts
from warp_corot.elasticity.clusters import ChangingClusterScatter, ClusterScatter
from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.clusters.laws import isotropic_law
from warp_corot.kernels.clusters.pairs import SLOT_BITS, SLOT_MASK, WORD_SLOTS
from warp_corot.kernels.clusters.single import (
    AlignedElements,
    element_forces,
    element_gradient,
    material_scale,
    shape_word,
)
from warp_corot.kernels.corotated.corotated import corotated_stress
from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.tables.cluster_layout import BANK_GROUPS, QUAD_BYTES, ClusterLayout

MU, LAM = 900.0, 4000.0
LAYOUTS = [
    ClusterLayout(),
    ClusterLayout(threads=64, each=2),
    pytest.param(ClusterLayout(threads=64), marks=pytest.mark.slow),
]


@law_kernel()
def forces_of_elements(
    elements: AlignedElements, nodes: wp.array[wp.vec4i], u: wp.array[wp.vec4], forces: wp.array2d[wp.vec3]
):
    t = wp.tid()
    n = nodes[t]
    shape = shape_word(elements, t)
    w = element_gradient(
        elements, t, shape, load_node(u, n[0]), load_node(u, n[1]), load_node(u, n[2]), load_node(u, n[3])
    )
    scale = material_scale(elements, t, shape)
    f0, f1, f2, f3 = element_forces(elements, t, shape, corotated_stress(w, scale * MU, scale * LAM))
    forces[t, 0] = f0
    forces[t, 1] = f1
    forces[t, 2] = f2
    forces[t, 3] = f3


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


@pytest.mark.parametrize("layout", LAYOUTS)
def test_leaves_that_change_have_the_oracles_forces(ball, moved, layout, device):
    """The first half of a list, then all of it: in clusters on CUDA, element by element on a CPU."""
    elements, count = device_elements(ball, wp.get_device(device)), len(ball.tets)
    share = np.random.default_rng(3).uniform(0.5, 2.0, count) if elements.nodes.device.is_cuda else np.ones(count)
    number, goes = (wp.array([n], dtype=wp.int32, device=device) for n in (count, 1))
    counts = LeafCounts(most=count, now=number, before=number, goes=goes, threads=1)
    body = SimpleNamespace(sizes=SimpleNamespace(launch_elements=count))
    scatter = ChangingClusterScatter(body, elements, counts, isotropic_law(corotated_stress), layout)
    material = isotropic_material([*(wp.array(v * share, dtype=wp.float32, device=device) for v in (MU, LAM)), 1])
    u = wp.array(in_four(moved), dtype=wp.vec4, device=device)
    for present in (count // 2, count):
        number.fill_(present)
        scatter.derive()
        f = wp.zeros_like(u)
        if u.device.is_cuda:
            scatter(material, u, f)
            found = f.numpy()[:, :3]
        else:
            forces = wp.zeros((present, 4), dtype=wp.vec3, device=device)
            inputs = [scatter.elements, elements.nodes, u]
            wp.launch(forces_of_elements, present, inputs=inputs, outputs=[forces], device=device)
            found = np.zeros(ball.points.shape)
            np.add.at(found, ball.tets[:present], forces.numpy())
        part = SimpleNamespace(points=ball.points, tets=ball.tets[:present])
        wanted = wanted_forces(part, moved, share[:present])
        assert np.abs(found - wanted).max() < 2e-6 * np.abs(wanted).max()
    assert len(np.unique(scatter.elements.shape.numpy() & 0xFF)) >= 48


@pytest.mark.parametrize("layout", LAYOUTS)
def test_tables_lead_every_corner_to_its_node(ball, layout, device):
    tets, device = ball.tets[:1000], wp.get_device(device)
    number, goes = (wp.array([n], dtype=wp.int32, device=device) for n in (len(tets), 1))
    clusters, places = changing_clusters(len(ball.tets), number, layout)
    for count in (1000, 0, 317):
        number.fill_(count)
        nodes = wp.array(ball.tets, dtype=wp.vec4i, device=device)
        find_tables(clusters, places, nodes, goes, layout)
        check_tables(clusters, places, ball.tets[:count], layout)
    goes.zero_()
    number.fill_(1000)
    find_tables(clusters, places, nodes, goes, layout)
    check_tables(clusters, places, ball.tets[:317], layout)


def check_tables(clusters, count, tets, layout):
    size = layout.elements
    begin, tasks = clusters.begin.numpy(), clusters.task_count.numpy()
    node_count, nodes = clusters.node_count.numpy(), clusters.nodes.numpy()
    corners = clusters.corners.numpy().view("<u2").reshape(-1, 4) // QUAD_BYTES
    slots = clusters.slots.numpy().view("<u2").reshape(-1, 8) // QUAD_BYTES
    for cluster in range(count):
        elements = slice(cluster * size, min((cluster + 1) * size, len(tets)))
        here = slice(begin[cluster], begin[cluster] + tasks[cluster])
        own, of_cluster = nodes[here], tets[elements]
        assert len(np.unique(own[: node_count[cluster]])) == node_count[cluster]
        assert node_count[cluster] == len(np.unique(of_cluster))
        if not len(of_cluster):
            assert tasks[cluster] == 0
            continue
        np.testing.assert_array_equal(own[corners[elements]], of_cluster)
        # Slot s + size c is corner c of the s-th element; each is added once, at its node.
        used = slots[here] < layout.corners
        of = slots[here][used]
        assert (slots[here] <= layout.corners).all()
        assert len(np.unique(of)) == len(of) == of_cluster.size
        np.testing.assert_array_equal(np.repeat(own, used.sum(axis=1)), of_cluster[of % size, of // size])


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
