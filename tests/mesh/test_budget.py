"""Meshes with a given number of elements: any shape, the requested number, the whole body, in one piece."""

import numpy as np
import pytest
import trimesh

import warp_corot as wc
from warp_corot.domain.fidelity import fidelity
from warp_corot.mesh.growing.slivers import strays, without_slivers
from warp_corot.mesh.topology import face_pairs

TURN = trimesh.transformations.rotation_matrix(0.4, (1.0, 2.0, 3.0))


def turned(mesh: trimesh.Trimesh) -> wc.Domain:
    mesh = mesh.copy().apply_transform(TURN)
    return wc.Domain.from_surface((mesh.vertices, mesh.faces))


def coil() -> wc.Domain:
    """A wire of 2 mm, 60 cm of it, coiled in a space of 10 cm."""
    t = np.linspace(0.0, 4.0 * np.pi, 80)
    path = np.stack([0.05 * np.cos(t), 0.05 * np.sin(t), 0.1 * t / t[-1]], axis=1)
    parts = [
        trimesh.creation.cylinder(0.001, segment=segment, sections=8)
        for segment in np.stack([path[:-1], path[1:]], axis=1)
    ]
    whole = trimesh.util.concatenate(parts)
    return wc.Domain.from_surface((whole.vertices, whole.faces))


SHAPES = {
    "cube": lambda: turned(trimesh.creation.box((0.1, 0.1, 0.1))),
    "sheet": lambda: turned(trimesh.creation.box((0.2, 0.2, 0.002))),
    "tube": lambda: turned(trimesh.creation.annulus(0.018, 0.02, 0.1)),
    "ball": lambda: wc.Domain.sphere(0.05),
    "coil": coil,
}


@pytest.mark.parametrize(
    "shape", [pytest.param(shape, marks=pytest.mark.slow) if shape == "tube" else shape for shape in SHAPES]
)
def test_the_whole_body_is_meshed_with_the_requested_number(shape):
    domain = SHAPES[shape]()
    mesh = wc.TetForest.from_domain(domain, target_elements=3000)
    found = fidelity(mesh, domain)
    assert 0.9 * 3000 <= found.elements <= 3000
    assert found.volume_error == pytest.approx(0.0, abs=0.012)
    assert found.pieces == found.input_pieces == 1
    assert found.lost_pieces == 0
    assert found.watertight


def test_thin_parts_get_layers_where_the_number_allows():
    """A slab on a block: with two layers requested, its elements are at most half as thick as it is."""
    block = trimesh.creation.box((0.06, 0.06, 0.06))
    slab = trimesh.creation.box((0.12, 0.06, 0.006)).apply_translation((0.08, 0.0, 0.0))
    whole = trimesh.util.concatenate([block, slab])
    domain = wc.Domain.from_surface((whole.vertices, whole.faces))
    sizes = []
    for layers in (0, 2):
        mesh = wc.TetForest.from_domain(domain, target_elements=20_000, min_layers=layers)
        middle = mesh.points[mesh.tets].mean(axis=1)
        edges = mesh.cell_size * 0.5 ** (mesh.levels / 3.0)
        sizes.append(edges[(middle[:, 0] > 0.05) & (np.abs(middle[:, 2]) < 0.003)].max())
    assert sizes[1] <= 1.3 * 0.006 / 2 < sizes[0]


def test_more_levels_are_used_where_the_given_cubes_are_large():
    mesh = wc.TetForest.from_domain(SHAPES["tube"](), 0.1, target_elements=3000)
    assert mesh.cell_size == 0.1
    assert 0.8 * 3000 <= len(mesh.tets) <= 3000
    assert fidelity(mesh, SHAPES["tube"]()).volume_error == pytest.approx(0.0, abs=0.02)


def test_parts_apart_stay_apart_where_elements_have_room():
    pair = [trimesh.creation.box((0.03, 0.03, 0.03)).apply_translation((x, 0, 0)) for x in (0.0, 0.04)]
    whole = trimesh.util.concatenate(pair)
    domain = wc.Domain.from_surface((whole.vertices, whole.faces))
    assert fidelity(wc.TetForest.from_domain(domain, target_elements=10_000), domain).pieces == 2


def test_a_label_smaller_than_an_element_has_one():
    numbers = np.zeros((24, 24, 24), np.int16)
    numbers[2:22, 2:22, 2:22] = 1
    numbers[9, 9, 9] = 2
    domain = wc.Domain.from_labels(numbers, spacing=(0.005, 0.005, 0.005), labels={"organ": 1, "speck": 2})
    mesh = wc.TetForest.from_domain(domain, target_elements=1000)
    assert not fidelity(mesh, domain).lost_labels
    at = mesh.points[mesh.tets[mesh.elements_of("speck")]].mean(axis=1)
    assert np.linalg.norm(at - 0.045, axis=1).max() < 0.03


def test_the_same_mesh_comes_out_twice():
    one, two = (wc.TetForest.from_domain(SHAPES["tube"](), target_elements=2000) for _ in range(2))
    assert np.array_equal(one.lattice, two.lattice)
    assert np.array_equal(one.tets, two.tets)
    assert np.array_equal(one.fill, two.fill)


def test_slivers_that_connect_stay():
    """A row of cubes' elements, nearly empty except at the ends: all are kept, or the ends would separate."""
    row = wc.TetForest.box((6, 1, 1))
    volume = row.volumes
    middle = row.points[row.tets].mean(axis=1)[:, 0]
    held = np.where((middle < 1.0) | (middle > 5.0), 1.0, 0.01) * volume
    volumes, given_up = without_slivers(row.tets, held, volume, 0.02)
    assert volumes.sum() == pytest.approx(held.sum())
    kept = np.flatnonzero(~given_up)
    assert given_up.any()
    pairs = face_pairs(row.tets[kept])
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    links = coo_array((np.ones(len(pairs)), pairs.T), shape=(len(kept), len(kept)))
    assert connected_components(links)[0] == 1


def test_a_cube_is_meshed_with_the_requested_number(tmp_path):
    """Many of its elements have equal needs, so that none of them fits the number, and nothing is left to evaluate."""
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "cube.stl")
    mesh = wc.TetForest.from_domain(wc.Domain.from_surface(tmp_path / "cube.stl"), target_elements=20000)
    assert 18000 <= len(mesh.tets) <= 20000


def test_cubes_far_too_many_for_the_elements_are_refused_before_they_are_made() -> None:
    with pytest.raises(wc.InputError, match=r"cell_size is 0\.001 m, .* 1e\+09 cubes; target_elements=50"):
        wc.TetForest.from_domain(wc.Domain.box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0)), 0.001, target_elements=50)


def test_a_pipe_with_a_wall_thinner_than_its_elements_stays_whole():
    """A wall of 1 % of the radius, a thirtieth of an element; by random points most elements held nothing of it."""
    pipe = trimesh.creation.annulus(0.0198, 0.02, 0.3, sections=64)
    domain = wc.Domain.from_surface((pipe.vertices, pipe.faces))
    mesh = wc.TetForest.from_domain(domain, target_elements=4000)
    found = fidelity(mesh, domain)
    assert found.pieces == 1
    assert 0.9 * 4000 < len(mesh.tets) <= 4000
    assert abs(found.volume_error) < 0.03


def test_disconnected_tips_are_left_out_of_a_body_of_one_piece():
    """A spike that ends in a blob of 4e-6 of the body, whose elements alone would be a piece. A warning names larger
    tips, of up to 2e-4."""
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [5, 6, 7, 8]], np.int32)
    held, none = np.array([1.0, 1.0, 4.0e-6]), np.zeros(3, bool)
    ball, balls = trimesh.creation.icosphere(2), trimesh.creation.icosphere(2).apply_translation((3.0, 0.0, 0.0))
    one = wc.Domain.from_surface((ball.vertices, ball.faces))
    found, said = strays(tets, held, none, one)
    assert found.tolist() == [False, False, True]
    assert not said
    assert "1 pieces of the mesh" in strays(tets, held * [1.0, 1.0, 80.0], none, one)[1]
    assert not strays(tets, held * [1.0, 1.0, 200.0], none, one)[0].any()
    both = trimesh.util.concatenate([ball, balls])
    assert not strays(tets, held, none, wc.Domain.from_surface((both.vertices, both.faces)))[0].any()


def test_tips_of_crossing_parts_are_left_out_as_well():
    """Needles stuck into a ball, parts of one piece: tips hang on by less than a face, and the mesh says so."""
    needles = []
    for direction in np.random.default_rng(1).standard_normal((20, 3)):
        needle = trimesh.creation.cone(0.1, 3.4, sections=8)
        needles.append(needle.apply_transform(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], direction)))
    body = trimesh.util.concatenate([trimesh.creation.icosphere(2), *needles])
    domain = wc.Domain.from_surface((body.vertices, body.faces))
    with pytest.warns(UserWarning, match="tips of the body"):
        mesh = wc.TetForest.from_domain(domain, target_elements=2000)
    assert fidelity(mesh, domain).pieces == 1
