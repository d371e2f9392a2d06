"""Files of other programs: every cell, its volume and its region, and the reader's reason for refusing."""

import gzip

import numpy as np
import pytest
from foreign_meshes import (
    ABAQUS,
    ABAQUS_TIP,
    GMSH_KINDS,
    VOLUME,
    VTK_KINDS,
    grid,
    vtk_grid,
    write_gmsh,
    write_netgen,
    write_tetgen,
    write_with_vtk,
)

import warp_corot as wc
from warp_corot.errors import InputError
from warp_corot.io.read.filemesh import read_mesh_file
from warp_corot.io.read.meshes import load_surface, load_tets
from warp_corot.mesh.topology import signed_volumes


@pytest.fixture(scope="module")
def mixed():
    """Points, and cells with their kind, of a grid of hexahedra, wedges and pyramids."""
    points, blocks = grid(2, np.random.default_rng(5), ["hexahedron", "wedge", "pyramid"])
    return points, [(block.kind, row) for block in blocks for row in block.nodes.tolist()]


def halves(points, cells) -> np.ndarray:
    """7 for cells on the lower side of x, 9 for the others."""
    middles = np.array([points[row][:, 0].mean() for _, row in cells])
    return np.where(middles < np.median(middles), 7, 9)


def check(path, names=None, count=None, **options) -> wc.TetMesh:
    """The mesh of a file fills the grid, and its two regions are in their places."""
    mesh = wc.TetMesh.load(path, **options)
    assert np.abs(mesh.volumes).sum() == pytest.approx(VOLUME, rel=1e-6)
    if count is not None:
        assert len(mesh.points) == count
    if names is not None:
        assert set(mesh.label_names) == set(names)
        middles = mesh.points[mesh.tets].mean(axis=1)[:, 0]
        first, second = (middles[mesh.elements_of(name)] for name in names)
        assert first.mean() < second.mean() - 0.2
        assert len(first) + len(second) == len(mesh.tets)
    return mesh


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("binary", [True, False])
@pytest.mark.parametrize("suffix", [".vtk", ".vtu"])
def test_vtk_of_every_version(tmp_path, mixed, suffix, binary, version):
    pytest.importorskip("vtkmodules")
    points, cells = mixed
    arrays = {
        "vtkOriginalCellIds": list(range(len(cells))),
        "tissue": halves(points, cells),
        "heat": [0.5] * len(cells),
    }
    data = vtk_grid(points, [(VTK_KINDS[kind], row) for kind, row in cells], arrays)
    path = write_with_vtk(tmp_path / f"a{suffix}", data, binary, version)
    check(path, ("7", "9"), len(points))
    with pytest.raises(InputError, match="no array 'heat' of whole numbers; there are: tissue"):
        wc.TetMesh.load(path, regions="heat")


def test_vtk_voxels_polyhedra_and_structured_grids(tmp_path):
    pytest.importorskip("vtkmodules")
    from vtkmodules.vtkCommonCore import vtkDoubleArray
    from vtkmodules.vtkCommonDataModel import vtkRectilinearGrid

    cube = [(x, y, z) for z in (0, 1) for y in (0, 1) for x in (0, 1)]
    mesh = wc.TetMesh.load(write_with_vtk(tmp_path / "voxel.vtu", vtk_grid(cube, [(11, list(range(8)))])))
    assert mesh.volumes.sum() == pytest.approx(1.0)
    assert mesh.repaired == 0
    prism = [(np.cos(a), np.sin(a), z) for z in (0, 1) for a in np.arange(6) * np.pi / 3]
    mesh = wc.TetMesh.load(write_with_vtk(tmp_path / "prism.vtu", vtk_grid(prism, [(16, list(range(12)))])))
    assert mesh.volumes.sum() == pytest.approx(1.5 * np.sqrt(3))
    assert load_tets(tmp_path / "prism.vtu").notes == ["hexagonal prisms are split into tetrahedra or triangles by VTK"]
    axes = []
    for values in ([0, 1, 3], [0, 2], [0, 0.5, 1]):
        axes.append(vtkDoubleArray())
        for value in values:
            axes[-1].InsertNextValue(value)
    rectilinear = vtkRectilinearGrid()
    rectilinear.SetDimensions(3, 2, 3)
    rectilinear.SetXCoordinates(axes[0])
    rectilinear.SetYCoordinates(axes[1])
    rectilinear.SetZCoordinates(axes[2])
    for suffix in (".vtr", ".vtk"):
        mesh = wc.TetMesh.load(write_with_vtk(tmp_path / f"grid{suffix}", rectilinear))
        assert mesh.volumes.sum() == pytest.approx(6.0)
        assert len(mesh.points) == 18


def test_blocks_of_a_vtm_are_regions(tmp_path, mixed):
    pytest.importorskip("vtkmodules")
    from vtkmodules.vtkCommonDataModel import vtkCompositeDataSet, vtkMultiBlockDataSet

    points, cells = mixed
    which, blocks = halves(points, cells), vtkMultiBlockDataSet()
    for place, (number, name) in enumerate(((7, "soft"), (9, "hard"))):
        own = [(VTK_KINDS[kind], row) for (kind, row), n in zip(cells, which, strict=True) if n == number]
        blocks.SetBlock(place, vtk_grid(points, own))
        blocks.GetMetaData(place).Set(vtkCompositeDataSet.NAME(), name)
    mesh = check(write_with_vtk(tmp_path / "a.vtm", blocks), ("soft", "hard"))
    assert len(mesh.points) == 2 * len(points)


@pytest.mark.parametrize("suffix", [".vtp", ".vtk"])
def test_polygons_and_strips_are_surfaces(tmp_path, suffix):
    pytest.importorskip("vtkmodules")
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData

    corners = [(0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0), (0, 0, 3), (2, 0, 3), (2, 1, 3), (0, 1, 3)]
    places, polygons, strips = vtkPoints(), vtkCellArray(), vtkCellArray()
    for corner in corners:
        places.InsertNextPoint(*corner)
    for face in ((0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6)):
        polygons.InsertNextCell(4, face)
    strips.InsertNextCell(4, (3, 0, 7, 4))
    data = vtkPolyData()
    data.SetPoints(places)
    data.SetPolys(polygons)
    data.SetStrips(strips)
    loaded = load_surface(write_with_vtk(tmp_path / f"box{suffix}", data))
    assert len(loaded.cells) == 12
    assert np.linalg.det(loaded.points[loaded.cells]).sum() / 6.0 == pytest.approx(6.0)
    with pytest.raises(InputError, match=r"has no tetrahedra \(cell types: triangle\)"):
        load_tets(tmp_path / f"box{suffix}")


def test_gmsh(tmp_path, mixed):
    """Numbers of nodes begin at 11; physical groups are regions; triangles and points do no harm."""
    points, cells = mixed
    rows = [(GMSH_KINDS[kind], int(n), row) for (kind, row), n in zip(cells, halves(points, cells), strict=True)]
    path = write_gmsh(tmp_path / "a.msh", points, [(15, 0, [0]), (2, 1, [0, 1, 2]), *rows])
    check(path, ("7", "9"), len(points))
    cut = tmp_path / "cut.msh"
    cut.write_text(path.read_text(encoding="utf-8")[:-200])
    with pytest.raises(InputError, match=r"cut\.msh: is not a \.msh file that can be read \(.*meshio: "):
        load_tets(cut)


def test_tetgen(tmp_path):
    points, (block,) = grid(2, np.random.default_rng(1), ["tetra"])
    cells = [("tetra", row) for row in block.nodes.tolist()]
    path = write_tetgen(tmp_path / "a.node", points, block.nodes, halves(points, cells))
    for suffix in (".node", ".ele"):
        check(path.with_suffix(suffix), ("7", "9"), len(points))
    with pytest.raises(InputError, match=r"lone\.ele is missing"):
        load_tets(path.with_suffix(".node").rename(tmp_path / "lone.node"))


def test_netgen(tmp_path, mixed):
    points, cells = mixed
    order = {"hexahedron": (0, 3, 2, 1, 4, 7, 6, 5), "wedge": (0, 2, 1, 3, 5, 4), "pyramid": (0, 3, 2, 1, 4)}
    which = np.where(halves(points, cells) == 7, 1, 2)
    rows = [(int(n), [row[k] for k in order[kind]]) for (kind, row), n in zip(cells, which, strict=True)]
    path = write_netgen(tmp_path / "a.vol", points, rows, {1: "soft", 2: "hard"})
    check(path, ("soft", "hard"), len(points))
    with gzip.open(tmp_path / "b.vol.gz", "wb") as file:
        file.write(path.read_bytes())
    check(tmp_path / "b.vol.gz", ("soft", "hard"))


def test_abaqus(tmp_path):
    """Nodes in two lists, a comment between them, variants of types, sets of elements and of sets, an included file."""
    (tmp_path / "tip.inp").write_text(ABAQUS_TIP)
    path = tmp_path / "a.inp"
    path.write_text(ABAQUS)
    mesh = wc.TetMesh.load(path)
    assert set(mesh.label_names) == {"Whole", "All"}
    assert mesh.volumes[mesh.elements_of("Whole")].sum() == pytest.approx(1.0)
    assert mesh.volumes[mesh.elements_of("All")].sum() == pytest.approx(1 / 6)
    assert {name: len(nodes) for name, nodes in load_tets(path).node_sets.items()} == {"Whole": 8, "All": 4, "top": 4}
    for old, new, said in (
        ("6,\n 7, 8", "6,\n 7", "Expected number of data items does not match element type"),
        ("40, 0, 0, 3", "41, 0, 0, 3", "40"),
        ("*Heading", "*Part, name=A\n*End Part\n*Part, name=B\n*End Part", "it has several parts or instances"),
        ("1, 0., 0., 0.", "1, 0., zero, 0.", "could not convert string to float"),
        ("type=c3d8r", "type=c4d8r", "Element type not available: c4d8r"),
    ):
        (tmp_path / "tip.inp").write_text(ABAQUS_TIP.replace(old, new))
        path.write_text(ABAQUS.replace(old, new))
        with pytest.raises(InputError, match=said):
            load_tets(path)


def test_second_order_cells_are_said(tmp_path):
    corners = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], float)
    middles = [(corners[a] + corners[b]) / 2 for a, b in ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))]
    path = write_gmsh(tmp_path / "a.msh", [*corners, *middles], [(11, 0, list(range(10)))])
    loaded = load_tets(path)
    assert loaded.cells.tolist() == [[0, 1, 2, 3]]
    assert loaded.notes == ["second-order cells (tetra) are taken by their corners, with straight edges"]


@pytest.mark.parametrize(
    "suffix",
    [
        *(".vtk", ".vtu", ".msh", ".inp", ".node", ".vol", ".mesh"),
        *(pytest.param(suffix, marks=pytest.mark.slow) for suffix in (".vtp", ".vtm")),
    ],
)
def test_garbage_is_refused_with_the_readers_own_reason(tmp_path, suffix):
    path = tmp_path / f"bad{suffix}"
    for content in (b"words and words", bytes(range(256)) * 40, b"<VTKFile type='X'>" * 3, b"\n\n\n"):
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"bad\{suffix}: ") as raised:
            read_mesh_file(path)
        said = str(raised.value)
        assert "\n" not in said
        assert len(said) < 900
        assert "(Success)" not in said
        assert "needs: pip install" in said or len(said.partition("that can be read (")[2]) > 12


def test_orientation_of_split_cells_is_positive(tmp_path, mixed):
    points, cells = mixed
    path = write_gmsh(tmp_path / "a.msh", points, [(GMSH_KINDS[kind], 1, row) for kind, row in cells])
    loaded = load_tets(path)
    assert (signed_volumes(loaded.points, loaded.cells) > 0).all()
