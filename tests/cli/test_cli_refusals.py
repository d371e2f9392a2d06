"""Input that ``warp-corot simulate`` refuses."""

import os
from pathlib import Path

import numpy as np
import pytest
from command_line import SHORT, assert_refused, simulate
from input_files import write_vtk
from pxr import Usd, UsdGeom


@pytest.fixture(scope="module")
def refused_meshes(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("refused")
    (folder / "text.usd").write_text("not a stage")
    (folder / "empty.vtk").write_bytes(b"")
    (folder / "words.docx").write_text("words")
    tet = [[0, 1, 2, 3]]
    corner = np.eye(4, 3, k=-1) * 0.1
    write_vtk(folder / "good.vtk", corner, tet)
    write_vtk(folder / "nan.vtk", np.where(np.arange(4)[:, None] == 2, np.nan, corner), tet)
    write_vtk(folder / "inf.vtk", np.where(np.arange(4)[:, None] == 3, np.inf, corner), tet)
    write_vtk(folder / "flat.vtk", corner * [1, 1, 0], tet)
    stage = Usd.Stage.CreateNew(str(folder / "surface.usda"))
    UsdGeom.Cube.Define(stage, "/Cube")
    stage.Save()
    stage = Usd.Stage.CreateNew(str(folder / "out.usd"))
    tets = UsdGeom.TetMesh.Define(stage, "/Tets")
    tets.CreatePointsAttr([tuple(p) for p in (np.eye(4, 3, k=-1) * 0.1).tolist()])
    tets.CreateTetVertexIndicesAttr([(0, 1, 2, 3)])
    stage.Save()
    return folder


REFUSED = [
    (["none.usd"], "none.usd: no such file"),
    (["https://example.com/liver.stl"], "liver.stl: is a web address; the input must be a file on this machine"),
    (["text.usd"], "text.usd: is not a USD file"),
    (["empty.vtk"], "empty.vtk: is empty"),
    (["words.docx"], "words.docx: unknown format .docx"),
    (["."], "is a folder"),
    (["surface.usda"], "surface.usda: has no tetrahedra"),
    (["nan.vtk"], "nan.vtk: point 2 has coordinates"),
    (["inf.vtk"], "inf.vtk: point 3 has coordinates"),
    (["flat.vtk"], "flat.vtk: tetrahedron 0 with the nodes [0, 1, 2, 3] is degenerate"),
    (["warp:dragon"], "warp:dragon: no such asset"),
    (["box", "--young", "0"], "--young is 0 Pa"),
    (["box", "--young", "nan"], "young is nan"),
    (["box", "--young", "soft"], "--young"),
    (["box", "--poisson", "0.5"], "poisson is 0.5"),
    (["box", "--poisson", "-1"], "poisson is -1"),
    (["box", "--density", "0"], "density is 0"),
    (["box", "--density", "-1e3"], "density is -1000"),
    (["box", "--fix", "z > -1"], "expression 'z > -1': holds all 325 nodes"),
    (["box", "--fix", "all"], "all 325 nodes"),
    (["box", "--fix", "z = 0"], "'z = 0'"),
    (["box", "--fix", ""], "it is empty"),
    (["box", "--fix", "__import__('os').remove('out.usd')"], "not understood"),
    (["box", "--fix", "z / 0 < 1"], "division by zero"),
    (["box", "--device", "cuda:99"], "there is no device 'cuda:99'"),
    (["box", "--model", "rigid"], "invalid choice: 'rigid'"),
    (["box", "--model", "linear", "--rotation-level", "2"], "--rotation-level is 2"),
    (["box", "--rotation-level", "-1"], "--rotation-level is -1; it must be a whole number"),
    (["good.vtk", "--rotation-level", "1"], "--rotation-level is for box, surfaces and scans, and good.vtk is not one"),
    (["box", "--scale", "0"], "scale is 0"),
    (["good.vtk", "--scale", "nan"], "scale is nan"),
    (["box", "--gravity", "0", "nan", "0"], "gravity is"),
    (["box", "--gravity", "0", "1"], "--gravity: expected 3 arguments"),
    (["box", "--duration", "0"], "duration is 0 s"),
    (["box", "--duration", "0.001"], "at least one frame"),
    (["box", "--duration", "inf"], "duration is inf"),
    (["box", "--fps", "0"], "fps is 0"),
    (["box", "--dt", "0"], "--dt is 0"),
    (["box", "--dt", "-1e-3"], "dt is -0.001"),
    (["box", "--dt", "1e-16"], "a frame of 0.0417 s would take 4.17e+14 steps"),
    (["box", "--young", "1e30"], "a frame of 0.0417 s would take"),
    (["box", "--young", "1e39"], "the stiffness 2 mu + |lambda| is 1.71e+40 Pa; it must be within the range"),
    (["box", "--young", "1e-40"], "the stiffness 2 mu + |lambda| is 1.71e-39 Pa; it must be within the range"),
    (["box", "--density", "1e300"], "the mass of a node is"),
    (["box", "--scale", "1e-20"], "the volume of an element is 6.83e-67 m^3; it must be within the range"),
    (["box", "-o", "out\udcff.usd"], "its name is not UTF-8"),
    (["box", "--damping", "-1"], "damping is -1"),
    (["box", "--preview", "nowhere/a.png"], "nowhere/a.png: output folder nowhere does not exist"),
    (["box", "--colour"], "there is no option --colour"),
    ([], "required: INPUT"),
    (["box", "-o", "nowhere/out.usd"], "output folder nowhere does not exist"),
    (["none.usd", "-o", "nowhere/out.usd"], "output folder nowhere does not exist"),  # before the mesh is read
    (["box", "-o", "out.txt"], "extension .txt"),
    (["box", "-o", "."], "extension"),
    (["out.usd"], "is the input"),
]


@pytest.mark.parametrize(("args", "said"), REFUSED, ids=[" ".join(args)[:40] for args, _ in REFUSED])
def test_bad_input_is_one_line_and_touches_nothing(refused_meshes, monkeypatch, args, said, capsys):
    monkeypatch.chdir(refused_meshes)
    given = args if "-o" in args else [*args, "-o", "out.usd"]
    assert_refused(refused_meshes, capsys, said, *given)


def test_output_is_required(folder, capsys):
    assert simulate("box") == 2
    assert "-o" in capsys.readouterr().err


@pytest.mark.skipif(os.name != "posix" or os.geteuid() == 0, reason="root may write anywhere")
def test_folder_without_permission(folder, capsys):
    (folder / "locked").mkdir(mode=0o500)
    assert simulate("box", "-o", "locked/a.usd") == 2
    assert "cannot be written to" in capsys.readouterr().err


def test_preview_without_matplotlib(folder, capsys, monkeypatch):
    monkeypatch.setattr("warp_corot.cli.results.find_spec", lambda name: None)
    assert simulate("box", "-o", "a.usd", "--preview", "a.png", *SHORT) == 2
    assert "warp-corot[plot]" in capsys.readouterr().err
    assert list(folder.iterdir()) == []
