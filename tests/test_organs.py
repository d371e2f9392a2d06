"""Bodies from surfaces and scans, recorded and on the command line: what is drawn is the body's surface."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from pxr import Gf, Sdf, Usd, UsdGeom, UsdShade, UsdValidation

import warp_corot as wc
from warp_corot.cli import main
from warp_corot.cli.label_materials import parse_labels, parse_pressure
from warp_corot.domain import Domain

SURFACE, TETS = "/SoftBody/surface", "/SoftBody/tetrahedra"
CORE = 0.023
SHORT = ["--duration", "0.05", "--fps", "40", "--device", "cpu"]


@pytest.fixture(autouse=True)
def warp_settings_kept():
    before = wp.config.log_level
    yield
    wp.config.log_level = before


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


def ball(device="cpu", radius=0.05, **options) -> wc.TetForest:
    return wc.TetForest.from_domain(Domain.sphere(radius, device=device), 0.05, max_level=4, **options)


def core(device="cpu") -> wc.TetForest:
    """A ball with another label in its middle."""
    inner, outer = Domain.sphere(CORE, device=device), Domain.sphere(0.05, device=device)
    return wc.TetForest.from_domain(inner.named("core") | outer.named("soft tissue"), 0.05, max_level=6)


def simulated(mesh, device="cpu", young=1e4) -> wc.Simulation:
    return wc.Simulation(wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1e3), device=device), gravity=(0, 0, 0))


def still(sim, path, **options) -> Usd.Stage:
    """The stage of one frame of the present state, and one of the next step."""
    wc.record(sim, path, duration=sim.dt, fps=1.0 / sim.dt, **options)
    return Usd.Stage.Open(str(path))


def drawn(stage: Usd.Stage, path: str = SURFACE, frame: float = 0.0) -> trimesh.Trimesh:
    prim = UsdGeom.Mesh.Get(stage, path)
    faces = np.array(prim.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
    return trimesh.Trimesh(np.array(prim.GetPointsAttr().Get(frame), float), faces, process=False)


def prims(stage: Usd.Stage) -> list[str]:
    return [str(prim.GetPath()) for prim in stage.Traverse()][1:]


def faults(path: Path) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(Usd.Stage.Open(str(path)))
    return [error.GetErrorAsString() for error in found]


def rotation() -> np.ndarray:
    q = Gf.Rotation(Gf.Vec3d(1, 2, 3), 50)
    return np.array(Gf.Matrix3d(q)).T


# --- recording -------------------------------------------------------------------------------------------------------


def test_the_smooth_surface_follows_the_body(device, tmp_path):
    """An affine motion moves every point by itself, a rotation turns the normals, a uniform strain is one stress."""
    mesh = ball(device)
    sim = simulated(mesh, device)
    rest = mesh.surface()
    turned, stretch = rotation(), np.diag([1.05, 1.0, 1.0])
    for name, motion, stress in (("turned.usd", turned, 0.0), ("stretched.usd", stretch, 0.05 * 1e4 / 1.4)):
        sim.body.displacements = mesh.points @ (motion.T - np.eye(3))
        stage = still(sim, tmp_path / name)
        assert prims(stage) == [SURFACE]
        surface = drawn(stage)
        np.testing.assert_allclose(surface.vertices, rest.points @ motion.T, atol=2e-8)
        extent = UsdGeom.Mesh.Get(stage, SURFACE).GetExtentAttr().Get(0)
        np.testing.assert_allclose(extent, surface.bounds, atol=1e-8)
        assert surface.is_watertight
        assert surface.is_winding_consistent
        assert surface.volume == pytest.approx(np.linalg.det(motion) * mesh_volume(mesh), rel=1e-4)
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(SURFACE))
        # sigma = lambda tr + 2 mu eps: the deviator of a uniaxial strain is 2 mu eps = E eps / (1 + nu).
        shown = np.array(primvars.GetPrimvar("vonMises").Get(0))
        np.testing.assert_allclose(shown, stress, rtol=1e-3, atol=0.5)
        assert len(primvars.GetPrimvar("displayColor").ComputeFlattened(0)) == len(shown)
        if motion is turned:
            normals = np.array(UsdGeom.Mesh.Get(stage, SURFACE).GetNormalsAttr().Get(0))
            np.testing.assert_allclose(normals, rest.normals @ turned.T, atol=1e-4)
            outward = surface.vertices / np.linalg.norm(surface.vertices, axis=1, keepdims=True)
            assert (np.einsum("ij,ij->i", normals, outward) > 0.95).all()
        assert faults(tmp_path / name) == []


def mesh_volume(mesh: wc.TetForest) -> float:
    return float((mesh.fill * mesh.volumes).sum())


def test_one_color_range_holds_for_all_frames(tmp_path):
    """Stress grows in the run, so that early frames must be coloured again at the end."""
    mesh = ball()
    sim = wc.Simulation(wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1e3)))
    sim.body.fix(mesh.points[:, 1] < -0.03)
    wc.record(sim, tmp_path / "a.usd", duration=0.1, fps=50, tets=True)
    stage = Usd.Stage.Open(str(tmp_path / "a.usd"))
    highest = stage.GetDefaultPrim().GetCustomDataByKey("stressColors")["highest"]
    for path in (SURFACE, TETS):
        primvars = UsdGeom.PrimvarsAPI(stage.GetPrimAtPath(path))
        indices = [np.array(primvars.GetPrimvar("displayColor").GetIndices(frame)) for frame in range(6)]
        assert indices[0].max() == 0 < indices[-1].max()
        if path == SURFACE:
            for frame in range(6):
                stress = np.array(primvars.GetPrimvar("vonMises").Get(frame), float)
                assert np.abs(indices[frame] - np.clip(255 * stress / highest, 0, 255)).max() < 0.51


def test_tetrahedra_on_request(tmp_path):
    mesh = ball()
    sim = simulated(mesh)
    stage = still(sim, tmp_path / "a.usd", tets=True)
    assert prims(stage) == [TETS, SURFACE]
    assert len(UsdGeom.TetMesh.Get(stage, TETS).GetTetVertexIndicesAttr().Get()) == len(mesh.tets)
    assert drawn(stage).volume == pytest.approx(mesh_volume(mesh), rel=1e-6)
    box = wc.TetForest.box((1, 1, 2), 0.05, 3)
    assert prims(still(simulated(box), tmp_path / "b.usd")) == [TETS, SURFACE]
    boundary = still(simulated(box), tmp_path / "c.usd", tets=False)
    assert prims(boundary) == [SURFACE]
    assert drawn(boundary).is_watertight
    assert drawn(boundary).volume == pytest.approx(0.05**2 * 0.1, rel=1e-6)


def test_several_bodies_are_one_surface(tmp_path):
    sphere, box = ball(), wc.TetForest.box((1, 1, 1), 0.05, 3, origin=(0.2, 0.0, 0.0))
    bodies = [wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1e3), device="cpu") for mesh in (sphere, box)]
    sim = wc.Simulation(bodies, gravity=(0, 0, 0))
    bodies[1].displacements = np.tile([0.0, 0.1, 0.0], (len(box.points), 1))
    parts = drawn(still(sim, tmp_path / "a.usd")).split()
    assert sorted(part.volume for part in parts) == pytest.approx(sorted([mesh_volume(sphere), 0.05**3]), rel=1e-5)
    cube = min(parts, key=lambda part: part.volume)
    np.testing.assert_allclose(cube.bounds, [[0.2, 0.1, 0.0], [0.25, 0.15, 0.05]], atol=1e-7)
    given = [None, sphere_of(0.01, [0.22, 0.02, 0.02], box)]
    parts = drawn(still(sim, tmp_path / "b.usd", surface=given)).split()
    np.testing.assert_allclose(min(parts, key=lambda part: part.volume).centroid, [0.22, 0.12, 0.02], atol=1e-6)


def sphere_of(radius, centre, mesh):
    shape = trimesh.creation.icosphere(2, radius)
    return mesh.bind(shape.vertices + np.asarray(centre), shape.faces)


def test_labels_are_closed_surfaces_that_fill_the_body(tmp_path):
    mesh = core()
    stage = still(simulated(mesh), tmp_path / "a.usd", labels=True)
    assert prims(stage) == ["/SoftBody/core", "/SoftBody/soft_tissue"]
    assert stage.GetPrimAtPath("/SoftBody/soft_tissue").GetDisplayName() == "soft tissue"
    inner, shell = (drawn(stage, path) for path in prims(stage))
    assert inner.is_watertight
    assert shell.is_watertight
    assert inner.volume == pytest.approx(4 / 3 * np.pi * CORE**3, rel=0.1)
    whole = drawn(still(simulated(mesh), tmp_path / "b.usd"))
    assert inner.volume + shell.volume == pytest.approx(whole.volume, rel=1e-5)
    with pytest.raises(wc.InputError, match="labels is True, but there are none"):
        still(simulated(ball()), tmp_path / "c.usd", labels=True)


def test_a_users_surface_goes_along(device, tmp_path):
    """Finer than the mesh's own, partly outside of its tetrahedra; an affine motion is exact on it."""
    mesh = ball(device)
    sim = simulated(mesh, device)
    motion = rotation() @ np.diag([1.1, 0.9, 1.0])
    sim.body.displacements = mesh.points @ (motion.T - np.eye(3))
    shape = trimesh.creation.icosphere(4, 0.0505)
    stage = still(sim, tmp_path / "a.usd", surface=mesh.bind(shape.vertices, shape.faces))
    np.testing.assert_allclose(drawn(stage).vertices, shape.vertices @ motion.T, atol=3e-8)
    small = simulated(wc.TetForest.box((1, 1, 1), 0.05, 0))
    with pytest.raises(wc.InputError, match="bound to nodes 0 to"):
        still(small, tmp_path / "b.usd", surface=ball().surface())
    with pytest.raises(wc.InputError, match="names 2 surfaces"):
        still(sim, tmp_path / "b.usd", surface=[None, None])
    with pytest.raises(wc.InputError, match="surface is a int"):
        still(sim, tmp_path / "b.usd", surface=3)
    assert not (tmp_path / "b.usd").exists()


def textured_cube(path: Path, mirrored: bool) -> np.ndarray:
    """A cube of quads in centimetres, moved and perhaps mirrored by its parent, with UVs, a texture, a subset."""
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


@pytest.mark.parametrize("mirrored", [False, True])
def test_a_prim_keeps_its_faces_texture_and_materials(tmp_path, mirrored):
    (tmp_path / "models").mkdir()
    world = textured_cube(tmp_path / "models" / "cube.usda", mirrored)
    mesh = wc.TetForest.box((1, 1, 1), 0.05, 3, origin=(-0.015, -0.025, -0.025))
    sim = simulated(mesh)
    sim.body.displacements = np.tile([0.0, 0.0, 0.3], (len(mesh.points), 1))
    path = tmp_path / "a.usd"
    stage = still(sim, path, surface=tmp_path / "models" / "cube.usda")
    cube = UsdGeom.Mesh.Get(stage, "/SoftBody/Cube")
    np.testing.assert_allclose(cube.GetPointsAttr().Get(0), world + np.array([0, 0, 0.3]), atol=1e-7)
    assert UsdGeom.Xformable(cube).GetLocalTransformation() == Gf.Matrix4d(1)
    assert list(cube.GetFaceVertexCountsAttr().Get()) == [4] * 6
    assert UsdGeom.PrimvarsAPI(cube).GetPrimvar("st").Get()[23] == Gf.Vec2f(23 / 24, 1 / 24)
    assert not cube.GetDisplayColorPrimvar().HasAuthoredValue()
    # Outward as a renderer sees it: by orientation and order of corners.
    quads = np.array(cube.GetFaceVertexIndicesAttr().Get()).reshape(-1, 4)
    fans = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    volume = trimesh.Trimesh(np.array(cube.GetPointsAttr().Get(0), float), fans, process=False).volume
    assert (volume > 0) == (cube.GetOrientationAttr().Get() == "rightHanded") == (not mirrored)
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
        ("cube.obj", "extension .obj"),
        ("text.usd", "is not a USD file"),
        ("empty.usda", "has no Mesh prim"),
    ):
        with pytest.raises(wc.InputError, match=said):
            still(sim, tmp_path / "a.usd", surface=tmp_path / surface)
    tets = wc.TetMesh(np.eye(4, 3, k=-1), [[0, 1, 2, 3]])
    with pytest.raises(wc.InputError, match="only a TetForest can have a surface bound to it, not a TetMesh"):
        still(simulated(tets), tmp_path / "a.usd", surface=tmp_path / "cube.usda")
    assert not (tmp_path / "a.usd").exists()


# --- the command line ------------------------------------------------------------------------------------------------


def simulate(*args: object) -> int:
    return main(["simulate", *map(str, args)])


def tetrahedra_in(said: str) -> int:
    return int(said.split(" tetrahedra,")[0].split()[-1])


def write_surface(path: Path, mm: bool) -> Path:
    """An ellipsoid of half axes 3, 4 and 5 cm."""
    shape = trimesh.creation.icosphere(3, 1.0)
    shape.vertices *= np.array([0.03, 0.04, 0.05]) * (1000.0 if mm else 1.0)
    if path.suffix != ".usda":
        shape.export(path)
        return path
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 0.001 if mm else 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    mesh = UsdGeom.Mesh.Define(stage, "/Mesh")
    mesh.CreatePointsAttr([tuple(p) for p in shape.vertices.tolist()])
    mesh.CreateFaceVertexCountsAttr([3] * len(shape.faces))
    mesh.CreateFaceVertexIndicesAttr(shape.faces.ravel().tolist())
    stage.Save()
    return path


def write_scan(path: Path, unit: str = "mm") -> Path:
    """A ball of 4 cm of the number 2 around one of 2 cm of the number 7, in voxels of 4 mm."""
    import nibabel

    axis = (np.arange(24) - 11.5) * 4.0
    away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    volume = np.where(away < 20.0, 7, np.where(away < 40.0, 2, 0)).astype(np.uint8)
    affine = np.diag([4.0, 4.0, 4.0, 1.0])
    affine[:3, 3] = axis[0]
    image = nibabel.Nifti1Image(volume, affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb", ".usda"])
def test_surfaces_of_every_format(folder, suffix, capsys):
    mm = suffix in (".obj", ".stl", ".usda")
    write_surface(folder / f"organ{suffix}", mm)
    unit = ["--unit", "mm"] if mm and suffix != ".usda" else []
    assert simulate(f"organ{suffix}", "-o", "a.usd", "--tets", 1500, *unit, *SHORT) == 0
    out, err = capsys.readouterr()
    assert "bounds 60 mm x 80 mm x 100 mm" in out
    assert "closed" in out
    assert "ready in" in out
    assert 0.8 * 1500 < tetrahedra_in(out) <= 1500
    assert "the lowest 10 % of the height is held" in err
    stage = Usd.Stage.Open(str(folder / "a.usd"))
    assert prims(stage) == [SURFACE]
    first, last = drawn(stage), drawn(stage, frame=stage.GetEndTimeCode())
    assert first.is_watertight
    assert first.volume == pytest.approx(4 / 3 * np.pi * 0.03 * 0.04 * 0.05, rel=0.05)
    up = {"X": 0, "Y": 1, "Z": 2}[str(UsdGeom.GetStageUpAxis(stage))]
    assert up == (1 if suffix in (".obj", ".glb") else 2)
    heights, sunk = first.vertices[:, up], (last.vertices - first.vertices)[:, up]
    assert sunk[heights > 0].max() < 0
    lowest = heights.min() + 0.05 * np.ptp(heights)
    np.testing.assert_allclose(sunk[heights < lowest], 0.0, atol=0.1 * np.abs(sunk).max())


def test_the_bunny_sags_and_stands(folder, capsys):
    """Near critical damping it comes to rest, upright: ears and back below where they were, above the ground."""
    args = ["--tets", 1500, "--young", 3e4, "--damping", 25, "--duration", 0.6, "--fps", 5, "--device", "cpu"]
    assert simulate("warp:bunny", "-o", "a.usd", *args) == 0
    assert "12200 triangles enclose 876 ml" in capsys.readouterr().out
    stage = Usd.Stage.Open(str(folder / "a.usd"))
    first, last = drawn(stage), drawn(stage, frame=stage.GetEndTimeCode())
    assert 0.02 < -(last.vertices - first.vertices)[:, 1].min() / np.ptp(first.vertices[:, 1]) < 0.4
    assert last.vertices[:, 1].min() > 0.0
    assert last.volume == pytest.approx(first.volume, rel=0.05)


def test_the_level_of_detail_is_kept(folder, capsys):
    """More tetrahedra, and a surface that is nearer: its volume comes to that of the ellipsoid from below."""
    write_surface(folder / "organ.glb", False)
    errors = []
    for count in (500, 2000, 8000):
        assert simulate("organ.glb", "-o", f"{count}.usd", "--tets", count, *SHORT) == 0
        assert 0.8 * count < tetrahedra_in(capsys.readouterr().out) <= count
        exact = trimesh.load_mesh(folder / "organ.glb").volume
        errors.append(1 - drawn(Usd.Stage.Open(str(folder / f"{count}.usd"))).volume / exact)
    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2] > 0.0


def test_options_of_the_mesh_reach_it(folder, capsys):
    write_surface(folder / "organ.glb", False)
    assert simulate("organ.glb", "-o", "a.usd", "--cell-size", 0.05, "--max-level", 4, *SHORT) == 0
    said = capsys.readouterr().out
    assert "from 2 x 2 x 2 cubes of 0.05 m" in said
    assert "level 4, type 1" in said
    assert "level 5" not in said
    assert simulate("organ.glb", "-o", "a.usd", "--cell-size", 0.05, "--surface-error", 1e-3, *SHORT) == 0
    count = tetrahedra_in(capsys.readouterr().out)
    domain = Domain.from_surface("organ.glb")
    assert count == len(wc.TetForest.from_domain(domain, 0.05, surface_error=1e-3).tets)
    assert np.abs(domain.phi(drawn(Usd.Stage.Open("a.usd")).vertices)).max() < 1e-3
    assert simulate("organ.glb", "-o", "a.usd", "--surface-error", 1e-5, "--tets", 2000, *SHORT) == 0
    assert 1000 < tetrahedra_in(capsys.readouterr().out) <= 2000


@pytest.mark.parametrize(
    ("labels", "noted"),
    [
        ("soft=3kPa:0.45,hard=30kPa:0.4:1060", True),
        ("hard@7=0.03MPa:0.4:1060,soft@2=3000", False),
        ("2=3 kPa,7=30kPa:0.4:1.06e3", False),
    ],
)
def test_material_follows_the_labels(folder, labels, noted, capsys):
    write_scan(folder / "scan.nii.gz")
    assert simulate("scan.nii.gz", "--labels", labels, "-o", "a.usd", "--tets", 4000, "--draw-tets", *SHORT) == 0
    out, err = capsys.readouterr()
    assert ("in ascending order: soft is 2, hard is 7" in err) == noted
    assert "E = 3 kPa, nu = 0.45, rho = 1000 kg/m^3" in out
    assert "E = 30 kPa, nu = 0.4, rho = 1060 kg/m^3" in out
    assert "unit mm, as the file says" in out
    stage = Usd.Stage.Open(str(folder / "a.usd"))
    assert prims(stage) == [TETS, SURFACE]
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    primvars = UsdGeom.PrimvarsAPI(tets)
    rest = np.array(primvars.GetPrimvar("rest").Get(), float)
    away = np.linalg.norm(rest[np.array(tets.GetTetVertexIndicesAttr().Get())].mean(axis=1), axis=1)
    for name, inside, outside in (("young", 3e4, 3e3), ("poisson", 0.4, 0.45), ("density", 1060, 1000)):
        values = np.array(primvars.GetPrimvar(name).Get())
        np.testing.assert_allclose(values[away < 0.013], inside)
        np.testing.assert_allclose(values[away > 0.029], outside)


def test_labels_are_drawn_and_left_out(folder, capsys):
    write_scan(folder / "scan.nii.gz")
    args = ["--tets", 3000, "--smoothing", 0.004, *SHORT]
    assert simulate("scan.nii.gz", "--labels", "soft=3kPa,hard=30kPa", "-o", "a.usd", "--draw-labels", *args) == 0
    assert prims(Usd.Stage.Open("a.usd")) == ["/SoftBody/soft", "/SoftBody/hard"]
    assert simulate("scan.nii.gz", "--labels", "core@7=30kPa", "-o", "b.usd", *args) == 0
    core_alone = drawn(Usd.Stage.Open("b.usd"))
    assert core_alone.volume == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.15)
    capsys.readouterr()
    assert simulate("scan.nii.gz", "-o", "c.usd", *args) == 0  # all labels, of one material
    assert "labels: 2, 7" in capsys.readouterr().out
    assert drawn(Usd.Stage.Open("c.usd")).volume == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.1)


def test_the_preview_shows_the_surface(folder):
    pytest.importorskip("matplotlib")
    write_surface(folder / "organ.glb", False)
    assert simulate("organ.glb", "-o", "a.usd", "--preview", "a.png", "--tets", 500, *SHORT) == 0
    assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")


def test_unlikely_units_are_warned_of(folder, capsys):
    trimesh.creation.icosphere(2, 75.0).export(folder / "organ.obj")
    assert simulate("organ.obj", "-o", "a.usd", "--tets", 300, "--duration", 0.05, "--fps", 20) == 0
    err = capsys.readouterr().err
    assert "warning: organ.obj: the body is 150 m long: if its coordinates are in mm, say --unit 'mm' (a factor" in err
    assert simulate("organ.obj", "-o", "a.usd", "--tets", 300, "--unit", "mm", *SHORT) == 0
    out, err = capsys.readouterr()
    assert "warning" not in err
    assert "bounds 150 mm x 150 mm x 150 mm" in out


def refused_files(folder: Path) -> None:
    write_surface(folder / "organ.obj", False)
    write_scan(folder / "scan.nii.gz")
    write_scan(folder / "nameless.nii", unit="unknown")
    half = trimesh.creation.icosphere(2, 0.05)
    half.update_faces(half.triangles_center[:, 2] > 0)
    half.export(folder / "half.ply")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]], process=False).export(
        folder / "flat.off"
    )
    (folder / "text.stl").write_text("not a surface")
    (folder / "text.nii.gz").write_text("not a scan")
    (folder / "empty.glb").write_bytes(b"")
    write_surface(folder / "out.usda", False)


REFUSED = [
    (["none.obj"], "none.obj: no such file"),
    (["none.nii.gz"], "none.nii.gz: no such file"),
    (["text.stl"], "text.stl: "),
    (["text.nii.gz"], "text.nii.gz: is not a NIfTI file"),
    (["empty.glb"], "empty.glb: is empty"),
    (["half.ply"], "half.ply: the surface is open"),
    (["flat.off"], "flat.off: "),
    (["nameless.nii"], "the file names no unit of length; say --unit 'mm'"),
    (["warp:hare"], "warp:hare: no such asset, should be warp:bunny, warp:bear"),
    (["organ.obj", "--unit", "inch"], "invalid choice: 'inch'"),
    (["organ.obj", "--scale", "0.1"], "--scale is for meshes of tetrahedra; of organ.obj say --unit"),
    (["organ.obj", "--labels", "liver=3kPa"], "--labels is for scans, and organ.obj is not one"),
    (["organ.obj", "--draw-labels"], "--draw-labels is for scans"),
    (["box", "--unit", "mm"], "--unit is for surfaces and scans, and box is not one; say --scale"),
    (["warp:bear", "--tets", "1000"], "--tets is for surfaces and scans"),
    (["box", "--draw-tets"], "--draw-tets is for surfaces and scans"),
    (["organ.obj", "--tets", "0"], "--tets is 0; it must be a positive whole number"),
    (["organ.obj", "--tets", "1"], "with --tets 1, "),
    (["organ.obj", "--tets", "many"], "--tets"),
    (["organ.obj", "--cell-size", "0"], "--cell-size is 0.0; it must be a positive length"),
    (["organ.obj", "--cell-size", "nan"], "--cell-size is nan"),
    (["organ.obj", "--max-level", "-1"], "--max-level is -1"),
    (["organ.obj", "--max-level", "99"], "--max-level is 99"),
    (["organ.obj", "--surface-error", "-1"], "--surface-error is -1"),
    (["organ.obj", "--fix", "all", "--tets", "500"], "holds all"),
    (["organ.obj", "--rotation-level", "-1"], "rotation_level is -1"),
    (["scan.nii.gz", "--labels", "liver"], "--labels 'liver': it must be NAME"),
    (["scan.nii.gz", "--labels", ""], "--labels '': it must be NAME"),
    (["scan.nii.gz", "--labels", "a=3kPa:0.45:1000:2,b=3kPa"], "it must be NAME"),
    (["scan.nii.gz", "--labels", "a=soft,b=3kPa"], "'soft' is no Young's modulus"),
    (["scan.nii.gz", "--labels", "a=3psi,b=3kPa"], "'3psi' is no Young's modulus"),
    (["scan.nii.gz", "--labels", "a=3kPa:half,b=3kPa"], "'half' is no Poisson's ratio"),
    (["scan.nii.gz", "--labels", "a=3kPa:nan,b=3kPa"], "'nan' is no Poisson's ratio"),
    (["scan.nii.gz", "--labels", "a=3kPa:0.5,b=3kPa"], "--labels 'a=3kPa:0.5': poisson is 0.5"),
    (["scan.nii.gz", "--labels", "a=-3kPa,b=3kPa"], "young is -3000 Pa"),
    (["scan.nii.gz", "--labels", "a=3kPa:0.4:0,b=3kPa"], "density is 0"),
    (["scan.nii.gz", "--labels", "a=3kPa,a=4kPa"], "the label a is given twice"),
    (["scan.nii.gz", "--labels", "a@2=3kPa,b@2+7=4kPa"], "the number 2 is given twice"),
    (["scan.nii.gz", "--labels", "a=3kPa"], "which label 'a' is, is not known; say its number, as in a@1=3kPa; "),
    (["scan.nii.gz", "--labels", "a=3kPa,b=3kPa,c=3kPa"], "the volume's labels: 2, 7"),
    (["scan.nii.gz", "--labels", "a@2=3kPa,b=3kPa"], "which label 'b' is"),
    (["scan.nii.gz", "--labels", "2=3kPa,3=3kPa"], "3"),
    (["scan.nii.gz", "--labels", "2=3kPa", "--young", "500"], "--young is given, but --labels gives each"),
    (["scan.nii.gz", "--draw-labels"], "--draw-labels draws the labels that --labels names"),
    (["scan.nii.gz", "--smoothing", "-1"], "--smoothing is -1"),
    (["scan.nii.gz", "--smoothing", "1"], "--smoothing is 1 m and the body"),
    (["out.usda"], "is the input"),
]


@pytest.mark.parametrize(("args", "said"), REFUSED, ids=[" ".join(args)[:60] for args, _ in REFUSED])
def test_bad_input_is_one_line_and_touches_nothing(folder, args, said, capsys):
    refused_files(folder)
    before = {file.name: file.read_bytes() for file in folder.iterdir()}
    try:
        status = simulate(*args, "-o", "out.usda")
    except SystemExit as left:  # argparse's way
        status = left.code
    out, err = capsys.readouterr()
    assert status == 2
    assert out == ""
    errors = [line for line in err.splitlines() if line.startswith("warp-corot: error: ")]
    assert len(errors) == 1
    assert said in errors[0]
    assert {file.name: file.read_bytes() for file in folder.iterdir()} == before


def test_pressures():
    for text, pascals in (("500", 500), ("3kPa", 3e3), (" 3.5 kPa", 3.5e3), ("1e-3GPa", 1e6), (".1MPa", 1e5)):
        assert parse_pressure(text) == pytest.approx(pascals)
    (entry,) = parse_labels("grey matter@3+4 = 2kPa:0.49")
    assert (entry.name, entry.numbers, entry.young, entry.poisson, entry.density) == (
        "grey matter",
        (3, 4),
        2e3,
        0.49,
        None,
    )
