"""Tetrahedra from files, messages about bad ones, and the surface of a mesh."""

import importlib.util
import logging
import re

import numpy as np
import pytest
from pxr import Gf, Sdf, Usd, UsdGeom, Vt

from warp_corot.errors import InputError
from warp_corot.io.read.meshes import ASSETS, load_tets
from warp_corot.mesh.topology import boundary_faces, signed_volumes

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]], dtype=np.float64)
TETS = np.array([[0, 1, 2, 3], [1, 2, 3, 4]], dtype=np.int32)


def write_usd(path, points=POINTS, tets=TETS, *, kind="TetMesh", metres=1.0, up_axis="Y", transform=None, prims=1):
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, metres)
    UsdGeom.SetStageUpAxis(stage, up_axis)
    root = UsdGeom.Xform.Define(stage, "/root")
    if transform is not None:
        root.AddTransformOp().Set(transform)
    indices = np.ascontiguousarray(tets, dtype=np.int32)
    for index in range(prims):
        if kind == "TetMesh":
            prim = UsdGeom.TetMesh.Define(stage, f"/root/body{index}")
            prim.CreateTetVertexIndicesAttr(Vt.Vec4iArray.FromNumpy(indices))
        else:
            prim = UsdGeom.Mesh.Define(stage, f"/root/body{index}")
            attribute = prim.GetPrim().CreateAttribute("tetraIndices", Sdf.ValueTypeNames.IntArray)
            attribute.Set(Vt.IntArray.FromNumpy(indices.reshape(-1)))
        prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, dtype=np.float32)))
    stage.GetRootLayer().Save()
    return path


@pytest.mark.parametrize("suffix", [".usd", ".usda", ".usdc"])
@pytest.mark.parametrize("kind", ["TetMesh", "Mesh"])
def test_usd_tetrahedra_come_in_metres_and_world_space(tmp_path, suffix, kind):
    turned = Gf.Matrix4d().SetRotate(Gf.Rotation(Gf.Vec3d(0, 0, 1), 90.0))
    turned.SetTranslateOnly(Gf.Vec3d(0, 0, 5))
    path = write_usd(tmp_path / f"body{suffix}", kind=kind, metres=0.01, up_axis="Z", transform=turned, prims=2)
    loaded = load_tets(path, scale=2.0)
    x, y, z = POINTS.T
    expected = 0.02 * np.stack([-y, x, z + 5.0], axis=1)
    assert loaded.points.dtype == np.float64
    assert np.allclose(loaded.points, np.concatenate([expected, expected]))
    assert loaded.cells.dtype == np.int32
    assert np.array_equal(loaded.cells, np.concatenate([TETS, TETS + len(POINTS)]))
    assert (loaded.up_axis, loaded.metres, loaded.name) == ("Z", 0.01, "body")


def test_usdz(tmp_path):
    from pxr import UsdUtils

    packed = tmp_path / "body.usdz"
    assert UsdUtils.CreateNewUsdzPackage(str(write_usd(tmp_path / "body.usdc")), str(packed))
    assert np.allclose(load_tets(packed).points, POINTS)


def test_the_bear_is_as_the_asset_says():
    loaded = load_tets("warp:bear", scale=ASSETS["bear"].scale)
    assert loaded.points.shape == (1986, 3)
    assert loaded.cells.shape == (5354, 4)
    assert (loaded.up_axis, loaded.metres, loaded.name) == ("Y", 1.0, "bear")
    assert np.isclose(np.ptp(loaded.points[:, 1]), 0.554, atol=1e-3)


@pytest.mark.parametrize("suffix", [".msh", ".vtk", ".vtu", ".mesh"])
def test_meshio_formats(tmp_path, suffix):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / f"body{suffix}"
    meshio.write_points_cells(path, POINTS, [("triangle", [[0, 1, 2]]), ("tetra", TETS[:1]), ("tetra", TETS[1:])])
    loaded = load_tets(path, scale=0.5)
    assert np.allclose(loaded.points, 0.5 * POINTS)
    assert np.array_equal(loaded.cells, TETS)


def test_second_order_tetrahedra_give_their_corners(tmp_path, caplog):
    meshio = pytest.importorskip("meshio")
    path = tmp_path / "body.vtu"
    corners = POINTS[:4]
    middles = [(corners[a] + corners[b]) / 2 for a, b in [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]]
    meshio.write_points_cells(path, np.concatenate([corners, middles]), [("tetra10", [list(range(10))])])
    with caplog.at_level(logging.WARNING):
        loaded = load_tets(path)
    assert np.array_equal(loaded.cells, [[0, 1, 2, 3]])
    assert "second-order" in caplog.text


def refused(path, match, **options):
    with pytest.raises(InputError, match=match) as raised:
        load_tets(path, **options)
    assert "\n" not in str(raised.value)
    return str(raised.value)


def test_invalid_files_are_refused_in_one_line(tmp_path):
    refused(tmp_path / "none.usd", "none.usd: no such file")
    refused(tmp_path, "is a folder")
    refused("warp:lion", "warp:bear")
    refused("", "is a folder|no such file")
    for name in ("bad.usd", "bad.usda", "bad.usdc", "bad.usdz", "bad.vtk", "bad.msh", "bad.vtu", "bad.stl"):
        pytest.importorskip("meshio")
        path = tmp_path / name
        path.write_bytes(b"")
        refused(path, "is empty")
        path.write_bytes(bytes(range(256)) * 9)
        assert name in refused(path, "is not a")
    path = tmp_path / "text.docx"
    path.write_text("words")
    refused(path, r"unknown format .docx; it must be .usd, .*\.msh")


def test_truncated_files_are_refused(tmp_path):
    meshio = pytest.importorskip("meshio")
    for name in ("whole.vtu", "whole.usdc"):
        path = tmp_path / name
        if name.endswith(".usdc"):
            write_usd(path)
        else:
            meshio.write_points_cells(path, POINTS, [("tetra", TETS)])
        cut = tmp_path / f"cut{path.suffix}"
        cut.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
        refused(cut, "cut")


def test_meshes_without_usable_tetrahedra_are_refused(tmp_path):
    meshio = pytest.importorskip("meshio")
    flat = tmp_path / "flat.vtk"
    meshio.write_points_cells(flat, POINTS, [("triangle", [[0, 1, 2]])])
    refused(flat, "has no tetrahedra .cell types: triangle")
    refused(write_usd(tmp_path / "empty.usd", tets=np.empty((0, 4))), "has no tetrahedra")
    stage = Usd.Stage.CreateNew(str(tmp_path / "sphere.usda"))
    UsdGeom.Sphere.Define(stage, "/ball")
    stage.GetRootLayer().Save()
    refused(tmp_path / "sphere.usda", "has no tetrahedra")

    nan = POINTS.copy()
    nan[3, 1] = np.nan
    refused(write_usd(tmp_path / "nan.usd", points=nan), "point 3 has coordinates .*nan")
    nan[3, 1] = np.inf
    meshio.write_points_cells(tmp_path / "inf.vtu", nan, [("tetra", TETS)])
    refused(tmp_path / "inf.vtu", "point 3 has coordinates .*inf")

    beyond = TETS.copy()
    beyond[1, 2] = 5
    refused(write_usd(tmp_path / "beyond.usd", tets=beyond), "names point 5 but has points 0 to 4")
    meshio.write_points_cells(tmp_path / "beyond.vtu", POINTS, [("tetra", beyond)])
    refused(tmp_path / "beyond.vtu", "tetrahedron 1 names point 5 but the points are 0 to 4")
    beyond[1, 2] = -1
    refused(write_usd(tmp_path / "below.usd", tets=beyond), "names point -1")
    refused(write_usd(tmp_path / "seven.usd", tets=np.arange(7), kind="Mesh"), "7 indices, not a multiple of four")
    refused(write_usd(tmp_path / "pointless.usd", points=np.empty((0, 3))), "no points")

    good = write_usd(tmp_path / "good.usd")
    for scale in (0.0, -1.0, np.nan, np.inf):
        refused(good, "scale is", scale=scale)


def test_a_missing_reader_is_named(tmp_path, monkeypatch):
    original = importlib.util.find_spec
    missing = ("vtkmodules", "SimpleITK")
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name in missing else original(name))
    for suffix, extra in ((".vtp", "mesh"), (".vtu", "mesh"), (".nii.gz", "scans")):
        path = tmp_path / f"body{suffix}"
        path.write_text("something")
        refused(path, re.escape(f'pip install "warp-corot[{extra}]"'))


def cube_tets(n: int, rng) -> tuple[np.ndarray, np.ndarray]:
    """Six path tetrahedra in each of n³ cubes, half of them mirrored, in random order."""
    grid = np.arange((n + 1) ** 3).reshape(n + 1, n + 1, n + 1)
    points = np.stack(np.meshgrid(*[np.arange(n + 1.0)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    tets = []
    for axes in ([0, 1, 2], [0, 2, 1], [1, 0, 2], [1, 2, 0], [2, 0, 1], [2, 1, 0]):
        walk = np.cumsum([np.zeros(3, int), *np.eye(3, dtype=int)[axes]], axis=0)
        corners = [grid[x : n + x, y : n + y, z : n + z].ravel() for x, y, z in walk]
        tets.append(np.stack(corners, axis=1))
    return points, rng.permutation(np.concatenate(tets)).astype(np.int32)


def test_boundary_faces_close_the_volume(rng):
    points, tets = cube_tets(3, rng)
    volumes = signed_volumes(points, tets)
    assert (volumes < 0.0).sum() == len(tets) / 2
    faces, parents = boundary_faces(tets, points)
    assert faces.dtype == parents.dtype == np.int32
    assert len(faces) == 6 * 2 * 3**2
    # Outward normals: the divergence theorem gives the volume, each normal points away from its tetrahedron, and every
    # edge of a closed surface is walked once in each direction.
    assert np.isclose(np.linalg.det(points[faces]).sum() / 6.0, np.abs(volumes).sum())
    normals = np.cross(points[faces[:, 1]] - points[faces[:, 0]], points[faces[:, 2]] - points[faces[:, 0]])
    inward = points[tets[parents]].mean(axis=1) - points[faces].mean(axis=1)
    assert (np.einsum("ij,ij->i", normals, inward) < 0.0).all()
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there, back = (np.unique(e, axis=0, return_counts=True) for e in (edges, edges[:, ::-1]))
    assert np.array_equal(there[0], back[0])
    assert np.all([np.isin(face, tet).all() for face, tet in zip(faces, tets[parents], strict=True)])


def test_boundary_faces_with_large_node_numbers(rng):
    """Node numbers too large for three in one 64-bit key give the same faces."""
    _, tets = cube_tets(2, rng)
    faces, parents = boundary_faces(tets)
    moved = tets + np.int32(2**31 - 1 - tets.max())
    far_faces, far_parents = boundary_faces(moved)
    assert np.array_equal(far_faces - (moved - tets)[0, 0], faces)
    assert np.array_equal(far_parents, parents)


def test_overlapping_tetrahedra_are_said():
    with pytest.warns(UserWarning, match=r"1 faces are shared by more than two .* \[0, 1, 2\] by 3"):
        faces, _ = boundary_faces([[0, 1, 2, 3], [0, 1, 2, 4], [0, 1, 2, 5]])
    assert len(faces) == 9
    assert len(boundary_faces(np.empty((0, 4), int))[0]) == 0
