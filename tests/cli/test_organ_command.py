"""``warp-corot simulate`` of surfaces and scans."""

import os
import sys
from dataclasses import replace

import numpy as np
import pytest
import SimpleITK
import trimesh
import warp as wp
from command_line import SHORT, simulate
from input_files import write_scan, write_surface
from pxr import Usd, UsdGeom
from stages import SURFACE, TETS, drawn, prims

import warp_corot as wc
import warp_corot.cli.run_setup as command
from warp_corot.cli import bodies
from warp_corot.domain import Domain


def tetrahedra_in(said: str) -> int:
    return int(said.split(" tetrahedra,")[0].split()[-1])


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off", ".glb", ".usda"])
def test_surfaces_of_every_format(folder, suffix, capsys):
    mm = suffix in (".obj", ".stl", ".usda")
    write_surface(folder / f"organ{suffix}", mm)
    unit = ["--unit", "mm"] if mm and suffix != ".usda" else []
    options = ["--tets", 1500, "--fix", "bottom", "--skin", "marched", *unit, *SHORT]
    assert simulate(f"organ{suffix}", "-o", "a.usd", *options) == 0
    out, _ = capsys.readouterr()
    assert "bounds 60 mm x 80 mm x 100 mm" in out
    assert "closed" in out
    assert "ready in" in out
    assert 0.8 * 1500 < tetrahedra_in(out) <= 1500
    stage = Usd.Stage.Open(str(folder / "a.usd"))
    assert SURFACE in prims(stage)
    first, last = drawn(stage), drawn(stage, frame=stage.GetEndTimeCode())
    assert first.is_watertight
    assert first.volume == pytest.approx(4 / 3 * np.pi * 0.03 * 0.04 * 0.05, rel=0.05)
    up = {"X": 0, "Y": 1, "Z": 2}[str(UsdGeom.GetStageUpAxis(stage))]
    assert up == (1 if suffix in (".obj", ".glb") else 2)
    heights, sunk = first.vertices[:, up], (last.vertices - first.vertices)[:, up]
    assert sunk[heights > 0].max() < 0
    lowest = heights.min() + 0.03 * np.ptp(heights)
    np.testing.assert_allclose(sunk[heights < lowest], 0.0, atol=0.1 * np.abs(sunk).max())


def test_the_level_of_detail_is_kept(folder, capsys):
    """More tetrahedra bring the surface closer: its volume approaches the ellipsoid's from below.

    The drawn surface is finer than the mesh, so it is close with few tetrahedra; the mesh's own approaches steadily.
    """
    write_surface(folder / "organ.glb", False)
    domain, errors, own = Domain.from_surface("organ.glb"), [], []
    for count in (500, 2000):
        assert simulate("organ.glb", "-o", f"{count}.usd", "--tets", count, "--skin", "marched", *SHORT) == 0
        assert 0.8 * count < tetrahedra_in(capsys.readouterr().out) <= count
        exact = trimesh.load_mesh(folder / "organ.glb").volume
        errors.append(1 - drawn(Usd.Stage.Open(str(folder / f"{count}.usd"))).volume / exact)
        mesh = wc.TetForest.from_domain(domain, target_elements=count)
        surface = replace(mesh, detail=None).surface()
        own.append(1 - trimesh.Trimesh(surface.points, surface.triangles, process=False).volume / exact)
    assert own[0] > 2.0 * own[1] > 0.0
    assert errors[0] > errors[1] > 0.0
    assert all(3.0 * drawn_off < off for drawn_off, off in zip(errors, own, strict=True))


def test_options_of_the_mesh_reach_it(folder, capsys):
    write_surface(folder / "organ.glb", False)
    assert simulate("organ.glb", "-o", "a.usd", "--level", 1, *SHORT) == 0
    said = capsys.readouterr().out
    assert "from 10 x 13 x 16 cubes" in said
    assert "levels 0 to 1\n" in said
    domain = Domain.from_surface("organ.glb")
    assert simulate("organ.glb", "-o", "a.usd", "--tets", 2000, "--min-layers", 3, *SHORT) == 0
    count = tetrahedra_in(capsys.readouterr().out)
    assert count == len(wc.TetForest.from_domain(domain, target_elements=2000, min_layers=3).tets)


@pytest.mark.parametrize(
    ("labels", "noted"),
    [
        ("soft=3kPa:0.45,hard=30kPa:0.4:1060", True),
        ("hard@7=0.03MPa:0.4:1060,soft@2=3000", False),
        pytest.param("2=3 kPa,7=30kPa:0.4:1.06e3", False, marks=pytest.mark.slow),
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
    assert {TETS, SURFACE} <= set(prims(stage))
    tets = UsdGeom.TetMesh.Get(stage, TETS)
    primvars = UsdGeom.PrimvarsAPI(tets)
    rest = np.array(primvars.GetPrimvar("rest").Get(), float)
    away = np.linalg.norm(rest[np.array(tets.GetTetVertexIndicesAttr().Get())].mean(axis=1), axis=1)
    for name, inside, outside in (("young", 3e4, 3e3), ("poisson", 0.4, 0.45), ("density", 1060, 1000)):
        values = np.array(primvars.GetPrimvar(name).Get())
        np.testing.assert_allclose(values[away < 0.013], inside)
        np.testing.assert_allclose(values[away > 0.029], outside)


def test_voxels_that_are_not_numbers_are_outside(folder, capsys):
    values = np.full((8, 8, 8), np.nan, np.float32)
    values[2:6, 2:6, 2:6] = 1.0
    image = SimpleITK.GetImageFromArray(values)  # in NIfTI files they are zeros to ITK
    image.SetSpacing((10.0, 10.0, 10.0))
    SimpleITK.WriteImage(image, str(folder / "scan.mha"))
    assert simulate("scan.mha", "-o", "a.usd", "--tets", 300, *SHORT) == 0
    out, err = capsys.readouterr()
    assert "448 voxels are not a number and count as outside" in err
    assert "64 in 1 piece" in out


def test_labels_are_drawn_and_left_out(folder, capsys):
    write_scan(folder / "scan.nii.gz")
    args = ["--tets", 3000, "--smoothing", 0.004, *SHORT]
    assert simulate("scan.nii.gz", "--labels", "soft=3kPa,hard=30kPa", "-o", "a.usd", "--draw-labels", *args) == 0
    assert {"/SoftBody/soft", "/SoftBody/hard"} <= set(prims(Usd.Stage.Open("a.usd")))
    assert simulate("scan.nii.gz", "--labels", "core@7=30kPa", "-o", "b.usd", *args) == 0
    core_alone = drawn(Usd.Stage.Open("b.usd"))
    assert core_alone.volume == pytest.approx(4 / 3 * np.pi * 0.02**3, rel=0.15)
    capsys.readouterr()
    assert simulate("scan.nii.gz", "-o", "c.usd", *args) == 0  # all labels, with one material
    assert "labels: 2, 7" in capsys.readouterr().out
    assert drawn(Usd.Stage.Open("c.usd")).volume == pytest.approx(4 / 3 * np.pi * 0.04**3, rel=0.1)


def test_unlikely_units_cause_a_warning(folder, capsys):
    trimesh.creation.icosphere(2, 2.2).export(folder / "large.glb")
    assert simulate("large.glb", "-o", "a.usd", "--tets", 300, *SHORT) == 0
    said = "note: large.glb: the body is 4.4 m long: if its coordinates are in cm, give --unit 'cm' (a factor of 0.01"
    assert said in capsys.readouterr().err


def test_compiling_is_said_once_for_mesh_and_body(folder, capsys, monkeypatch):
    """Python reports folders made in Warp's cache (PEP 578): here one before the mesh, one before the body."""

    def compiled_before(function):
        def compiled(*args, **options):
            sys.audit("os.mkdir", os.path.join(wp.config.kernel_cache_dir, "module"), 511, -1)
            return function(*args, **options)

        return compiled

    for module, name in ((bodies, "find_organ"), (command, "make_body")):
        monkeypatch.setattr(module, name, compiled_before(getattr(module, name)))
    write_surface(folder / "organ.glb", False)
    assert simulate("organ.glb", "-o", "a.usd", "--tets", 500, *SHORT) == 0
    assert capsys.readouterr().err.count("compiling kernels for cpu, once") == 1
