"""A user's USD prims follow a body and keep their appearance."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade
from stages import faults, still

import warp_corot as wc


def simulated(mesh, device="cpu", young=1e4) -> wc.Simulation:
    return wc.Simulation(wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1e3), device=device), gravity=(0, 0, 0))


def textured_cube(path: Path, mirrored: bool) -> np.ndarray:
    """A cube of quads in centimetres, moved and optionally mirrored by its parent, with UVs, a texture, a subset."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    UsdGeom.SetStageUpAxis(stage, "Y")
    parent = UsdGeom.Xform.Define(stage, "/World")
    parent.AddTranslateOp().Set(Gf.Vec3d(1, 0, 0))
    parent.AddScaleOp().Set(Gf.Vec3f(-1 if mirrored else 1, 1, 1))
    mesh = UsdGeom.Mesh.Define(stage, "/World/Cube")
    mesh.AddTranslateOp().Set(Gf.Vec3d(0, 0.5, 0))
    quads = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]]
    points = np.array([[x, y, z] for x in (-2, 2) for y in (-2, 2) for z in (-2, 2)], float)
    assert np.isclose(trimesh.Trimesh(points, [[q[0], q[i], q[i + 1]] for q in quads for i in (1, 2)]).volume, 64)
    mesh.CreatePointsAttr([tuple(p) for p in points.tolist()])
    mesh.CreateFaceVertexCountsAttr([4] * 6)
    mesh.CreateFaceVertexIndicesAttr([i for quad in quads for i in quad])
    mesh.CreateSubdivisionSchemeAttr("none")
    mesh.CreateNormalsAttr([(0, 0, 1)] * 8)
    uv = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", Sdf.ValueTypeNames.TexCoord2fArray, "faceVarying")
    uv.Set([(i / 24, 1 - i / 24) for i in range(24)])
    (path.parent / "skin.png").write_bytes(b"picture")
    material = UsdShade.Material.Define(stage, "/World/Looks/Skin")
    shader = UsdShade.Shader.Define(stage, "/World/Looks/Skin/Shader")
    shader.CreateIdAttr("UsdPreviewSurface")
    texture = UsdShade.Shader.Define(stage, "/World/Looks/Skin/Texture")
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set("./skin.png")
    color = texture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).ConnectToSource(color)
    material.CreateSurfaceOutput().ConnectToSource(shader.CreateOutput("surface", Sdf.ValueTypeNames.Token))
    UsdShade.MaterialBindingAPI.Apply(parent.GetPrim()).Bind(material)  # inherited by the cube
    red = UsdShade.Material.Define(stage, "/World/Looks/Red")
    subset = UsdShade.MaterialBindingAPI(mesh.GetPrim()).CreateMaterialBindSubset("top", [3])
    UsdShade.MaterialBindingAPI.Apply(subset.GetPrim()).Bind(red)
    stage.Save()
    return 0.01 * (points * [-1 if mirrored else 1, 1, 1] + [1, 0.5, 0])


def _corners(mesh: UsdGeom.Mesh) -> set[tuple]:
    """The face, the point and the texture coordinates of each corner of quads."""
    st = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("st").ComputeFlattened()
    return {(k // 4, at, *st[k]) for k, at in enumerate(mesh.GetFaceVertexIndicesAttr().Get())}


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_prim_keeps_its_faces_texture_and_materials(tmp_path, mirrored):
    (tmp_path / "models").mkdir()
    world = textured_cube(tmp_path / "models" / "cube.usda", mirrored)
    mesh = wc.TetForest.box((1, 1, 1), 0.05, 3, origin=(-0.015, -0.025, -0.025))
    sim = simulated(mesh)
    sim.body.displacements = np.tile([0.0, 0.0, 0.3], (len(mesh.points), 1))
    path = tmp_path / "a.usd"
    stage = still(sim, path, surface=tmp_path / "models" / "cube.usda")
    cube = UsdGeom.Mesh.Get(stage, "/SoftBody/surface")
    assert cube.GetPrim().GetDisplayName() == "Cube"
    np.testing.assert_allclose(cube.GetPointsAttr().Get(0), world + np.array([0, 0, 0.3]), atol=1e-7)
    assert UsdGeom.Xformable(cube).GetLocalTransformation() == Gf.Matrix4d(1)
    assert list(cube.GetFaceVertexCountsAttr().Get()) == [4] * 6
    assert not cube.GetDisplayColorPrimvar().HasAuthoredValue()
    # Outward as a renderer sees it: by orientation and order of corners, whose texture coordinates stay theirs.
    quads = np.array(cube.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
    before = Usd.Stage.Open(str(tmp_path / "models" / "cube.usda"))
    one, other = (_corners(each) for each in (cube, UsdGeom.Mesh.Get(before, "/World/Cube")))
    assert one == other
    fans = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    volume = trimesh.Trimesh(np.array(cube.GetPointsAttr().Get(0), float), fans, process=False).volume
    assert (volume > 0) == (cube.GetOrientationAttr().Get() == "rightHanded")
    normals = np.array(cube.GetNormalsAttr().Get(0))
    assert (np.einsum("ij,ij->i", normals, world - world.mean(axis=0)) > 0.9 * 0.02 * 3**0.5).all()

    material, _ = UsdShade.MaterialBindingAPI(cube.GetPrim()).ComputeBoundMaterial()
    assert str(material.GetPath()) == "/SoftBody/materials/World_Looks_Skin"
    shader = material.ComputeSurfaceSource()[0]
    assert shader.GetIdAttr().Get() == "UsdPreviewSurface"
    texture = shader.GetInput("diffuseColor").GetConnectedSources()[0][0].source
    assert texture.GetPath() == material.GetPath().AppendChild("Texture")
    found = UsdShade.Shader(texture.GetPrim()).GetInput("file").Get().resolvedPath
    assert Path(found).read_bytes() == b"picture"
    (subset,) = UsdShade.MaterialBindingAPI(cube.GetPrim()).GetMaterialBindSubsets()
    bound, _ = UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()
    assert str(bound.GetPath()) == "/SoftBody/materials/World_Looks_Red"
    assert faults(path) == []


def test_prims_that_do_not_fit_are_refused(tmp_path):
    textured_cube(tmp_path / "cube.usda", False)
    sim = simulated(wc.TetForest.box((1, 1, 1), 1e-4, 0))
    (tmp_path / "text.usd").write_text("not a stage")
    Usd.Stage.CreateNew(str(tmp_path / "empty.usda")).Save()
    for surface, said in (
        ("cube.usda", r"/World/Cube is 0\.04 m long .* the body, which is 0\.0001 m long"),
        ("none.usd", "no such file"),
        ("cube.obj", "no such file"),
        ("cube.txt", "extension .txt"),
        ("text.usd", "is not a USD file"),
        ("empty.usda", "has no Mesh prim"),
    ):
        with pytest.raises(wc.InputError, match=said):
            still(sim, tmp_path / "a.usd", surface=tmp_path / surface)
    assert not (tmp_path / "a.usd").exists()
    tets = wc.TetMesh(0.04 * np.eye(4, 3, k=-1), [[0, 1, 2, 3]])
    still(simulated(tets), tmp_path / "a.usd", surface=tmp_path / "cube.usda")
    assert (tmp_path / "a.usd").exists()
