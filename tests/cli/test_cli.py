"""The command line: its messages and files, and that it simulates the same as the library."""

import re

import numpy as np
import pytest
from command_line import SHORT, simulate
from input_files import write_vtk
from pxr import UsdGeom
from stages import frames, opened

import warp_corot as wc
from warp_corot.cli.options import CHOICES

CUBE = wc.TetForest.box((1, 1, 1), 0.1, 3)


def test_box_simulates_the_same_as_the_library(folder, device, capsys):
    assert simulate("box", "-o", "box.usd", "--duration", 0.1, "--fps", 20, "--dt", 3e-4, "--device", device) == 0
    said = capsys.readouterr().out
    for words in ("325 nodes, 1152 tetrahedra", "steps/s", "times real time", "largest", device, "box.usd, 3 frames"):
        assert words in said

    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=6)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.49, 10.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    steps = 167  # 0.05 s in steps of at most 0.3 ms
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=0.05 / steps, damping=15.0), gravity=(0.0, -9.8, 0.0))
    stage, tets = opened(folder / "box.usd")
    assert stage.GetTimeCodesPerSecond() == 20
    recorded = frames(folder / "box.usd")
    assert len(recorded) == 3
    np.testing.assert_array_equal(recorded[0], mesh.points.astype(np.float32))
    for k in (1, 2):
        sim.advance_steps(steps)
        # On a GPU sums come in a different order each time.
        np.testing.assert_allclose(recorded[k], body.positions.numpy(), rtol=0, atol=0 if device == "cpu" else 1e-6)
    fixed = np.array(UsdGeom.PrimvarsAPI(tets).GetPrimvar("fixed").Get())
    np.testing.assert_array_equal(fixed == 1, mesh.points[:, 2] < 1e-9)


def test_options_reach_the_simulation(folder, capsys):
    args = ["--young", 700, "--poisson", 0.3, "--density", 20, "--scale", 2, "--fix", "z > zmax - 0.01"]
    assert simulate("box", "-o", "a.usda", *args, "--gravity", 0, 0, "-1e1", "--damping", 1, "--dt", 5e-4, *SHORT) == 0
    stage, tets = opened(folder / "a.usda")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    primvars = UsdGeom.PrimvarsAPI(tets)
    assert [primvars.GetPrimvar(n).Get() for n in ("young", "poisson", "density")] == pytest.approx([700, 0.3, 20])
    first, *_, last = frames(folder / "a.usda")
    assert np.ptp(first, axis=0) == pytest.approx([0.128, 0.128, 0.384])
    fixed = np.array(primvars.GetPrimvar("fixed").Get()) == 1
    np.testing.assert_array_equal(fixed, first[:, 2] > 0.384 - 0.01)
    np.testing.assert_array_equal(last[fixed], first[fixed])
    # Free fall of the far end, before the wave from the fixed end arrives there; whole steps make it 1 % more.
    t, c = 0.05, 1.0
    fall = (10.0 / c) * (t - (1.0 - np.exp(-c * t)) / c)
    assert (first - last)[first[:, 2] == 0, 2] == pytest.approx(fall, rel=0.02)
    assert "0 0 -10 m/s^2, damping 1 /s" in capsys.readouterr().out


@pytest.mark.parametrize(
    "model", [pytest.param(model, marks=pytest.mark.slow) if model == "ogden" else model for model in CHOICES]
)
def test_every_model(folder, model, capsys):
    assert simulate("box", "-o", "a.usd", "--model", model, *SHORT) == 0
    assert re.search(rf"model +{model}[,\n]", capsys.readouterr().out)


def test_rotation_level(folder, capsys):
    assert simulate("box", "-o", "a.usd", "--rotation-level", 2, *SHORT) == 0
    assert "corotated, rotations of level 2" in capsys.readouterr().out


def test_shared_dilatation_makes_a_nearly_incompressible_beam_sag_more(folder, capsys):
    sag = {}
    for dilatation in ("element", "shared"):
        args = ["--dilatation", dilatation, "--damping", 60, "--duration", 0.5, "--fps", 10]
        assert simulate("box", "-o", "a.usd", *args, "--device", "cpu") == 0
        sag[dilatation] = (frames(folder / "a.usd")[0] - frames(folder / "a.usd")[-1])[:, 1].max()
    # 1.087 by linear elasticity at rest, of float64.
    assert 1.04 < sag["shared"] / sag["element"] < 1.13
    assert "corotated, shared dilatation" in capsys.readouterr().out
    assert simulate("box", "-o", "a.usd", "--dilatation", "nodal") == 2
    assert "invalid choice: 'nodal'" in capsys.readouterr().err


def test_bear(folder, capsys):
    assert simulate("warp:bear", "-o", "bear.usd", *SHORT) == 0
    out, err = capsys.readouterr()
    assert "1986 nodes, 5354 tetrahedra" in out
    assert "note" not in err  # an asset has all values
    stage, _ = opened(folder / "bear.usd")
    first, *_, last = frames(folder / "bear.usd")
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert np.ptp(first[:, 1]) == pytest.approx(0.5542, abs=1e-4)
    assert (last - first)[:, 1].mean() < -1e-3
    feet = first[:, 1] < 0.01
    np.testing.assert_array_equal(last[feet], first[feet])


@pytest.mark.parametrize(
    "options",
    [
        # Near critical damping, so that it soon comes to rest.
        ["--damping", 20, "--duration", 1.2],
        pytest.param([], marks=pytest.mark.slow),
    ],
    ids=["damped", "as it comes"],
)
def test_bear_sags_by_a_tenth_and_comes_to_rest(folder, capsys, options):
    assert simulate("warp:bear", "-o", "bear.usd", "--device", "cpu", *options) == 0
    told = "the last frame shows 1.208 s, not 1.2 s, since frames come every 0.0417 s; with --fps 25 it ends there"
    assert (told in capsys.readouterr().err) == bool(options)
    first, *_, last = frames(folder / "bear.usd")
    height = np.ptp(first[:, 1])
    back = first[:, 1] > first[:, 1].max() - 1e-6
    assert 0.05 < (first - last)[back, 1].mean() / height < 0.15
    assert 0.05 < np.linalg.norm(last - first, axis=1).max() / height < 0.15
    stage, tets = opened(folder / "bear.usd")
    speeds = [np.linalg.norm(tets.GetVelocitiesAttr().Get(k), axis=1).max() for k in (6, stage.GetEndTimeCode())]
    assert speeds[1] < 0.02 * speeds[0]


@pytest.mark.parametrize(
    ("size", "said"),
    [
        (5e-4, "taken as m, .* 0.5 mm long, which is unlikely"),
        (2.9, "taken as m, .* 2.9 m long .--unit"),
        (4.4, "taken as cm, .* 44 mm"),
        (49, "taken as mm, .* 49 mm"),
        (50, "taken as mm, .* 50 mm"),
        (5000, "taken as mm, .* 5 m long, which is unlikely"),
    ],
)
def test_a_unit_that_no_file_names_is_the_likeliest_and_said_first(size, said, folder, capsys):
    write_vtk(folder / "cube.vtk", size / np.ptp(CUBE.points) * CUBE.points, CUBE.tets)
    for options in ([], ["--unit", "m"], ["--scale", "1"]):
        assert simulate("cube.vtk", "-o", "a.usd", *SHORT, *options) == 0
        first = capsys.readouterr().err.splitlines()[0]
        assert bool(re.search(f"cube.vtk: names no unit: its {size:.4g} units are {said}", first)) == (not options)
        assert ("unit" in first) == (not options)


def test_any_mesh_needs_no_options(folder, capsys):
    """A mesh in millimetres with some wrongly wound tetrahedra and a stray node is reported and simulated."""
    tets = CUBE.tets.copy()
    points = np.concatenate([CUBE.points, [[9.0, 9.0, -9.0]]])
    write_vtk(folder / "cube.vtk", 1e3 * points, tets)
    assert simulate("cube.vtk", "-o", "a.usd", *SHORT) == 0
    out, err = capsys.readouterr()
    assert err.startswith(
        "warp-corot: note: cube.vtk: names no unit: its 100 units are taken as mm, so that it is 100 mm"
    )
    assert simulate("cube.vtk", "-o", "a.usd", "--scale", 0.001, *SHORT) == 0
    out, err = capsys.readouterr()
    repaired = int((np.linalg.det(points[tets[:, 1:]] - points[tets[:, :1]]) < 0).sum())
    assert repaired > 0
    assert f"{repaired} wound wrongly and repaired, 1 nodes in no tetrahedron" in out
    assert "the body stands on its lowest 10 %" in err
    assert "Young's modulus is" in err
    assert "unit" not in err
    first, *_, last = frames(folder / "a.usd")
    bottom = np.append(CUBE.points[:, 2] == 0, False)  # meshio's formats have no up axis: Z
    np.testing.assert_array_equal(last[bottom], first[bottom])
    assert (last - first)[:-1][~bottom[:-1], 2].max() < 0
    np.testing.assert_array_equal(last[-1], first[-1])


@pytest.mark.parametrize("scale", [1e-3, 50.0])
def test_default_stiffness_suits_every_size(folder, scale, capsys):
    """Bodies of one shape sag by the same fraction of their height at any size."""
    write_vtk(folder / "cube.vtk", CUBE.points, CUBE.tets)
    duration = 0.6 * scale**0.5  # time scales with the root of the size
    args = ["--duration", duration, "--fps", 1 / duration, "--damping", 30 / scale**0.5]
    assert simulate("cube.vtk", "-o", "a.usd", "--scale", scale, "--device", "cpu", *args) == 0
    first, *_, last = frames(folder / "a.usd")
    share = (first - last)[:, 2].max() / np.ptp(first[:, 2])
    # 0.5 rho g H^2 / E is 1/40 of the height for a column free at its sides.
    assert 0.012 < share < 0.035
