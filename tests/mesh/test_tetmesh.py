"""General tetrahedral meshes: repairs, refusals, and their messages."""

import numpy as np
import oracle
import pytest
from cases import MATERIAL, MODELS, jittered, oracle_mesh, place, simulation

import warp_corot as wc

POINTS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]])
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])


def signed_volumes(mesh):
    corners = mesh.points[mesh.tets]
    return np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6


def test_right_meshes_are_kept_as_they_are():
    mesh = wc.TetMesh(POINTS, TETS)
    assert mesh.repaired == 0
    assert mesh.points.dtype == np.float64
    assert mesh.tets.dtype == np.int32
    assert np.array_equal(mesh.points, POINTS)
    assert np.array_equal(mesh.tets, TETS)
    assert mesh.up_axis == "Y"
    assert wc.TetMesh(POINTS, TETS, up_axis="Z").up_axis == "Z"


def test_wound_wrongly_is_repaired_and_counted(rng):
    mesh = jittered()
    tets = mesh.tets.copy()
    wrong = rng.random(len(tets)) < 0.3
    tets[wrong] = tets[wrong][:, [0, 2, 1, 3]]
    given = tets.copy()
    repaired = wc.TetMesh(mesh.points, tets)
    assert repaired.repaired == wrong.sum() > 0
    assert (signed_volumes(repaired) > 0).all()
    assert np.array_equal(np.sort(repaired.tets, axis=1), np.sort(mesh.tets, axis=1))
    assert np.array_equal(tets, given)  # the caller's array is unchanged


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_not_finite(bad):
    points = POINTS.copy()
    points[3, 1] = bad
    with pytest.raises(wc.InputError, match=r"\b3\b"):
        wc.TetMesh(points, TETS)


@pytest.mark.parametrize(
    "corner",
    [[1.0, 1.0, -1.0], [0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [1 / 3, 1 / 3, 1 / 3 + 1e-15]],
    ids=["flat", "on an edge", "on a node", "flat to rounding"],
)
def test_degenerate_element_is_named(corner):
    """The second tetrahedron's last corner lies in the plane of its other three."""
    points = POINTS.copy()
    points[4] = corner
    with pytest.raises(wc.InputError, match=r"\b1\b"):
        wc.TetMesh(points, TETS)


def test_degenerate_is_measured_by_shape_not_by_size():
    assert wc.TetMesh(1e-6 * POINTS, TETS).repaired == 0
    assert wc.TetMesh(1e4 * POINTS, TETS).repaired == 0


@pytest.mark.parametrize("index", [5, -1])
def test_index_out_of_range(index):
    tets = TETS.copy()
    tets[1, 2] = index
    with pytest.raises(wc.InputError, match=rf"{index}"):
        wc.TetMesh(POINTS, tets)


@pytest.mark.parametrize(
    ("points", "tets"),
    [
        (POINTS[:, :2], TETS),
        (POINTS, TETS[:, :3]),
        (POINTS, np.zeros((0, 4), int)),
        (np.zeros((0, 3)), np.zeros((0, 4), int)),
        (POINTS, TETS + 0.5),
    ],
    ids=["points in the plane", "triangles", "no tetrahedra", "nothing", "indices that are not whole"],
)
def test_shapes(points, tets):
    with pytest.raises(wc.InputError):
        wc.TetMesh(points, tets)


def test_up_axis():
    with pytest.raises(wc.InputError, match="W"):
        wc.TetMesh(POINTS, TETS, up_axis="W")


@pytest.mark.parametrize("model", MODELS)
def test_unreferenced_nodes_stay_where_they_are(model, device):
    """A node of no tetrahedron has no mass and does not move, and the others move as without it."""
    lone = np.insert(POINTS, [0, 2, 5], [[9.0, 9, 9], [0.3, 0.3, 0.3], [-9, 0, 0]], axis=0)
    kept = np.array([1, 2, 4, 5, 6])
    assert np.array_equal(lone[kept], POINTS)
    ends = []
    for points, tets, nodes in ((lone, kept[TETS], kept), (POINTS, TETS, np.arange(5))):
        mesh = wc.TetMesh(points, tets)
        assert len(mesh.points) == len(points)
        sim, body = simulation(mesh, model, device, dt=1e-3, gravity=(0, -9.8, 0))
        body.fix(points[:, 0] == 0)
        assert body.masses.sum() == pytest.approx(oracle_mesh(mesh).volumes.sum() * MATERIAL["density"])
        sim.advance(0.1)
        x = body.positions.numpy()
        assert np.isfinite(x).all()
        assert np.isfinite(sim.energy().total)
        ends.append(x[nodes])
        others = np.setdiff1d(np.arange(len(points)), nodes)
        assert np.array_equal(x[others], points[others].astype(np.float32))
        assert not body.velocities.numpy()[others].any()
        assert (body.masses[others] == 0).all()
    assert np.abs(ends[0] - POINTS).max() > 1e-3
    assert np.abs(ends[0] - ends[1]).max() < 1e-6


def test_node_order_does_not_matter(device, rng):
    """Renumbered nodes and tetrahedra give the renumbered forces."""
    mesh = jittered()
    order = rng.permutation(len(mesh.points))
    place_of = np.argsort(order)
    other = wc.TetMesh(mesh.points[order], rng.permutation(place_of[mesh.tets]))
    u = (0.002 * rng.standard_normal(mesh.points.shape)).astype(np.float32)
    forces = []
    for each, displacement in ((mesh, u), (other, u[order])):
        sim, body = simulation(each, "corotated", device)
        place(body, displacement)
        forces.append(sim.forces().numpy())
    assert np.abs(forces[1] - forces[0][order]).max() < 1e-5 * np.abs(forces[0]).max()


def test_masses_and_volume():
    mesh = jittered()
    masses = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.3, density=1050.0), device="cpu").masses
    assert masses.dtype == np.float64
    assert masses == pytest.approx(oracle.Mesh(mesh.points, mesh.tets).masses(1050.0), rel=1e-12)
