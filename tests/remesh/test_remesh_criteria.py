"""Criteria of refinement and simplification, and bodies with a void around them."""

import numpy as np
import pytest
import warp as wp
from remesh_cases import (
    CUBE,
    DENSITY,
    PAIRS,
    RemeshPass,
    assert_sound,
    counts_of,
    leaf_list,
    momentum,
    random_marks,
    set_nodes,
)

import warp_corot as wc
from warp_corot.discretization.changing.pools import DeviceForest
from warp_corot.kernels.remesh.criteria import ElementState


def longest_edges(forest, tets, moved):
    """Longest rest edge of tetrahedra, deformed over rest, by the nodes' positions alone."""
    x = forest.points[tets]
    y = moved[tets]
    rest = np.stack([np.linalg.norm(x[:, i] - x[:, j], axis=1) for i, j in PAIRS])
    now = np.stack([np.linalg.norm(y[:, i] - y[:, j], axis=1) for i, j in PAIRS])
    longest = rest.argmax(axis=0), np.arange(len(x))
    return now[longest] / rest[longest]


def test_elongation_of_the_longest_edge_decides(device, rng):
    forest = wc.TetForest.box((2, 1, 1), CUBE, 8, origin=(1.0, -2.0, 0.5))
    x = forest.points[:, 0] - 1.0
    u = np.column_stack([2.0 * x**2 / CUBE, 0 * x, 0 * x]) * 0.3 + 1e-3 * rng.normal(size=(len(x), 3))
    ratio = longest_edges(forest, forest.tets, forest.points + u)
    parents = forest.tree.tets[forest.tree.above(forest.tree.leaves, 1)]
    above = longest_edges(forest, parents, forest.points + u)
    assert np.abs(np.stack([ratio, above])[..., None] - (1.3, 1.1)).min() > 1e-6
    adaptive = DeviceForest(forest, 50000, device=device)
    set_nodes(adaptive.carriage, displacements=u)
    RemeshPass(adaptive, refine_above=1.3, simplify_below=1.1).run()
    expected = np.where(ratio > 1.3, 1, np.where((ratio < 1.1) & (above < 1.3), -1, 0))
    assert ((ratio < 1.1) & (above > 1.3)).any()
    assert np.array_equal(adaptive.pools.marks.numpy()[: len(ratio)], expected)
    assert {-1, 0, 1} == set(expected)
    twin = DeviceForest(forest, 50000, device=device)
    RemeshPass(twin).apply(expected)
    assert leaf_list(assert_sound(adaptive)) == leaf_list(twin.to_forest())


@pytest.mark.parametrize("stretch", [1.18, 1.3, 1.5])
def test_a_body_at_rest_stays_as_it_is(stretch, device):
    """Under uniform stretch passes end, even if the thresholds are close to each other."""
    forest = wc.TetForest.box((1, 1, 1), CUBE, 3)
    adaptive = DeviceForest(forest, 50_000, device=device)
    set_nodes(adaptive.carriage, displacements=forest.points * [stretch - 1.0, 0.0, 0.0])
    remesh = RemeshPass(adaptive, refine_above=1.16, simplify_below=1.15, max_level=9)
    counts = []
    for _ in range(12):
        remesh.run()
        counts.append(counts_of(adaptive))
    assert counts[0].added + counts[0].removed > 0
    assert counts[-1].added == counts[-1].removed == 0


@wp.func
def nearness(element: ElementState, parameters: wp.array[wp.float32]):
    """Longest edge over the distance of the element's centroid from a tool."""
    tool = wp.vec3(parameters[0], parameters[1], parameters[2])
    centre = element.corner
    for n in range(4):
        centre += 0.25 * (element.rest[n] + element.moved[n])
    longest = wp.length(element.rest[3 - element.level % 3])
    return longest / wp.length(centre - tool)


def test_a_users_criterion_follows_a_tool(device):
    """The mesh becomes fine at the tool and coarse behind it."""
    forest = wc.TetForest.box((3, 1, 1), CUBE, 3, origin=(-0.1, 0.0, 0.0))
    adaptive = DeviceForest(forest, 20000, device=device)
    tool = wp.zeros(3, dtype=wp.float32, device=device)
    remesh = RemeshPass(
        adaptive, criterion=nearness, refine_above=0.7, simplify_below=0.3, min_level=3, max_level=12, parameters=tool
    )
    counts = []
    for x in (-0.09, 0.09 - 0.008):
        at = np.array([x, 0.5 * CUBE, 0.5 * CUBE])
        tool.assign(at)
        for _ in range(12):
            remesh.run()
        mesh = assert_sound(adaptive)
        distance = np.linalg.norm(mesh.points[mesh.tets].mean(axis=1) - at, axis=1)
        assert mesh.levels[distance < 0.1 * CUBE].min() >= 10
        assert mesh.levels[distance > 2.0 * CUBE].max() <= 5
        counts.append(len(mesh.tets))
    assert counts[1] == pytest.approx(counts[0], rel=0.2)
    # Once it follows, nothing changes any more.
    remesh.run()
    assert adaptive.leaf_count == counts[1]


# --- bodies with a void around them -----------------------------------------------------------------------------------


def test_forests_of_domains_refine_and_simplify(device, rng):
    forest = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3)
    adaptive = DeviceForest(forest, 20000, density=DENSITY, device=device)
    set_nodes(adaptive.carriage, velocities=rng.normal(size=forest.points.shape))
    remesh = RemeshPass(adaptive)
    p, size = momentum(adaptive)
    for chances in [(0.2, 0.1), (0.2, 0.1), (0.02, 0.95), (0.0, 1.0), (0.0, 1.0), (0.1, 0.5)]:
        count = adaptive.leaf_count
        remesh.apply(random_marks(adaptive, rng, *chances))
        mesh = assert_sound(adaptive)
        assert len(mesh.tets) != count
        assert (mesh.fill * mesh.volumes).sum() == pytest.approx((forest.fill * forest.volumes).sum(), rel=1e-5)
        assert np.allclose(momentum(adaptive)[0], p, atol=1e-6 * size)
        assert len(np.unique(mesh.lattice, axis=0)) == len(mesh.lattice)
    body = wc.SoftBody(mesh, wc.Isotropic(1e3, 0.3, DENSITY), device=device)
    assert body.masses.sum() == pytest.approx(adaptive.carriage.arrays.mass.numpy().sum(), rel=1e-5)
    assert len(mesh.refine([0]).tets) > len(mesh.tets)


@wp.func
def always(element: ElementState, parameters: wp.array[wp.float32]):
    return 2.0


def test_nearly_empty_elements_are_refined_only_for_conformity(device):
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.04, device=device), 0.03, max_level=4)
    forest = DeviceForest(mesh, 50_000, device=device)
    RemeshPass(forest, criterion=always, refine_above=1.0, simplify_below=0.0, max_level=20).run()
    refined = forest.to_forest()
    stayed = (
        np.isin(refined.tree.leaves, np.flatnonzero(refined.tree.parent >= 0))
        & np.isin(refined.tets.view("i4,i4,i4,i4"), mesh.tets.view("i4,i4,i4,i4")).ravel()
    )
    assert stayed.any()
    assert refined.fill[stayed].max() < 0.5
    untouched = wc.TetForest.box((2, 2, 2), 0.03, 3)
    forest = DeviceForest(untouched, 50_000, device=device)
    RemeshPass(forest, criterion=always, refine_above=1.0, simplify_below=0.0, max_level=20).run()
    assert forest.leaf_count == 2 * len(untouched.tets)
