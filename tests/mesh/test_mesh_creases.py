"""Edges and corners of bodies on the marched surface."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import warp_corot as wc
from warp_corot.domain.closing import net_edges
from warp_corot.domain.fidelity import fidelity
from warp_corot.io.checkpoint.archive import joined, split
from warp_corot.io.checkpoint.contents import pack_mesh, unpack_mesh

TURN = trimesh.transformations.euler_matrix(np.radians(20.0), np.radians(30.0), 0.0)


def turned(shape: trimesh.Trimesh) -> wc.Domain:
    shape = shape.copy().apply_transform(TURN)
    return wc.Domain.from_surface((shape.vertices, shape.faces))


BODIES = {
    "cube": lambda: turned(trimesh.creation.box((0.1, 0.1, 0.1))),
    "cylinder": lambda: turned(trimesh.creation.cylinder(0.04, 0.1, sections=96)),
    "notched ball": lambda: wc.Domain.sphere(0.05) - wc.Domain.box((0.003, 0.003, 0.003), (0.1, 0.1, 0.1)),
    "ball": lambda: wc.Domain.sphere(0.05),
}


@pytest.mark.parametrize(
    ("name", "nearer"),
    [
        pytest.param("cube", 0.2, marks=pytest.mark.slow),
        pytest.param("cylinder", 0.7, marks=pytest.mark.slow),
        ("notched ball", 0.7),
        ("ball", 1.0),
    ],
)
def test_edges_are_followed_and_smooth_bodies_lose_nothing(name, nearer):
    domain = BODIES[name]()
    forest = wc.TetForest.from_domain(domain, target_elements=3000)
    plain = replace(forest, detail=replace(forest.detail, sharp_points=None)).surface()
    sharp = forest.surface()
    assert not len(net_edges(sharp.triangles.astype(np.int64))[0])
    assert sharp.euler_characteristic == plain.euler_characteristic == 2
    before, after = (fidelity(forest, domain, surface=surface) for surface in (plain, sharp))
    for which in range(2):
        assert after.distance_mean[which] <= nearer * before.distance_mean[which]
        assert after.distance_95[which] <= 1.01 * before.distance_95[which]
    volume = before.input_volume
    assert abs(sharp.volume - volume) <= 1.01 * abs(plain.volume - volume)


def test_the_surface_is_bound_to_the_elements():
    """Displacements that are linear in space move it exactly."""
    forest = wc.TetForest.from_domain(BODIES["cube"](), target_elements=1000)
    surface = forest.surface()
    matrix = np.array([[0.1, 0.2, 0.0], [0.0, -0.1, 0.3], [0.05, 0.0, 0.2]])
    moved = surface.moved(forest.points @ matrix.T)
    assert moved == pytest.approx(surface.points + surface.points @ matrix.T, abs=1e-9)


def test_a_checkpoint_keeps_the_surface():
    forest = wc.TetForest.from_domain(BODIES["cube"](), target_elements=500)
    again = unpack_mesh(joined(*split(pack_mesh(forest)))).surface()
    assert np.array_equal(again.points, forest.surface().points)
    assert np.array_equal(again.triangles, forest.surface().triangles)
