"""A small valid file of each format that the package reads, one line for each, to be damaged."""

from __future__ import annotations

import gzip
import locale
from collections.abc import Callable
from pathlib import Path

import numpy as np

POINTS = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]) * 0.1
TETS = np.array([[0, 1, 2, 3], [1, 4, 2, 3]])

ABAQUS_PART = """*NODE
11, 0.0, 0.0, 0.0
12, 0.1, 0.0, 0.0
13, 0.0, 0.1, 0.0
14, 0.0, 0.0, 0.1
15, 0.1, 0.1, 0.1
"""
ABAQUS = """*HEADING
a part, an instance, sets and a section
*PART, NAME=body
*INCLUDE, INPUT=nodes.inp
*ELEMENT, TYPE=C3D4, ELSET=all
1, 11, 12, 13, 14
2, 12, 15, 13, 14
*ELSET, ELSET=soft, GENERATE
1, 1, 1
*ELSET, ELSET=hard
2
*SOLID SECTION, ELSET=soft, MATERIAL=liver
*SOLID SECTION, ELSET=hard, MATERIAL=bone
*END PART
*ASSEMBLY, NAME=whole
*INSTANCE, NAME=one, PART=body
0.1, 0.0, 0.0
0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 90.0
*END INSTANCE
*END ASSEMBLY
"""
RUN = """# a run that is written down
output = "out.usd"
duration = "500ms"
gravity = [0, 0, -9.81]
csv = "out.csv"
[[body]]
input = "ball.ply"
tets = 300
young = "5kPa"
poisson = 0.45
unit = "m"
fix = ["bottom", "z < zmin + 0.01"]
patch = ["upper=z > zmax - 0.004"]
pull = [{ patch = "upper", by = [0, 0, 0.02], times = [0, 0.2, 0.5], shares = [0, 1, 0.5] }]
twist = [{ patch = "x > xmax - 0.004 and z < 0.02", degrees = 30, axis = [0, 0, 1], times = [0, 0.5], shares = [0, 1] }]
press = [["top", 100.0]]
probe = ["0 0 0", "top"]
[[body]]
input = "box"
model = "linear"
region = [["z > 0", "30kPa:0.45:1200"]]
"""


def _ball(suffix: str, level: int = 1, **options) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import trimesh

        trimesh.creation.icosphere(level, 0.05).export(folder / f"seed{suffix}", **options)
        return folder / f"seed{suffix}"

    return make


def _objects(folder: Path) -> Path:
    """Two balls, one of them rotated and moved, in a file with texture coordinates and a material beside it."""
    ball = _ball(".obj", 0)(folder)
    lines = [line for line in ball.read_text().splitlines() if line.startswith(("v ", "f "))]
    places = [line for line in lines if line.startswith("v ")]
    faces = [line.split()[1:] for line in lines if line.startswith("f ")]
    corners = [[word.split("/")[0] for word in face] for face in faces]
    moved = [f"v {float(x) + 0.3} {y} {z}" for _, x, y, z in (place.split()[:4] for place in places)]
    textured = [f"f {' '.join(f'{corner}/1' for corner in face)}" for face in corners]
    second = [f"f {' '.join(str(int(corner) + len(places)) for corner in face)}" for face in corners]
    both = ["mtllib seed.mtl", "o one", *places, "vt 0.5 0.5", "usemtl red", *textured, "o two", *moved, *second]
    ball.write_text("\n".join(both))
    (folder / "seed.mtl").write_text("newmtl red\nKd 1 0 0\n")
    return ball


def _gltf(folder: Path) -> Path:
    """A scene with two nodes and its numbers in a file beside it."""
    import trimesh

    ball = trimesh.creation.icosphere(1, 0.05)
    scene = trimesh.Scene({"one": ball})
    scene.add_geometry(ball, node_name="two", transform=trimesh.transformations.translation_matrix([0.3, 0, 0]))
    for name, content in trimesh.exchange.gltf.export_gltf(scene).items():
        (folder / name).write_bytes(content)
    return (folder / "model.gltf").rename(folder / "seed.gltf")


def _meshio(suffix: str, kind: str = "tetra", **options) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import meshio

        cells = TETS if kind == "tetra" else np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
        regions = {} if suffix in (".su2", ".ugrid", ".xml") else {"region": [np.arange(len(cells)) + 1]}
        if suffix == ".msh":
            regions = {"gmsh:physical": [np.array([1, 2])], "gmsh:geometrical": [np.array([1, 2])]}
        meshio.write(folder / f"seed{suffix}", meshio.Mesh(POINTS, [(kind, cells)], cell_data=regions), **options)
        return folder / f"seed{suffix}"

    return make


def _nastran(folder: Path) -> Path:
    grids = [",".join(["GRID", str(k + 1), "", *map(str, point)]) for k, point in enumerate(POINTS.tolist())]
    cells = [",".join(map(str, ["CTETRA", k + 1, k + 1, *(tet + 1)])) for k, tet in enumerate(TETS)]
    (folder / "seed.bdf").write_text("\n".join(["BEGIN BULK", *grids, *cells, "ENDDATA", ""]))
    return folder / "seed.bdf"


def _abaqus(folder: Path) -> Path:
    (folder / "nodes.inp").write_text(ABAQUS_PART)
    (folder / "seed.inp").write_text(ABAQUS)
    return folder / "seed.inp"


def _netgen(folder: Path) -> Path:
    from foreign_meshes import write_netgen

    return write_netgen(folder / "seed.vol", POINTS, [(1, row) for row in TETS.tolist()], {1: "soft"})


def _netgen_gz(folder: Path) -> Path:
    plain = _netgen(folder)
    (folder / "seed.vol.gz").write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
    plain.unlink()
    return folder / "seed.vol.gz"


def _tetgen(folder: Path) -> Path:
    from foreign_meshes import write_tetgen

    return write_tetgen(folder / "seed.node", POINTS, TETS.tolist(), [1, 2])


def _vtk(suffix: str, binary: bool = True, version: int = 51) -> Callable[[Path], Path]:
    """Cells of all kinds, written by VTK's own writers."""

    def make(folder: Path) -> Path:
        from foreign_meshes import grid, vtk_grid, write_with_vtk

        points, blocks = grid(2, np.random.default_rng(1), ["hexahedron", "wedge", "pyramid"])
        kinds = {"hexahedron": 12, "wedge": 13, "pyramid": 14}
        cells = [(kinds[block.kind], row) for block in blocks for row in block.nodes.tolist()]
        data = vtk_grid(points, cells, {"tissue": [k % 2 for k in range(len(cells))]})
        if suffix == ".vtkhdf":
            from vtkmodules.vtkIOHDF import vtkHDFWriter

            writer = vtkHDFWriter()
            writer.SetFileName(str(folder / "seed.vtkhdf"))
            writer.SetInputData(data)
            writer.SetChunkSize(100)
            writer.Write()
            return folder / "seed.vtkhdf"
        if suffix == ".vtm":
            from vtkmodules.vtkCommonDataModel import vtkMultiBlockDataSet

            data, whole = vtkMultiBlockDataSet(), data
            data.SetBlock(0, whole)
            data.SetBlock(1, whole)
        return write_with_vtk(folder / f"seed{suffix}", data, binary, version)

    return make


def _vtp(folder: Path) -> Path:
    from foreign_meshes import write_with_vtk
    from vtkmodules.vtkFiltersSources import vtkSphereSource

    ball = vtkSphereSource()
    ball.SetRadius(0.05)
    ball.Update()
    return write_with_vtk(folder / "seed.vtp", ball.GetOutput())


def _pvtu(folder: Path) -> Path:
    _vtk(".vtu")(folder).rename(folder / "piece.vtu")
    (folder / "seed.pvtu").write_text(
        '<VTKFile type="PUnstructuredGrid" version="1.0"><PUnstructuredGrid GhostLevel="0">'
        '<PCellData><PDataArray type="Int64" Name="tissue"/></PCellData>'
        '<PPoints><PDataArray type="Float64" NumberOfComponents="3"/></PPoints>'
        '<Piece Source="piece.vtu"/></PUnstructuredGrid></VTKFile>\n'
    )
    return folder / "seed.pvtu"


def _stage(suffix: str, tets: bool = False) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        from pxr import Usd, UsdGeom

        stage = Usd.Stage.CreateInMemory()
        if tets:
            mesh = UsdGeom.TetMesh.Define(stage, "/Tets")
            mesh.CreatePointsAttr([tuple(p) for p in POINTS.tolist()])
            mesh.CreateTetVertexIndicesAttr([tuple(t) for t in TETS.tolist()])
        else:
            import trimesh

            ball = trimesh.creation.icosphere(2, 50.0)
            UsdGeom.SetStageMetersPerUnit(stage, 0.001)
            mesh = UsdGeom.Mesh.Define(stage, "/World/Ball")
            mesh.AddTranslateOp().Set((100, 0, 0))
            mesh.CreatePointsAttr([tuple(p) for p in ball.vertices.tolist()])
            mesh.CreateFaceVertexCountsAttr([3] * len(ball.faces))
            mesh.CreateFaceVertexIndicesAttr(ball.faces.ravel().tolist())
        stage.Export(str(folder / f"seed{suffix}"))
        return folder / f"seed{suffix}"

    return make


def _scene(folder: Path) -> Path:
    from scene_stages import StageMaker

    stage = StageMaker(folder / "seed.usda")
    stage.material(stage.block(cells=(1, 1, 1)))
    stage.box()
    return stage.save()


def _voxels() -> np.ndarray:
    axis = np.arange(10) - 4.5
    away = np.linalg.norm(np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1), axis=-1)
    return np.where(away < 2.0, 7, np.where(away < 4.0, 2, 0)).astype(np.uint8)


def _nibabel(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import nibabel

        image = nibabel.Nifti1Image(_voxels(), np.diag([4.0, 4.0, 4.0, 1.0]))
        image.header.set_xyzt_units("mm")
        nibabel.save(image, folder / f"seed{suffix}")
        return folder / f"seed{suffix}"

    return make


def _itk(suffix: str) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import SimpleITK

        image = SimpleITK.GetImageFromArray(_voxels())
        image.SetSpacing((4.0, 4.0, 4.0))
        SimpleITK.WriteImage(image, str(folder / f"seed{suffix}"))
        return folder / f"seed{suffix}"

    return make


def _dicom(folder: Path) -> Path:
    import SimpleITK

    language = locale.setlocale(locale.LC_ALL)
    writer = SimpleITK.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    (folder / "series").mkdir()
    for k, values in enumerate(_voxels().astype(np.int16)):
        image = SimpleITK.GetImageFromArray(values)
        image.SetSpacing((4.0, 4.0))
        said = {"0008|0060": "CT", "0020|000d": "1.2.3", "0020|000e": "1.2.3.1", "0008|0018": f"1.2.3.1.{k}"}
        said |= {"0020|0032": f"0\\0\\{4 * k}", "0020|0037": "1\\0\\0\\0\\1\\0", "0020|0013": str(k)}
        for key, value in said.items():
            image.SetMetaData(key, value)
        writer.SetFileName(str(folder / "series" / f"{k}.dcm"))
        writer.Execute(image)
    locale.setlocale(locale.LC_ALL, language)  # which writing DICOM changes to "C" for the whole process
    return folder / "series"


def _vti(folder: Path) -> Path:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkIOXML import vtkXMLImageDataWriter

    grid = vtkImageData()
    grid.SetDimensions(10, 10, 10)
    grid.SetSpacing(4.0, 4.0, 4.0)
    grid.GetPointData().SetScalars(numpy_to_vtk(_voxels().ravel(order="F"), deep=True))
    writer = vtkXMLImageDataWriter()
    writer.SetFileName(str(folder / "seed.vti"))
    writer.SetInputData(grid)
    writer.Write()
    return folder / "seed.vti"


def _run(folder: Path) -> Path:
    _ball(".ply")(folder).rename(folder / "ball.ply")
    (folder / "run.toml").write_text(RUN)
    return folder / "run.toml"


def _checkpoint(remeshed: bool) -> Callable[[Path], Path]:
    def make(folder: Path) -> Path:
        import warp_corot as wc

        body = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.1, 2), wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
        body.fix("z < 0.01")
        remesh = wc.OnlineRemesh(max_level=4, capacity=200) if remeshed else None
        wc.Simulation(body, integrator=wc.SymplecticEuler(1e-4), remesh=remesh).save(folder / "seed.npz")
        return folder / "seed.npz"

    return make


#: Functions that write a valid input into an empty folder, by format. A new format is one line.
SEEDS: dict[str, Callable[[Path], Path]] = {
    "stl": _ball(".stl"),
    "obj": _objects,
    "ply": _ball(".ply"),
    "glb": _ball(".glb"),
    "gltf": _gltf,
    "usda": _stage(".usda"),
    "usdc": _stage(".usdc"),
    "usda-tets": _stage(".usda", tets=True),
    "usdc-tets": _stage(".usdc", tets=True),
    "scene": _scene,
    "msh-4": _meshio(".msh", file_format="gmsh", binary=False),
    "msh-4-binary": _meshio(".msh", file_format="gmsh", binary=True),
    "mesh": _meshio(".mesh"),
    "meshb": _meshio(".meshb"),
    "bdf": _nastran,
    "inp": _abaqus,
    "tetgen": _tetgen,
    "vol": _netgen,
    "vol.gz": _netgen_gz,
    "vtk-4": _vtk(".vtk", version=42),
    "vtu": _vtk(".vtu"),
    "vtp": _vtp,
    "vtm": _vtk(".vtm", binary=False),
    "pvtu": _pvtu,
    "vtkhdf": _vtk(".vtkhdf"),
    "vti": _vti,
    "xdmf": _meshio(".xdmf", data_format="XML"),
    "med": _meshio(".med"),
    "cgns": _meshio(".cgns"),
    "su2": _meshio(".su2"),
    "nii": _nibabel(".nii"),
    "nii.gz": _nibabel(".nii.gz"),
    "nrrd": _itk(".nrrd"),
    "nhdr": _itk(".nhdr"),
    "mha": _itk(".mha"),
    "dicom": _dicom,
    "run": _run,
    "checkpoint": _checkpoint(False),
    "checkpoint-remesh": _checkpoint(True),
}
