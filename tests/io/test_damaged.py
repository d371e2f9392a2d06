"""Effects of damaged files on other libraries, and inconsistent numbers in them: one line each."""

import json

import numpy as np
import pytest
from fuzz_seeds import SEEDS

import warp_corot as wc
from warp_corot.cli import main
from warp_corot.domain import Domain
from warp_corot.domain.closing import close_surface
from warp_corot.errors import InputError
from warp_corot.io.read.filemesh import FileMesh, Unreadable, load_volume


def test_a_stage_that_is_cut_off_gets_one_line(tmp_path):
    """As by a download that ended early, at any length."""
    path = SEEDS["usdc-tets"](tmp_path)
    whole = path.read_bytes()
    for length in range(1, len(whole), len(whole) // 12):
        path.write_bytes(whole[:length])
        with pytest.raises(InputError, match=r"seed\.usdc: ") as refused:
            wc.TetMesh.load(path)
        assert "\n" not in str(refused.value)


def test_a_series_without_one_of_its_slices(tmp_path):
    pytest.importorskip("SimpleITK")
    folder = SEEDS["dicom"](tmp_path)
    assert not any("unevenly" in note for note in load_volume(folder).notes)
    (folder / "4.dcm").unlink()
    volume = load_volume(folder)
    assert "slices are missing or unevenly spaced, by up to 4 mm" in volume.notes
    assert volume.values.shape == (10, 10, 9)


def test_a_scan_with_an_unknown_unit_and_one_without_voxels(tmp_path):
    nibabel = pytest.importorskip("nibabel")
    path = SEEDS["nii"](tmp_path)
    data = bytearray(path.read_bytes())
    data[123] = 7
    path.write_bytes(data)
    with pytest.raises(InputError, match="the file names no unit"):
        Domain.from_labels(path)
    nibabel.save(nibabel.Nifti1Image(np.zeros((0, 3, 3), np.uint8), np.eye(4)), tmp_path / "empty.nii")
    with pytest.raises(InputError, match=r"empty\.nii: is not a \.nii file"):
        load_volume(tmp_path / "empty.nii")


@pytest.mark.parametrize("points", [np.zeros((5, 2)), np.zeros(5), np.array(0.0)])
def test_points_without_three_coordinates(points):
    with pytest.raises(Unreadable, match="its points have the shape"):
        FileMesh(points, [])


def test_triangles_whose_areas_are_too_small_for_a_number():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    with pytest.raises(InputError, match="has an area"):
        close_surface(1e-200 * corners, np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]))


def test_two_dashes_are_no_value(tmp_path, capsys):
    for command in (["verify", f"--json={tmp_path}/out.json", "--device=--"], ["simulate", "box", "--output=--"]):
        with pytest.raises(SystemExit) as left:
            main(command)
        assert left.value.code == 2
        assert "'--' is not a value" in capsys.readouterr().err
    (tmp_path / "run.toml").write_text('input = "box"\nyoung = "--"\n')
    assert main(["simulate", str(tmp_path / "run.toml"), "-o", str(tmp_path / "out.usd")]) == 2
    assert "'--' is not a value" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("pieces.leaf_tets.0", 1 << 30), ("pieces.leaves.0", -1), ("pieces.code.0", 1 << 30)),
        *(("pieces.level.0", 99), ("counts", 999)),
    ],
)
def test_indices_beyond_a_changing_mesh(tmp_path, name, value):
    """Kernels do not check indices."""
    path = SEEDS["checkpoint-remesh"](tmp_path)
    with np.load(path) as archive:
        arrays = dict(archive)
    assert json.loads(arrays["header"].tobytes())["bodies"][0]["remesh"]
    arrays[f"bodies.0.remesh.present.{name}"].reshape(-1)[0] = value
    np.savez(path, **arrays)
    with pytest.raises(InputError, match="is not a complete checkpoint"):
        wc.Simulation.load(path, device="cpu")


def test_a_nastran_file_that_ends_before_its_first_card(tmp_path):
    """meshio alone would wait for the first card for ever."""
    pytest.importorskip("meshio")
    path = SEEDS["bdf"](tmp_path)
    assert len(wc.TetMesh.load(path).tets) == 2
    path.write_text("$ a comment\nBEGIN BULK\n$ nothing\n\n")
    with pytest.raises(InputError, match="it ends before its first card"):
        wc.TetMesh.load(path)


def test_a_vtk_array_whose_name_is_not_text(tmp_path):
    pytest.importorskip("vtkmodules")
    from warp_corot.io.read import vtk_files

    path = SEEDS["vtk-4"](tmp_path)
    data = path.read_bytes()
    assert data.count(b"tissue") == 1
    path.write_bytes(data.replace(b"tissue", b"tiss\xffe"))
    mesh = vtk_files.read(path)
    assert {name for block in mesh.blocks for name in block.data} == {"tiss\N{REPLACEMENT CHARACTER}e"}
    assert len(wc.TetMesh.load(path).tets)
