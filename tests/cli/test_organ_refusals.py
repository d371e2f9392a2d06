"""Surfaces, scans and their options that ``warp-corot simulate`` refuses."""

from pathlib import Path

import nibabel
import numpy as np
import pytest
import trimesh
from command_line import assert_refused
from input_files import write_scan, write_surface

from warp_corot.cli.input_mesh import parse_labels


@pytest.fixture(scope="module")
def refused_files(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("refused")
    write_surface(folder / "organ.obj", False)
    write_scan(folder / "scan.nii.gz")
    grey = nibabel.Nifti1Image(np.resize(np.arange(-20, 281), (12, 12, 12)).astype(np.int16), np.eye(4))
    nibabel.save(grey, folder / "grey.nii.gz")
    for name, values in (("zeros", np.zeros((4, 4, 4), np.uint8)), ("halves", np.full((4, 4, 4), 0.5, np.float32))):
        nibabel.save(nibabel.Nifti1Image(values, np.eye(4)), folder / f"{name}.nii.gz")
    colours = np.zeros((4, 4, 4), [("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(nibabel.Nifti1Image(colours, np.eye(4)), folder / "colours.nii.gz")
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
    return folder


REFUSED = [
    (["none.obj"], "none.obj: no such file"),
    (["none.nii.gz"], "none.nii.gz: no such file"),
    (["text.stl"], "text.stl: has no tetrahedra and no triangles"),
    (["text.nii.gz"], "text.nii.gz: is not a .nii.gz file"),
    (["empty.glb"], "empty.glb: is empty"),
    (["half.ply"], "half.ply: the surface is open"),
    (["flat.off"], "flat.off: the surface has zero thickness"),
    (["warp:hare"], "warp:hare: no such asset; it must be warp:bunny, warp:bear"),
    (
        ["organ.obj", "--unit", "kPa"],
        "argument --unit: 'kPa'; it must be a length such as 'mm', 'cm', 'm', 'inch' or '3.2cm'",
    ),
    (["organ.obj", "--scale", "0"], "scale is 0; it must be a positive number"),
    (["organ.obj", "--materials", "a=3kPa"], "--materials is for scans without --labels and tetra"),
    (["organ.obj", "--up", "q"], "argument --up: invalid choice: 'q'"),
    (["organ.obj", "--threshold", "1"], "--threshold is for scans"),
    (["scan.nii.gz", "--threshold", "3:1"], "'3:1' must be a number or LOW:HIGH"),
    (["scan.nii.gz", "--threshold", "1", "--labels", "2=3kPa"], "--threshold is for scans without --labels"),
    (["scan.nii.gz", "--regions-by", "tissue"], "--regions-by is for --materials on tetrahedra"),
    (["grey.nii.gz"], "grey.nii.gz: has 301 different values or more, -20 to 280, as intensities do"),
    (["zeros.nii.gz", "--unit", "mm"], "the volume is empty: all of its voxels are 0"),
    (["halves.nii.gz"], "halves.nii.gz: has values such as 0.5, as probabilities and intensities do"),
    (["colours.nii.gz"], "it has 3 dimensions and 3 numbers a voxel"),
    (["organ.obj", "--tets", "999999999"], "--tets is 999999999; it must be at most 100000000"),
    (["organ.obj", "--pull", "right", "0", "0", "1cm", "--tets", "500"], "--pull: expression 'right': 'right' is not"),
    (["organ.obj", "--labels", "liver=3kPa"], "--labels is for scans, and organ.obj is not one"),
    (["organ.obj", "--draw-labels"], "--draw-labels is for scans"),
    (["box", "--unit", "mm"], "--unit is for files, and box is not one; use --scale"),
    (["warp:bear", "--tets", "1000"], "--tets is for surfaces and scans"),
    (["box", "--draw-tets"], "--draw-tets is for surfaces and scans"),
    (["organ.obj", "--tets", "0"], "--tets is 0; it must be a whole number, at least 1"),
    (["organ.obj", "--tets", "1"], "error: --tets is 1; at the coarsest"),
    (["organ.obj", "--tets", "many"], "argument --tets: 'many' must be a whole number"),
    (["organ.obj", "--fix", "all", "--tets", "500"], "expression 'all': holds all"),
    (["organ.obj", "--level", "99"], "--level is 99"),
    (["organ.obj", "--level", "2", "--tets", "500"], "--level is given, with which --tets has no effect"),
    (["organ.obj", "--rotation-level", "-1"], "--rotation-level is -1"),
    (["scan.nii.gz", "--labels", "liver"], "--labels 'liver': it must be NAME"),
    (["scan.nii.gz", "--labels", ""], "--labels '': it must be NAME"),
    (["scan.nii.gz", "--labels", "a=3kPa:0.45:1000:2,b=3kPa"], "it must be NAME"),
    (["scan.nii.gz", "--labels", "a=soft,b=3kPa"], "'soft' is not a number, with or without a unit"),
    (["scan.nii.gz", "--labels", "a=3inch,b=3kPa"], "3inch"),
    (["scan.nii.gz", "--labels", "a=3kPa:half,b=3kPa"], "'half' is not a number"),
    (["scan.nii.gz", "--labels", "a=3kPa:nan,b=3kPa"], "poisson is nan"),
    (["scan.nii.gz", "--labels", "a=3kPa:0.5,b=3kPa"], "--labels 'a=3kPa:0.5': poisson is 0.5"),
    (["scan.nii.gz", "--labels", "a=-3kPa,b=3kPa"], "young is -3000 Pa"),
    (["scan.nii.gz", "--labels", "a=3kPa:0.4:0,b=3kPa"], "density is 0"),
    (["scan.nii.gz", "--labels", "a=3kPa,a=4kPa"], "the label a is given twice"),
    (["scan.nii.gz", "--labels", "a@2=3kPa,b@2+7=4kPa"], "the number 2 is given twice"),
    (["scan.nii.gz", "--labels", "a=3kPa"], "the number of label 'a' is not known; it must be given, as in a@1=3kPa; "),
    (["scan.nii.gz", "--labels", "a=3kPa,b=3kPa,c=3kPa"], "the volume's labels: 2, 7"),
    (["scan.nii.gz", "--labels", "a@2=3kPa,b=3kPa"], "the number of label 'b' is not known"),
    (["scan.nii.gz", "--labels", "2=3kPa,3=3kPa"], "label 3 ('3') is not in the volume"),
    (["scan.nii.gz", "--labels", "2=3kPa", "--young", "500"], "--young is given, but --labels gives each"),
    (["scan.nii.gz", "--draw-labels"], "--draw-labels draws the labels that --labels or --materials names"),
    (["scan.nii.gz", "--smoothing", "-1"], "--smoothing is -1"),
    (["scan.nii.gz", "--smoothing", "1"], "--smoothing is 1 m and the body"),
    (["out.usda"], "is the input"),
]


@pytest.mark.parametrize(("args", "said"), REFUSED, ids=[" ".join(args)[:60] for args, _ in REFUSED])
def test_bad_input_is_one_line_and_touches_nothing(refused_files, monkeypatch, args, said, capsys):
    monkeypatch.chdir(refused_files)
    assert_refused(refused_files, capsys, said, *args, "-o", "out.usda")


def test_pressures():
    for text, pascals in (
        ("500", 500),
        ("3kPa", 3e3),
        ("1psi", 6894.757),
        ("2 N/mm2", 2e6),
        (" 3.5 kPa", 3.5e3),
        ("1e-3GPa", 1e6),
        (".1MPa", 1e5),
    ):
        assert parse_labels(f"a={text}")[0].young == pytest.approx(pascals)
    (entry,) = parse_labels("grey matter@3+4 = 2kPa:0.49")
    assert (entry.name, entry.numbers, entry.young, entry.poisson, entry.density) == (
        "grey matter",
        (3, 4),
        2e3,
        0.49,
        None,
    )
