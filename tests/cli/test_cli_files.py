"""``warp-corot simulate`` with files of other programs: units, regions, folders, scenes, and files for ParaView."""

import meshio
import numpy as np
import pytest
import trimesh
from command_line import SHORT, simulate
from foreign_meshes import grid, vtk_grid, write_gmsh, write_with_vtk
from input_files import write_scan, write_surface
from pxr import Usd, UsdGeom
from stages import TETS

import warp_corot as wc
from warp_corot.cli.input_file import open_input
from warp_corot.mesh.topology import signed_volumes


def bounds(said: str) -> str:
    return next(line for line in said.splitlines() if "bounds" in line).split("bounds ")[1].split(",")[0]


def two_regions(folder, suffix=".vtu", size=0.1):
    """Cubes of hexahedra with the number 9 in the upper half in x and 7 in the lower."""
    points, (block,) = grid(2, np.random.default_rng(0), ["hexahedron"])
    rows = block.nodes.tolist()
    middles = points[block.nodes].mean(axis=1)[:, 0]
    which = np.where(middles < np.median(middles), 7, 9)
    path = folder / f"cubes{suffix}"
    if suffix == ".msh":
        return write_gmsh(path, size * points, [(5, int(n), row) for n, row in zip(which, rows, strict=True)])
    return write_with_vtk(path, vtk_grid(size * points, [(12, row) for row in rows], {"tissue": which}))


@pytest.mark.parametrize(
    ("suffix", "materials"),
    [(".vtu", "7=5kPa:0.4:1.06g/cm3,9=1MPa"), (".msh", "soft@7=5kPa:0.4:1060,bone@9=1e6"), (".msh", "9=1MPa")],
)
def test_regions_have_materials(folder, suffix, materials, capsys):
    if suffix == ".vtu":
        pytest.importorskip("vtkmodules")
    path = two_regions(folder, suffix)
    more = ["--young", "5kPa", "--poisson", 0.4, "--density", "1.06g/cm3"] if "7=" not in materials else []
    assert simulate(path.name, "--materials", materials, *more, "-o", "a.usda", *SHORT) == 0
    out, err = capsys.readouterr()
    assert "8 hexahedra are split into tetrahedra" in err
    assert "E = 5 kPa, nu = 0.4, rho = 1060 kg/m^3" in out
    assert ("all others: E = 5 kPa" in out) == bool(more)
    stage = Usd.Stage.Open("a.usda")
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    primvars = UsdGeom.PrimvarsAPI(tets)
    young = np.array(primvars.GetPrimvar("young").Get())
    middles = np.array(primvars.GetPrimvar("rest").Get())[np.array(tets.GetTetVertexIndicesAttr().Get())].mean(axis=1)
    assert set(young.tolist()) == {5e3, 1e6}
    assert middles[young == 5e3, 0].mean() < middles[young == 1e6, 0].mean() - 0.02


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["--materials", "8=3kPa"], "--materials names 8, not a region by 'physical group'; there are: 7, 9"),
        (["--materials", "0=3kPa"], "there are: 7, 9; 0 is none of them and has --young"),
        (["--materials", "liver=3kPa"], "--materials names 'liver', not a region"),
        (["--materials", "a@7=3kPa,b@7=4kPa"], "the number 7 is given twice"),
        (
            ["--materials", "7=3kPa", "--regions-by", "organ"],
            "there is no array 'organ' of whole numbers; there are: phys",
        ),
        (["--materials", "7=3kPa,9=1kPa", "--young", "1kPa"], "--young is given, but --materials gives each"),
        (["--regions-by", "entity"], "--regions-by is for --materials"),
        (["--smoothing", "1mm"], "--smoothing is for scans"),
        (["--young", "5kg"], "argument --young: '5kg': 'kg' is not a unit like Pa"),
        (["--duration", "5 parsec"], "argument --duration: '5 parsec': 'parsec' is not a unit like s"),
        (["--also", "a.vtp"], "a.vtp: extension .vtp; it must be .vtu, .pvd"),
        (["--also", "nowhere/a.vtu"], "output folder nowhere does not exist"),
    ],
)
def test_options_without_effect_are_refused(folder, args, said, capsys):
    path = two_regions(folder, ".msh")
    assert simulate(path.name, *args, "-o", "a.usd") == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert said in err
    assert [file.name for file in folder.iterdir()] == [path.name]


def test_units_and_factors_of_every_input(folder, capsys):
    """A length of 100 in the file is 100 mm unless options say otherwise; a guess is reported."""
    write_surface(folder / "organ.obj", True)
    write_gmsh(folder / "tet.msh", 100 * np.eye(4, 3, k=-1), [(4, 1, [0, 1, 2, 3])])
    write_scan(folder / "scan.nii", unit="unknown")
    for name, size in (("organ.obj", "60 mm x 80 mm x 100 mm"), ("scan.nii", "80 mm x 80 mm x 80 mm")):
        for args, factor in (([], 1), (["--scale", 3, "--unit", "2mm"], 6)):
            assert simulate(name, "-o", "a.usd", "--tets", 300, *args, *SHORT) == 0
            out, err = capsys.readouterr()
            notes = [line for line in err.splitlines() if "compiling" not in line]
            assert ("taken as mm" in notes[0]) == (not args)
            given, expected = (
                [float(side.removesuffix(" mm")) for side in text.split(" x ")] for text in (bounds(out), size)
            )
            assert given == pytest.approx([factor * side for side in expected], rel=0.06)
    for args, size in (([], 0.1), (["--unit", "inch"], 2.54), (["--unit", "1cm", "--scale", 0.5], 0.5)):
        assert simulate("tet.msh", "-o", f"{size}.usda", "--fix", "x > 0", *args, *SHORT) == 0
        stage = Usd.Stage.Open(f"{size}.usda")
        points = np.array(UsdGeom.TetMesh.Get(stage, TETS).GetPointsAttr().Get(0))
        assert np.ptp(points[:, 1]) == pytest.approx(size, rel=1e-3)


def test_up(folder):
    write_gmsh(folder / "tet.msh", 0.1 * np.eye(4, 3, k=-1), [(4, 1, [0, 1, 2, 3])])
    for up, axis in (("y", 1), ("Y", 1), (None, 2)):
        args = [] if up is None else ["--up", up]
        assert simulate("tet.msh", "-o", f"{up}.usda", "--fix", "all and x + y + z > 0.05", *args, *SHORT) == 0
        stage = Usd.Stage.Open(f"{up}.usda")
        points = UsdGeom.TetMesh.Get(stage, TETS).GetPointsAttr()
        moved = np.array(points.Get(stage.GetEndTimeCode())) - np.array(points.Get(0))
        assert np.abs(moved).argmax() % 3 == axis
        assert moved.min() < 0.0


def test_a_folder_of_slices(folder, capsys):
    """A ball of 300 in 0, 40 voxels of 2 mm wide, as CT writes it: each slice in a separate file in a subfolder."""
    sitk = pytest.importorskip("SimpleITK")
    axis = 2.0 * (np.arange(40) - 19.5)
    away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    values = np.where(away < 30.0, 300 + (away * 5).astype(int), -away.astype(int) * 9).astype(np.int16)
    image = sitk.GetImageFromArray(values)
    image.SetSpacing((2.0, 2.0, 2.0))
    slices = folder / "patient" / "series"
    slices.mkdir(parents=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for k in range(image.GetDepth()):
        part = image[:, :, k]
        for key, value in (
            ("0008|0060", "CT"),
            ("0020|000e", "1.2.3.4"),
            ("0020|000d", "1.2.3"),
            ("0020|0013", str(k)),
        ):
            part.SetMetaData(key, value)
        part.SetMetaData("0020|0032", f"-39\\-39\\{axis[k]}")
        part.SetMetaData("0008|0018", f"1.2.3.4.{k + 1}")
        writer.SetFileName(str(slices / f"{40 - k:03}.dcm"))
        writer.Execute(part)
    assert simulate("patient", "-o", "a.usd", *SHORT) == 2
    assert "as intensities do, not labels; give --threshold" in capsys.readouterr().err
    assert simulate("patient", "--threshold", "100", "--tets", 1500, "-o", "a.usd", *SHORT) == 0
    out, _ = capsys.readouterr()
    assert "unit mm, as the file says" in out
    assert "40 slices (CT)" in out
    assert [float(side.removesuffix(" mm")) for side in bounds(out).split(" x ")] == pytest.approx([60] * 3, rel=0.1)
    (folder / "nothing").mkdir()
    assert simulate("nothing", "-o", "a.usd") == 2
    assert "is a folder without a DICOM series" in capsys.readouterr().err


def test_frames_for_paraview(folder, capsys):
    """Both have the numbers of the stage; rest plus displacement gives its positions."""
    path = two_regions(folder, ".msh")
    args = ["--also", "a.vtu", "--also", "b.pvd", "--materials", "9=1MPa"]
    assert simulate(path.name, "-o", "a.usda", *args, *SHORT) == 0
    assert "also written  b.pvd" in capsys.readouterr().out
    stage = Usd.Stage.Open("a.usda")
    prim = UsdGeom.TetMesh.Get(stage, TETS)
    shown = np.array(prim.GetPointsAttr().Get(stage.GetEndTimeCode()))
    last = meshio.read("a.vtu")
    assert np.allclose(last.points + last.point_data["displacement"], shown, atol=1e-6)
    tets = last.cells_dict["tetra"]
    assert np.array_equal(tets, np.array(prim.GetTetVertexIndicesAttr().Get()))
    assert set(last.cell_data["region"][0].tolist()) == {1, 2}
    mises = UsdGeom.PrimvarsAPI(prim).GetPrimvar("vonMises").Get(stage.GetEndTimeCode())
    assert np.allclose(last.cell_data["von_mises"][0], mises, rtol=1e-5)
    stress = last.cell_data["stress"][0].reshape(-1, 3, 3).astype(float)
    deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    own = np.sqrt(1.5 * (deviator**2).sum(axis=(1, 2)))
    assert np.allclose(own, mises, rtol=1e-4, atol=1e-5 * max(mises))
    listed = [line for line in (folder / "b.pvd").read_text(encoding="utf-8").splitlines() if "DataSet" in line]
    assert [line.split('timestep="')[1].split('"')[0] for line in listed] == ["0", "0.025", "0.05"]
    final = meshio.read(folder / listed[-1].split('file="')[1].split('"')[0])
    assert np.array_equal(final.point_data["velocity"], last.point_data["velocity"])
    assert simulate("box", "--level", 1, "--also", "box.vtu", "-o", "b.usda", *SHORT) == 0
    box = meshio.read("box.vtu")
    assert (signed_volumes(box.points, box.cells_dict["tetra"]) > 0.0).all()


@pytest.mark.parametrize("suffix", [".glb", pytest.param(".obj", marks=pytest.mark.slow)])
def test_objects_of_a_file_are_bodies_or_one(folder, suffix, capsys):
    """Two balls with a gap of 2 mm, which one mesh would close; the larger one gets more elements. A surface
    in two open halves is one body."""
    scene = trimesh.Scene()
    for name, radius, x in (("small", 0.05, 0.0), ("large", 0.1, 0.152)):
        ball = trimesh.creation.icosphere(2, radius)
        ball.apply_translation((x, 0, 0))
        scene.add_geometry(ball, node_name=name, geom_name=name)
    scene.export(f"two{suffix}")
    args = ["--unit", "m", "--tets", 1800, "-o", "a.usd", *SHORT]
    assert simulate(f"two{suffix}", *args) == 0
    out, err = capsys.readouterr()
    assert "2 separate bodies: " in err
    counts = [int(line.split(" tetrahedra")[0].split()[-1]) for line in out.splitlines() if "  mesh" in line]
    assert max(counts) > 4 * min(counts)
    assert sum(counts) <= 1800
    assert simulate(f"two{suffix}", "--join", *args) == 0
    out, err = capsys.readouterr()
    assert "separate bodies" not in err
    assert "2 separate parts" in out
    ball = trimesh.creation.icosphere(2, 0.05)
    scene = trimesh.Scene()
    for name, half in (("upper", ball.triangles_center[:, 2] > 0), ("lower", ball.triangles_center[:, 2] <= 0)):
        scene.add_geometry(ball.submesh([np.flatnonzero(half)], append=True), node_name=name, geom_name=name)
    scene.export(f"halves{suffix}")
    assert simulate(f"halves{suffix}", *args) == 0
    out, err = capsys.readouterr()
    assert "separate bodies" not in err
    assert "  closed" in out


def test_joined_nodes(folder, capsys):
    """Two tetrahedra whose common face has the same positions and different numbers."""
    points = [*(0.1 * np.eye(4, 3, k=-1)), *(0.1 * np.eye(4, 3, k=-1)[1:]), (0.1, 0.1, 0.1)]
    write_gmsh(folder / "two.msh", points, [(4, 1, [0, 1, 2, 3]), (4, 1, [4, 5, 6, 7])])
    assert simulate("two.msh", "--join", "--fix", "x + y + z < 0.05", "-o", "a.usd", *SHORT) == 0
    out, err = capsys.readouterr()
    assert "3 nodes coincide with others and are merged" in err
    assert "5 nodes, 2 tetrahedra" in out
    assert simulate("two.msh", "--fix", "x + y + z < 0.05", "-o", "a.usd", *SHORT) == 0
    assert "no two tetrahedra share a node (--join" in capsys.readouterr().err
    write_gmsh(folder / "one.msh", points[:4], [(4, 1, [0, 1, 2, 3])])
    assert simulate("one.msh", "--join", "-o", "b.usd", *SHORT) == 2
    assert "no two nodes coincide" in capsys.readouterr().err


def test_scenes_are_placed_by_their_transforms(folder):
    """A glTF scene has one mesh at two nodes, one of them rotated and twice as large."""
    ball = trimesh.creation.icosphere(1, 0.05)
    turned = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1)) @ np.diag([2, 2, 2, 1])
    turned[:3, 3] = (0.5, 0, 0)
    scene = trimesh.Scene()
    scene.add_geometry(ball, node_name="small")
    scene.add_geometry(ball, node_name="large", transform=turned)
    scene.export("scene.glb")
    surface = open_input("scene.glb").loaded
    assert surface.points.min(axis=0) == pytest.approx([-0.05, -0.1, -0.1], abs=1e-3)
    assert surface.points.max(axis=0) == pytest.approx([0.6, 0.1, 0.1], abs=1e-3)
    assert wc.Domain.from_surface("scene.glb").closed.pieces == 2
