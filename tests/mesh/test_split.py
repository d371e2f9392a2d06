"""Hexahedra, wedges and pyramids as tetrahedra: they fit one another and fill the cells."""

import numpy as np
import pytest
from foreign_meshes import VOLUME, grid

from warp_corot.io.read.filemesh import Block, split_solids, triangles_of
from warp_corot.mesh.topology import boundary_faces, signed_volumes


def faces_by_count(tets: np.ndarray) -> dict[int, int]:
    faces = np.sort(tets[:, [[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]]].reshape(-1, 3), axis=1)
    _, counts = np.unique(faces, axis=0, return_counts=True)
    return dict(zip(*np.unique(counts, return_counts=True), strict=True))


@pytest.mark.parametrize(
    "kinds", [["hexahedron"], ["wedge"], ["pyramid"], ["tetra"], ["hexahedron", "wedge", "pyramid"]]
)
@pytest.mark.parametrize("seed", range(4))
def test_cells_of_any_kind_and_numbering_fit(kinds, seed):
    rng = np.random.default_rng(seed)
    points, blocks = grid(3, rng, kinds)
    tets, cells, warped = split_solids(blocks, points)
    volumes = signed_volumes(points, tets)
    assert warped == 0
    assert volumes.sum() == pytest.approx(VOLUME, rel=1e-12) or kinds == ["tetra"]
    assert np.abs(volumes).sum() == pytest.approx(VOLUME, rel=1e-12)
    # Every inner face is in two tetrahedra; faces in one tetrahedron are on the six sides.
    counts = faces_by_count(tets)
    assert set(counts) == {1, 2}
    assert counts[1] == 6 * 3 * 3 * 2
    boundary, _ = boundary_faces(tets, points)
    corners = np.linalg.det(points[boundary]).sum() / 6.0
    assert corners == pytest.approx(VOLUME, rel=1e-12)
    # Each tetrahedron lies in its cell: its nodes are among the cell's.
    rows = [set(row) for block in blocks for row in block.nodes.tolist()]
    assert all(set(tet) <= rows[cell] for tet, cell in zip(tets.tolist(), cells.tolist(), strict=True))
    made = np.bincount(cells)
    per_kind = {"hexahedron": 6, "wedge": 3, "pyramid": 2, "tetra": 1}
    assert made.tolist() == [per_kind[block.kind] for block in blocks for _ in block.nodes]


def test_every_numbering_of_one_hexahedron_fills_it():
    """All 40,320 orders of eight corners' numbers would take long; a random hundred do not."""
    rng = np.random.default_rng(0)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], float)
    for _ in range(100):
        numbers = rng.permutation(8)
        points = np.empty((8, 3))
        points[numbers] = corners
        tets, _, _ = split_solids([Block("hexahedron", numbers[None])], points)
        volumes = signed_volumes(points, tets)
        assert volumes.min() > 0.1
        assert volumes.sum() == pytest.approx(1.0)


def test_mirrored_cells_are_turned_and_warped_ones_counted():
    cube = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)], float)
    tets, _, warped = split_solids([Block("hexahedron", np.array([[4, 5, 6, 7, 0, 1, 2, 3]]))], cube)
    assert (signed_volumes(cube, tets) > 0).all()
    assert warped == 0
    dented = cube.copy()
    dented[6] = -0.3
    assert split_solids([Block("hexahedron", np.arange(8)[None])], dented)[2] == 1


def test_cells_with_merged_corners_lose_the_flat_tetrahedra():
    """A hexahedron with an edge collapsed to a point is a wedge."""
    points = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (0, 1, 1)], float)
    tets, _, _ = split_solids([Block("hexahedron", np.array([[0, 1, 2, 2, 3, 4, 5, 5]]))], points)
    assert len(tets) == 3
    assert signed_volumes(points, tets).sum() == pytest.approx(0.5)


def test_polygons():
    blocks = [Block("quad", np.array([[5, 2, 8, 9]])), Block("triangle", np.array([[1, 2, 3]]))]
    assert triangles_of(blocks).tolist() == [[2, 8, 9], [2, 9, 5], [1, 2, 3]]
