"""Named node sets, from the formats that have them, and their use."""

import meshio
import numpy as np
import pytest
from command_line import SHORT, simulate
from pxr import Usd, UsdGeom
from stages import frames, opened

import warp_corot as wc
from warp_corot.errors import InputError
from warp_corot.io.read.filemesh import sets_of_numbers

BAR = wc.TetForest.box((2, 1, 1), 0.05, 3)
LEFT, RIGHT = (np.flatnonzero(BAR.points[:, 0] == x) for x in (0.0, 0.1))

ABAQUS = """*Part, name=Tip
*Node
 10, 0, 0, 0
 20, 1, 0, 0
 30, 0, 1, 0
 40, 0, 0, 1
*Element, type=C3D4, elset=Solid
 1, 10, 20, 30, 40
*Element, type=CPS3, elset=Face
 7, 10, 20, 30
*Nset, nset=Base, generate
 10, 30, 10
*End Part
*Assembly, name=A
*Instance, name=one, part=Tip
*End Instance
*Nset, nset=Pulled, instance=one
 20,
*End Assembly
"""


def test_abaqus(tmp_path):
    """By lists and ranges; of a single instance; and the nodes of element sets."""
    (tmp_path / "a.inp").write_text(ABAQUS)
    sets = wc.TetMesh.load(tmp_path / "a.inp").node_sets
    expected = {"Solid": range(4), "Face": range(3), "Base": range(3), "Pulled": [1]}
    assert {name: np.flatnonzero(nodes).tolist() for name, nodes in sets.items()} == {
        name: list(nodes) for name, nodes in expected.items()
    }


def gmsh_2(points, tets, triangles) -> str:
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$PhysicalNames", "2", '2 5 "left end"', '3 6 "tissue"']
    lines += ["$EndPhysicalNames", "$Nodes", str(len(points))]
    lines += [f"{k + 1} {x} {y} {z}" for k, (x, y, z) in enumerate(points.tolist())]
    lines += ["$EndNodes", "$Elements", str(len(tets) + len(triangles))]
    cells = [(2, 5, row) for row in triangles.tolist()] + [(4, 6, row) for row in tets.tolist()]
    lines += [f"{k + 1} {kind} 2 {g} {g} {' '.join(str(n + 1) for n in row)}" for k, (kind, g, row) in enumerate(cells)]
    return "\n".join([*lines, "$EndElements", ""])


def test_groups_of_surfaces_in_gmsh(tmp_path):
    faces = np.sort(BAR.tets, axis=1)[:, [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3]]].reshape(-1, 3)
    triangles = faces[np.isin(faces, LEFT).all(axis=1)]
    (tmp_path / "a.msh").write_text(gmsh_2(BAR.points, BAR.tets, triangles))
    mesh = wc.TetMesh.load(tmp_path / "a.msh")
    assert mesh.label_names == ("tissue",)
    assert np.flatnonzero(mesh.node_sets["left end"]).tolist() == LEFT.tolist()


def with_point_data(path, **data):
    meshio.write(path, meshio.Mesh(BAR.points, [("tetra", BAR.tets)], point_data=data))


@pytest.mark.parametrize("suffix", [".vtu", ".vtk", ".xdmf"])
def test_point_data(tmp_path, suffix):
    ends = np.zeros(len(BAR.points), np.int32)
    ends[LEFT], ends[RIGHT] = 1, 2
    data = {"ends": ends, "held": (ends == 1).astype(float), "number": np.arange(len(ends)), "u": np.sin(ends)}
    with_point_data(tmp_path / f"a{suffix}", **data)
    sets = wc.TetMesh.load(tmp_path / f"a{suffix}").node_sets
    assert {name: np.flatnonzero(nodes).tolist() for name, nodes in sets.items()} == {
        "ends_1": LEFT.tolist(),
        "ends_2": RIGHT.tolist(),
        "held": LEFT.tolist(),
    }


def test_exodus(tmp_path):
    pytest.importorskip("netCDF4")
    mesh = meshio.Mesh(BAR.points, [("tetra", BAR.tets)], point_sets={"clamp": LEFT})
    meshio.write(tmp_path / "a.e", mesh)
    assert np.flatnonzero(wc.TetMesh.load(tmp_path / "a.e").node_sets["clamp"]).tolist() == LEFT.tolist()


def test_numbers_of_nodes_are_no_sets():
    assert sets_of_numbers("a", np.arange(100)) == {}
    assert sets_of_numbers("a", np.zeros(5, np.int64)) == {}


def test_they_are_patches(folder, capsys):
    """Sets are patches by name, even if it is no identifier; the file's "top" is that set, not the highest tenth."""
    data = {"left-end": np.isin(np.arange(len(BAR.points)), LEFT).astype(np.int32)}
    data["top"] = np.isin(np.arange(len(BAR.points)), RIGHT).astype(np.int32)
    with_point_data(folder / "bar.vtu", **data)
    args = ["--fix", "left_end", "--pull", "top", 0, 0, 0.01, *SHORT]
    assert simulate("bar.vtu", "-o", "a.usd", *args) == 0
    said = capsys.readouterr()
    assert "its sets of nodes, for --fix and the like: left_end, top" in said.err
    assert f"{len(LEFT)} nodes, held where left_end" in said.out
    rest, *_, last = frames(folder / "a.usd")
    np.testing.assert_allclose((last - rest)[RIGHT], [[0, 0, 0.01]] * len(RIGHT), atol=1e-6)
    # The written stage has a set of its own: the held nodes.
    assert simulate("a.usd", "-o", "b.usd", "--fix", "fixed", *SHORT) == 0
    assert f"{len(LEFT) + len(RIGHT)} nodes, held where fixed" in capsys.readouterr().out


def test_in_python():
    mesh = wc.TetMesh(BAR.points, BAR.tets, node_sets={"left end": LEFT, "x": BAR.points[:, 0] > 0.09})
    body = wc.SoftBody(mesh, wc.Isotropic(1e4, 0.4, 1e3), device="cpu")
    body.fix("left_end and not x_set")
    assert np.flatnonzero(body.constrained).tolist() == LEFT.tolist()
    with pytest.raises(InputError, match="node 999 is out of range"):
        wc.TetMesh(BAR.points, BAR.tets, node_sets={"a": [999]})


def write_pair(path) -> None:
    """Two bars as prims of a stage, the second one behind the first and in contact with it."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, "Z")
    for name, x in (("near", 0.0), ("far", 0.1)):
        prim = UsdGeom.TetMesh.Define(stage, f"/{name}")
        prim.CreatePointsAttr((BAR.points + np.array([x, 0, 0])).tolist())
        prim.CreateTetVertexIndicesAttr(BAR.tets.tolist())
    stage.Save()


def test_prims_of_a_stage_are_bodies_or_one(folder, capsys):
    write_pair(folder / "pair.usda")
    assert simulate("pair.usda", "-o", "a.usd", "--fix", "x < 0.01", *SHORT) == 0
    said = capsys.readouterr()
    assert "2 separate bodies: near, far (--join makes them one)" in said.err
    assert "near, held where x < 0.01" in said.out
    assert "far, free, nothing is held" in said.out
    count = len(BAR.points)
    rest, *_, last = frames(folder / "a.usd")
    assert (last - rest)[count:, 2].max() < -0.01  # the far one falls
    assert simulate("pair.usda", "-o", "b.usd", "--join", "--fix", "x < 0.01", *SHORT) == 0
    assert f"{len(RIGHT)} nodes coincide with others" in capsys.readouterr().err
    _, tets = opened(folder / "b.usd")
    assert len(tets.GetPointsAttr().Get(0)) == 2 * count - len(RIGHT)


def test_bodies_of_a_run_are_placed_by_offsets(folder, capsys):
    with_point_data(folder / "bar.vtu")
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.icosphere(2, 30.0).export(folder / "ball.stl")
    (folder / "run.toml").write_text("""
output = "a.usd"
[[body]]
input = "bar.vtu"
offset = [0, "3cm", 0.5]
[[body]]
input = "box"
offset = [1, 0, 0]
[[body]]
input = "ball.stl"
unit = "mm"
tets = 300
offset = [0, 2, 0]
""")
    assert simulate("run.toml", *SHORT) == 0
    stage = Usd.Stage.Open(str(folder / "a.usd"))
    near = {}
    for prim in stage.Traverse():
        points = UsdGeom.PointBased(prim)
        if points and points.GetPointsAttr().Get(0):
            x = np.array(points.GetPointsAttr().Get(0))
            near[prim.GetName()] = np.stack([x.min(axis=0), x.max(axis=0)])
    np.testing.assert_allclose(near["ball"], [[-0.03, 1.97, -0.03], [0.03, 2.03, 0.03]], atol=2e-3)
    others = near["surface"]
    np.testing.assert_allclose(others, [[0, 0, 0], [1.064, 0.08, 0.55]], atol=1e-6)
