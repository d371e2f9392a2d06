"""Fidelity of meshes to their bodies, measured for known answers."""

import numpy as np
import pytest
import trimesh

from warp_corot.domain import Domain
from warp_corot.domain.fidelity import fidelity, smallest_dihedral
from warp_corot.domain.reference import reference_of, volume_along_lines
from warp_corot.holding.choice import supports_of
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.topology import pieces_of


def surface_of(*parts: trimesh.Trimesh) -> Domain:
    whole = trimesh.util.concatenate(parts)
    return Domain.from_surface((whole.vertices, whole.faces))


def ball(radius: float, x: float = 0.0) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(3, radius=radius).apply_translation((x, 0, 0))


def test_a_mesh_of_boxes_is_what_it_is() -> None:
    mesh = TetForest.from_domain(Domain.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)), 0.26, max_level=6)
    found = fidelity(mesh, Domain.box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)))
    assert found.input_volume == pytest.approx(1.0, rel=2e-3)
    assert found.volume == pytest.approx(1.0, rel=1e-2)
    assert max(found.distance_mean) < 5e-3
    assert found.watertight
    assert found.pieces == found.input_pieces == 1
    assert not found.doubts()
    assert found.smallest_dihedral == pytest.approx(45.0)


def test_distances_are_those_of_spheres_of_two_radii() -> None:
    inner = TetForest.from_domain(surface_of(ball(0.9)), 0.3, max_level=6)
    found = fidelity(inner, surface_of(ball(1.0)))
    assert np.allclose(found.distance_mean, 0.1, atol=0.01)
    assert np.allclose(found.distance_95, 0.1, atol=0.015)
    assert found.volume_error == pytest.approx(0.9**3 - 1, abs=0.01)
    assert "volume" in found.doubts()[0]


@pytest.mark.parametrize(
    ("parts", "pieces"),
    [
        ([ball(1.0), ball(0.5, 3.0)], 2),
        ([ball(1.0), ball(1.0, 1.5)], 1),  # they cross
        ([ball(1.0), ball(0.3, 0.2)], 1),  # one within the other
        ([ball(1.0), ball(0.9).copy(), ball(0.3)], 1),
    ],
)
def test_pieces_of_surfaces(parts: list[trimesh.Trimesh], pieces: int) -> None:
    assert reference_of(surface_of(*parts), 1000).pieces == pieces


def test_a_cavity_is_no_piece_and_what_lies_in_it_is() -> None:
    cavity = ball(0.8)
    cavity.invert()
    domain = surface_of(ball(1.0), cavity, ball(0.4))
    given = reference_of(domain, 1000)
    assert given.pieces == 2
    assert given.volume == pytest.approx(4 / 3 * np.pi * (1 - 0.8**3 + 0.4**3), rel=0.02)


def test_nested_shells_are_separate_pieces() -> None:
    """A cavity belongs to the shell that contains it, or to all solid parts around it."""
    shells = [ball(r) for r in (1.0, 0.9, 0.7, 0.6, 0.3)]
    for cavity in shells[1::2]:
        cavity.invert()
    assert reference_of(surface_of(*shells), 1000).pieces == 3
    buried = ball(0.2)
    buried.invert()
    assert reference_of(surface_of(ball(1.0), ball(0.5), buried), 1000).pieces == 1


def test_pieces_of_a_mesh_share_faces() -> None:
    """Three tetrahedra: two share a face, the third meets them in an edge. All counts agree."""
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1], [-1, -1, 0], [-1, 1, 0]], float)
    tets = np.array([[0, 1, 2, 3], [0, 2, 1, 4], [0, 3, 6, 5]])
    assert pieces_of(tets).tolist() == [0, 0, 1]
    mesh = TetMesh(points, tets)
    assert len(supports_of(mesh, young=1e6, density=1e3, gravity=(0, 0, -9.81)).pieces) == 2
    assert fidelity(mesh, surface_of(ball(1.0)), samples=100).pieces == 2


def test_voxels_that_touch_are_one_piece() -> None:
    numbers = np.zeros((8, 8, 8), np.int16)
    numbers[1:3, 1:3, 1:3] = numbers[3:5, 3:5, 3:5] = numbers[6, 6, 6] = 1
    domain = Domain.from_labels(numbers, spacing=(0.01, 0.01, 0.01))
    assert reference_of(domain, 100).pieces == 2
    assert any("in 2 pieces" in line for line in domain.report())


def test_a_body_that_no_node_lies_in_has_a_surface() -> None:
    """Twenty pins in a few tetrahedra: their volume is known, and their boundary is drawn."""
    w, places = 0.0003, np.stack(np.mgrid[:10, :2], axis=-1).reshape(-1, 2) * [0.002, 0.0021] + [0.003, 0.004]
    domain = surface_of(*(trimesh.creation.box((w, w, 0.01)).apply_translation((*at, 0.0)) for at in places))
    mesh = TetForest.from_domain(domain, target_elements=100)
    found = fidelity(mesh, domain)
    assert found.watertight
    assert found.volume == pytest.approx(found.input_volume, rel=0.03)
    assert found.pieces < found.input_pieces == 20
    assert found.doubts()


def test_overlapping_parts_count_once() -> None:
    given = reference_of(surface_of(trimesh.creation.box((2, 1, 1)), trimesh.creation.box((1, 2, 1.0001))), 4000)
    assert given.volume == pytest.approx(3.0, rel=5e-3)
    # None of the points is where the two boxes overlap.
    assert not ((np.abs(given.points[:, :2]) < 0.49).all(axis=1) & (np.abs(given.points[:, 2]) < 0.49)).any()


def test_lost_and_joined_pieces_are_reported() -> None:
    far = TetForest.from_domain(surface_of(ball(1.0)), 0.5, max_level=3)
    lost = fidelity(far, surface_of(ball(1.0), ball(0.2, 3.0)))
    assert lost.lost_pieces == 1
    assert any("in no tetrahedron" in line for line in lost.doubts())
    joined = fidelity(far, surface_of(ball(0.5), ball(0.4, -0.93)))
    assert joined.pieces == 1
    assert joined.input_pieces == 2
    assert any("grown together" in line for line in joined.doubts())


def test_voxels_and_their_labels() -> None:
    numbers = np.zeros((20, 20, 20), np.int16)
    numbers[3:17, 3:17, 3:17] = 1
    numbers[8, 8, 8] = 2
    domain = Domain.from_labels(numbers, spacing=(0.01, 0.01, 0.01), labels={"organ": 1, "speck": 2})
    given = reference_of(domain, 3000)
    assert given.volume == pytest.approx(14**3 * 1e-6)
    assert given.pieces == 1
    assert np.abs(domain.phi(given.points)).max() < 1e-6


def test_the_sharpest_angle_of_any_tetrahedra() -> None:
    flat = TetMesh(np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.3, 0.3, 0.01]]), np.array([[0, 1, 2, 3]]))
    # Above a base of this size, at the edge closest to the top.
    assert smallest_dihedral(flat) == pytest.approx(np.degrees(np.arctan2(0.01, 0.3)), rel=1e-6)


def test_a_tube_that_runs_through_itself_counts_once(device):
    """One and a half times round a circle: a single part, half of which lies in the other half."""
    along, around = np.linspace(0.0, 3.0 * np.pi, 145), np.arange(24) * np.pi / 12.0
    radius = 1.0 + 0.2 * np.cos(around)
    up = np.outer(np.ones(145), 0.2 * np.sin(around))
    rings = np.stack([np.outer(np.cos(along), radius), np.outer(np.sin(along), radius), up], axis=-1)
    points = np.concatenate([rings.reshape(-1, 3), rings[[0, -1]].mean(axis=1)])
    one = np.arange(144)[:, None] * 24 + np.arange(24)
    two = np.arange(144)[:, None] * 24 + (np.arange(24) + 1) % 24
    sides = [np.stack(corners, axis=-1).reshape(-1, 3) for corners in ((one, one + 24, two), (two, one + 24, two + 24))]
    start = np.stack([one[0], two[0], np.full(24, len(points) - 2)], axis=1)
    end = np.stack([two[-1] + 24, one[-1] + 24, np.full(24, len(points) - 1)], axis=1)
    domain = Domain.from_surface((points, np.concatenate([*sides, start, end])), device=device)
    found = reference_of(domain, 2000)
    once = domain.closed.volume / 1.5
    assert found.volume == pytest.approx(once, rel=2e-3)
    assert found.pieces == 1
    # Caps and what lies behind them are within the body: they are no part of its surface.
    assert np.abs(np.hypot(np.hypot(*found.points[:, :2].T) - 1.0, found.points[:, 2]) - 0.2).max() < 0.01


def test_volumes_along_lines_are_those_of_boxes_that_overlap(device):
    boxes = [trimesh.creation.box(bounds=b) for b in (((0, 0, 0), (1, 1, 1)), ((0.5, 0.25, 0.25), (2, 0.75, 0.75)))]
    whole = trimesh.util.concatenate(boxes)
    turn = trimesh.transformations.rotation_matrix(0.7, (1.0, 2.0, 0.5))
    for points in (whole.vertices, trimesh.transform_points(whole.vertices, turn)):
        domain = Domain.from_surface((points, whole.faces), device=device)
        assert volume_along_lines(domain) == pytest.approx(1.25, rel=1e-3)
