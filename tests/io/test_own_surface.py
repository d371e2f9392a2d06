"""The user's own surface on a body: bound to any mesh, drawn with its file's data."""

import numpy as np
import pytest
import trimesh
from command_line import SHORT, simulate
from pxr import Usd, UsdGeom, UsdShade
from stages import drawn, still

import warp_corot as wc


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def textured(path):
    """A ball of 6 cm with texture coordinates and a material, in millimetres."""
    ball = trimesh.creation.icosphere(3, radius=30.0)
    uv = ball.vertices[:, :2] / 60.0 + 0.5
    material = trimesh.visual.material.SimpleMaterial(diffuse=[200, 40, 40, 255])
    ball.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    ball.export(path)
    return ball


def meshes_in(path):
    stage = Usd.Stage.Open(str(path))
    return stage, [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def test_a_surface_is_drawn_as_it_was_given(folder):
    ball = textured(folder / "ball.obj")
    assert simulate("ball.obj", "--unit", "mm", "--tets", 600, "-o", "a.usd", *SHORT) == 0
    _, (mesh,) = meshes_in("a.usd")
    points = np.array(mesh.GetPointsAttr().Get(0))
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    assert len(faces) == len(ball.faces)
    np.testing.assert_allclose(np.linalg.norm(points, axis=1), 0.03, rtol=1e-3)
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").Get()
    np.testing.assert_allclose(np.array(st), points[:, :2] / 0.06 + 0.5, atol=1e-3)
    assert UsdShade.MaterialBindingAPI(mesh).ComputeBoundMaterial()[0]
    last = np.array(mesh.GetPointsAttr().Get(2))
    assert (last - points)[:, 1].min() < -1e-5
    assert len(mesh.GetPrim().GetAttribute("primvars:vonMises").Get(0)) == len(points)


def ball_with_cavity(path, *turned):
    """A ball of 6 cm with a cavity of 2 cm beside its centre, in millimetres, with some of its triangles turned round;
    its volume [m^3]."""
    outer, inner = trimesh.creation.icosphere(3, radius=30.0), trimesh.creation.icosphere(2, radius=10.0)
    inner.apply_translation([8.0, 0.0, 0.0]).invert()
    both = trimesh.util.concatenate([outer, inner])
    for some in turned:
        both.faces[some] = both.faces[some][:, ::-1]
    both.export(path)
    return 1e-9 * (outer.volume + inner.volume)


ALL, SOME = slice(None), slice(None, None, 3)


@pytest.mark.parametrize("turned", [(ALL,), (SOME,), (ALL, SOME)])
def test_surfaces_are_drawn_wound_as_their_bodies(turned, folder):
    """In the stage, its normals and previews, whatever the file's winding; a cavity stays turned inwards."""
    volume = ball_with_cavity("ball.ply", *turned)
    assert simulate("ball.ply", "--unit", "mm", "--tets", 600, "-o", "a.usd", *SHORT) == 0
    stage, (mesh,) = meshes_in("a.usd")
    surface = drawn(stage, str(mesh.GetPath()))
    assert surface.volume == pytest.approx(volume, rel=1e-3)
    assert mesh.GetOrientationAttr().Get() == "rightHanded"
    assert not mesh.GetDoubleSidedAttr().Get()
    normals = np.array(mesh.GetNormalsAttr().Get(0))
    assert (np.einsum("ij,ij->i", normals, surface.vertex_normals) > 0.9).all()
    tets = wc.TetForest.box((2, 2, 2), 0.04, 3, origin=(-0.04, -0.04, -0.04))
    given = trimesh.load("ball.ply", process=False)
    assert tets.bind(1e-3 * given.vertices, given.faces).volume == pytest.approx(volume, rel=1e-3)
    body = wc.SoftBody(tets, wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
    given.apply_scale(1e-3).export("metres.ply")
    shown = still(wc.Simulation(body), folder / "b.usd", surface="metres.ply")
    assert drawn(shown, "/SoftBody/surface").volume == pytest.approx(volume, rel=1e-3)


def test_the_objects_of_a_file_are_drawn_each_wound_as_its_body(folder, capsys):
    balls = [trimesh.creation.icosphere(2, radius=30.0).apply_translation([x, 0.0, 0.0]) for x in (0.0, 90.0)]
    volume = 1e-9 * balls[0].volume
    for ball in balls:
        ball.invert()
    trimesh.Scene({"left": balls[0], "right": balls[1]}).export("pair.obj")
    assert simulate("pair.obj", "--unit", "mm", "--tets", 800, "-o", "a.usd", *SHORT) == 0
    assert "2 separate bodies" in capsys.readouterr().err
    stage, meshes = meshes_in("a.usd")
    assert {str(mesh.GetPath()) for mesh in meshes} == {"/SoftBody/left", "/SoftBody/right"}
    assert [drawn(stage, str(mesh.GetPath())).volume for mesh in meshes] == pytest.approx([volume, volume], rel=1e-3)


def test_a_surface_with_a_hole_shows_its_inside(folder, capsys):
    ball = trimesh.creation.icosphere(3, radius=30.0)
    trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 25.0]).export("bowl.stl")
    assert simulate("bowl.stl", "--tets", 400, "-o", "a.usd", *SHORT) == 0
    first, *others = capsys.readouterr().err.splitlines()
    assert "names no unit: its 60 units are taken as mm" in first
    assert "warning: bowl.stl: the surface is open" in others[-1]
    _, (mesh,) = meshes_in("a.usd")
    assert mesh.GetDoubleSidedAttr().Get()


def test_the_marched_surface_is_the_other_choice(folder):
    textured(folder / "ball.obj")
    assert simulate("ball.obj", "--unit", "mm", "--tets", 600, "--skin", "marched", "-o", "a.usd", *SHORT) == 0
    _, (mesh,) = meshes_in("a.usd")
    assert str(mesh.GetPath()) == "/SoftBody/surface"


def test_a_plain_surface_shows_the_stress(folder):
    trimesh.creation.icosphere(2, radius=0.03).export(folder / "ball.stl")
    assert simulate("ball.stl", "--unit", "m", "--tets", 400, "-o", "a.usd", *SHORT) == 0
    _, (mesh,) = meshes_in("a.usd")
    assert mesh.GetDisplayColorPrimvar().GetAttr().HasValue()
    assert mesh.GetPrim().GetAttribute("primvars:displayColor:indices").GetNumTimeSamples()


def test_a_written_surface_is_an_input_again(folder):
    """A surface that shows the stress of one run shows that of the next one."""
    trimesh.creation.icosphere(2, 0.03).export(folder / "ball.ply")
    assert simulate("ball.ply", "-o", "a.usd", "--unit", "m", "--tets", 300, *SHORT) == 0
    assert simulate("a.usd", "-o", "b.usd", "--tets", 300, "--young", 5e3, *SHORT) == 0
    stages = [Usd.Stage.Open(str(folder / name)) for name in ("a.usd", "b.usd")]
    first, again = (stage.GetPrimAtPath("/SoftBody/surface") for stage in stages)
    for name in ("primvars:vonMises", "primvars:displayColor:indices"):
        one, other = (np.array(prim.GetAttribute(name).Get(2)) for prim in (first, again))
        assert one.shape == other.shape
        assert (one != other).any()


def test_remeshed_bodies_carry_it(folder):
    trimesh.creation.box((0.02, 0.02, 0.08)).subdivide().subdivide().export(folder / "bar.stl")
    args = [
        "--unit",
        "m",
        "--tets",
        400,
        "--young",
        2e3,
        "--remesh",
        "--refine-above",
        1.001,
        "--simplify-below",
        1.0005,
    ]
    assert simulate("bar.stl", *args, "-o", "a.usd", "--duration", 0.1, "--fps", 20, "--device", "cpu") == 0
    _, (mesh,) = meshes_in("a.usd")
    first, last = (np.array(mesh.GetPointsAttr().Get(frame)) for frame in (0, 2))
    assert first.shape == last.shape
    assert np.isfinite(last).all()
    # With a good binding edges change little: nothing protrudes.
    faces = np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    before, after = (np.linalg.norm(x[faces[:, 0]] - x[faces[:, 1]], axis=1) for x in (first, last))
    assert np.abs(after / before - 1).max() < 0.5


def test_points_in_tetrahedra_of_any_shape():
    """Linear functions are exact at bound points, inside and outside, and affine motions move them exactly."""
    forest = wc.TetForest.box((2, 2, 2), 0.5, 6)
    rng = np.random.default_rng(0)
    inner = ((forest.points > 0) & (forest.points < 1)).all(axis=1)
    points = forest.points + np.where(inner[:, None], 0.02, 0.0) * rng.standard_normal(forest.points.shape)
    mesh = wc.TetMesh(points, forest.tets)
    x = 1.2 * rng.random((3000, 3)) - 0.1
    elements, weights = mesh.embed(x)
    within = ((x > 0) & (x < 1)).all(axis=1)
    assert weights[within].min() > -1e-6
    np.testing.assert_allclose(np.einsum("nk,nkc->nc", weights, mesh.points[mesh.tets[elements]]), x, atol=1e-12)
    motion = rng.standard_normal((3, 3))
    np.testing.assert_allclose(mesh.bind(x).moved(mesh.points @ motion), x + x @ motion, atol=1e-12)


def test_the_device_moves_bound_points_as_the_host_does(device):
    domain = wc.Domain.sphere(0.05)
    mesh = wc.TetForest.from_domain(domain, target_elements=500)
    ball = trimesh.creation.icosphere(2, radius=0.05)
    bound = mesh.bind(ball.vertices, ball.faces)
    moves = np.random.default_rng(0).standard_normal(mesh.points.shape).astype(np.float32) * 1e-3
    binding = bound.on_device(device)
    import warp as wp

    binding.update(wp.array(moves, dtype=wp.vec3, device=device))
    np.testing.assert_allclose(binding.positions.numpy(), bound.moved(moves), atol=1e-7)
