"""Stages of bodies whose meshes change: at every frame, and between frames, data that belong together match."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom
from stages import SURFACE, TETS, assert_whole, edges_meet_in_pairs, faults

import warp_corot as wc
from warp_corot.io.pictures.colors import VertexAverage, color_index
from warp_corot.io.read.meshes import load_tets
from warp_corot.io.write.skins import BoundSkins
from warp_corot.io.write.usd.writer import UsdWriter
from warp_corot.mesh.topology import boundary_faces

BOX = wc.TetForest.box((2, 1, 1), 0.1, 2)
VOLUME = 2 * 0.1**3
FINER = BOX.refine([0, 5])
#: Another leaf of the same kind refined: the same numbers of nodes and tetrahedra, but others.
OTHER = BOX.refine([len(BOX.tets) - 1])
TWIN = next(
    mesh
    for leaf in range(len(BOX.tets))
    if (mesh := BOX.refine([leaf])).points.shape == OTHER.points.shape
    and mesh.tets.shape == OTHER.tets.shape
    and not np.array_equal(mesh.points, OTHER.points)
)
#: The mesh of each frame.
SHOWN = [BOX, BOX, FINER, FINER, FINER.refine([3]), OTHER, OTHER, TWIN, TWIN, BOX]
CHANGES = [0.0, 2.0, 4.0, 5.0, 7.0, 9.0]


class Material:
    """A modulus that differs in each tetrahedron."""

    poisson, density = 0.4, 1000.0

    def __init__(self, mesh):
        self.young = 1e3 * (1.0 + mesh.points[mesh.tets].mean(axis=1)[:, 0])


def state(mesh, k):
    """Positions, velocities and stresses of a frame, smooth functions of the rest position."""
    x = mesh.points
    gradient = np.eye(3) + 0.01 * k * np.array([[1.0, 2.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, 1.0]])
    middle = x[mesh.tets].mean(axis=1)
    return x @ gradient.T, x + 0.1 * k, 100.0 * (k + 1) * (1.0 + middle[:, 0])


def write(path: Path, flush_every=0, close=True, shown=SHOWN, skins=None, **options) -> UsdWriter:
    bound = None if skins is None else BoundSkins([shown[0]], **skins)
    fixed = [mesh.points[:, 0] == 0.0 for mesh in shown]
    first = bound.on([shown[0]]) if bound else ()
    writer = UsdWriter(
        path, shown[0], fps=25, fixed=fixed[0], material=Material(shown[0]), skins=first, changing=True, **options
    )
    for k, mesh in enumerate(shown):
        if k and mesh is not shown[k - 1]:
            own = bound.on([mesh]) if bound else ()
            writer.change_mesh(mesh, fixed=fixed[k], material=Material(mesh), skins=own)
        x, v, stress = state(mesh, k)
        writer.write(x, velocities=v, von_mises=stress)
        if flush_every and writer.frames % flush_every == 0:
            writer.flush()
    if close:
        writer.close()
    else:
        writer.flush()
    return writer


@pytest.mark.parametrize("flush_every", [0, 1, 3], ids=["at once", "a piece a frame", "pieces"])
@pytest.mark.parametrize("close", [True, False], ids=["joined", "in pieces"])
def test_every_frame_shows_its_own_mesh(tmp_path, flush_every, close):
    path = tmp_path / "a.usd"
    writer = write(path, flush_every, close)
    assert faults(path) == []
    stage = Usd.Stage.Open(str(path))
    assert stage.GetEndTimeCode() == len(SHOWN) - 1
    for k, mesh in enumerate(SHOWN):
        points, rest, indices = assert_whole(stage, float(k), VOLUME)
        x, v, stress = state(mesh, k)
        np.testing.assert_array_equal(points, x.astype(np.float32))
        np.testing.assert_array_equal(rest, mesh.points.astype(np.float32))
        np.testing.assert_array_equal(np.sort(indices, axis=1), np.sort(mesh.tets, axis=1))
        tets = UsdGeom.TetMesh.Get(stage, TETS)
        np.testing.assert_array_equal(tets.GetVelocitiesAttr().Get(k), v.astype(np.float32))
        primvars = UsdGeom.PrimvarsAPI(tets)
        np.testing.assert_array_equal(primvars.GetPrimvar("vonMises").Get(k), stress.astype(np.float32))
        np.testing.assert_array_equal(primvars.GetPrimvar("young").Get(k), Material(mesh).young.astype(np.float32))
        np.testing.assert_array_equal(primvars.GetPrimvar("fixed").Get(k), mesh.points[:, 0] == 0.0)
        np.testing.assert_array_equal(tets.GetExtentAttr().Get(k), [points.min(axis=0), points.max(axis=0)])
    assert primvars.GetPrimvar("poisson").Get() == pytest.approx(0.4)
    if not close:
        writer.close()


def test_topology_is_written_where_it_changes_only(tmp_path):
    write(tmp_path / "a.usd", flush_every=3)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    for attribute in (tets.GetTetVertexIndicesAttr(), tets.GetSurfaceFaceVertexIndicesAttr()):
        assert attribute.GetTimeSamples() == CHANGES
    # Inside the box the refinement of a leaf can leave the boundary as it is, never the other way round.
    surface = UsdGeom.Mesh.Get(stage, SURFACE).GetFaceVertexIndicesAttr().GetTimeSamples()
    assert set(surface) <= set(CHANGES)
    constant = write(tmp_path / "b.usd", shown=[BOX] * 4)
    stage = Usd.Stage.Open(str(constant.path))
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    assert tets.GetTetVertexIndicesAttr().GetTimeSamples() == [0.0]


def test_a_change_inside_leaves_the_boundary_as_it_is(tmp_path):
    mesh = wc.TetForest.box((1, 1, 1), 0.1, 6)
    inside = next(
        finer
        for leaf in range(len(mesh.tets))
        if ((finer := mesh.refine([leaf])).points[len(mesh.points) :] % 0.1 > 1e-9).all()
    )
    write(tmp_path / "a.usd", shown=[mesh, inside])
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    surface = UsdGeom.Mesh.Get(stage, SURFACE)
    assert surface.GetFaceVertexIndicesAttr().GetTimeSamples() == [0.0]
    assert surface.GetPointsAttr().GetTimeSamples() == [0.0, 1.0]


@pytest.mark.parametrize("flush_every", [0, 1, 3], ids=["at once", "a piece a frame", "pieces"])
@pytest.mark.parametrize("close", [True, False], ids=["joined", "in pieces"])
def test_points_of_different_meshes_are_never_interpolated(tmp_path, flush_every, close):
    assert len(OTHER.points) == len(TWIN.points)
    write(tmp_path / "a.usd", flush_every, close)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    for k, (mesh, after) in enumerate(itertools.pairwise(SHOWN)):
        for between in (0.25, 0.9):
            points, rest, _ = assert_whole(stage, k + between, VOLUME)
            np.testing.assert_array_equal(rest, mesh.points.astype(np.float32))
            share = 0.0 if after is not mesh else between
            expected = (1.0 - share) * state(mesh, k)[0] + share * state(mesh, k + 1)[0]
            np.testing.assert_allclose(points, expected, atol=1e-6)


def test_between_frames_points_go_along_their_velocities(tmp_path):
    write(tmp_path / "a.usd")
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    for path in (TETS, SURFACE):
        prim = UsdGeom.PointBased.Get(stage, path)
        for k in (1.0, 2.0, 6.0):
            points, velocities = (np.array(a.Get(k)) for a in (prim.GetPointsAttr(), prim.GetVelocitiesAttr()))
            moved = np.array(prim.ComputePointsAtTime(k + 0.5, k + 0.5))
            np.testing.assert_allclose(moved, points + 0.5 / 25.0 * velocities, atol=1e-6)


def test_one_color_range_holds_for_all_meshes(tmp_path):
    writer = write(tmp_path / "a.usd", flush_every=3)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    for k, mesh in enumerate(SHOWN):
        nodal = VertexAverage.of(mesh)(state(mesh, k)[2])[np.unique(boundary_faces(mesh.tets, mesh.points)[0])]
        colors = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(SURFACE)).GetPrimvar("displayColor").GetIndicesAttr()
        # The last digit of a rest position may decide between two neighbouring colours.
        assert np.abs(np.array(colors.Get(k)) - color_index(nodal, *writer.stress_range)).max() <= 1


def test_a_stage_that_changes_is_a_mesh_again_the_first_one(tmp_path):
    write(tmp_path / "a.usd", shown=[FINER, BOX, OTHER])
    loaded = load_tets(tmp_path / "a.usd")
    np.testing.assert_allclose(loaded.points, FINER.points, atol=1e-7)
    np.testing.assert_array_equal(np.sort(loaded.cells, axis=1), np.sort(FINER.tets, axis=1))


def test_a_surface_stays_the_same_on_every_mesh(tmp_path, rng):
    points = rng.uniform([0.0, 0.0, 0.0], [0.2, 0.1, 0.1], (30, 3))
    triangles = rng.permutation(30).reshape(-1, 3)
    write(tmp_path / "a.usd", flush_every=3, skins={"surface": BOX.bind(points, triangles)})
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    surface = UsdGeom.Mesh.Get(stage, SURFACE)
    assert surface.GetFaceVertexIndicesAttr().GetTimeSamples() == []
    np.testing.assert_array_equal(surface.GetFaceVertexIndicesAttr().Get(), triangles.ravel())
    rest = wc.TetForest.box((2, 1, 1), 0.1, 0)
    for k in range(len(SHOWN)):
        # An affine motion is the same on every mesh.
        gradient = np.linalg.lstsq(rest.points, state(rest, k)[0], rcond=None)[0]
        np.testing.assert_allclose(surface.GetPointsAttr().Get(k), points @ gradient, atol=1e-6)


def test_the_boundary_as_the_only_surface_is_that_of_the_present_mesh(tmp_path):
    write(tmp_path / "a.usd", flush_every=3, skins={})
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    surface = UsdGeom.Mesh.Get(stage, SURFACE)
    assert faults(tmp_path / "a.usd") == []
    for k, mesh in enumerate(SHOWN):
        for time in (float(k), k + 0.5)[: 2 if k + 1 < len(SHOWN) else 1]:
            drawn = np.array(surface.GetPointsAttr().Get(time), float)
            triangles = np.array(surface.GetFaceVertexIndicesAttr().Get(time)).reshape(-1, 3)
            assert triangles.max() + 1 == len(drawn)
            assert edges_meet_in_pairs(triangles)
        own = {tuple(np.float32(x)) for x in state(mesh, k)[0]}
        assert {tuple(x) for x in np.array(surface.GetPointsAttr().Get(k))} <= own


def test_wrong_use_is_named(tmp_path):
    writer = UsdWriter(tmp_path / "a.usd", BOX, fps=25)
    with pytest.raises(wc.InputError, match="must be made with changing=True"):
        writer.change_mesh(FINER)
    writer = UsdWriter(tmp_path / "b.usd", BOX, fps=25, changing=True)
    with pytest.raises(wc.InputError, match="2 skins now; there must be 1"):
        writer.change_mesh(FINER, skins=2 * BoundSkins([FINER]).on([FINER]))
    writer.write(BOX.points)
    writer.change_mesh(FINER)
    with pytest.raises(wc.InputError, match=rf"positions has shape .*; it must be \[{len(FINER.points)}, 3\]"):
        writer.write(BOX.points)
