"""``warp-corot simulate --remesh``: its messages, its files and its errors."""

import os
import re

import numpy as np
import pytest
import trimesh
from command_line import SHORT, assert_refused, simulate, table
from input_files import write_vtk
from pxr import UsdGeom
from stages import assert_whole, opened

import warp_corot as wc

BENT = ["--remesh", "--refine-above", 1.03, "--simplify-below", 1.01, "--device", "cpu"]


def counts(out):
    found = re.search(r"remeshing +(\d+) tetrahedra in the first frame, (\d+) at most, (\d+) in the last", out)
    return [int(number) for number in found.groups()]


def test_the_mesh_follows_the_motion(folder, capsys):
    assert simulate("box", "-o", "a.usd", *BENT, "--duration", 0.2, "--fps", 10, "--preview", "a.png") == 0
    out, err = capsys.readouterr()
    assert "warning" not in err
    first, most, last = counts(out)
    assert first == 1152 < last <= most
    assert "every 10 steps, above 1.03, below 1.01, levels that of the start to 9" in out
    assert "(at the end)" in out
    stage, _ = opened(folder / "a.usd")
    assert stage.GetEndTimeCode() == 2
    for k, count in ((0, first), (2, last)):
        _, _, indices = assert_whole(stage, k, 3 * 0.064**3)
        assert len(indices) == count
    assert (folder / "a.png").read_bytes().startswith(b"\x89PNG")


def test_it_simulates_the_same_as_the_library(folder):
    options = ["--remesh-levels", 5, 8, "--remesh-every", 7, "--capacity", 3000]
    assert simulate("box", "-o", "a.usd", *BENT, *options, "--duration", 0.1, "--fps", 20) == 0
    mesh = wc.TetForest.box(cells=(1, 1, 3), cell_size=0.064, level=6)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.49, 10.0), device="cpu")
    body.fix(mesh.points[:, 2] < 1e-9)
    remesh = wc.OnlineRemesh(refine_above=1.03, simplify_below=1.01, min_level=5, max_level=8, every=7, capacity=3000)
    sim = wc.Simulation(body, integrator=wc.SymplecticEuler(damping=15.0), gravity=(0.0, -9.8, 0.0), remesh=remesh)
    sim.advance_until(0.05)
    sim.advance_until(0.1)
    assert body.element_count != 1152
    _, tets = opened(folder / "a.usd")
    np.testing.assert_array_equal(tets.GetPointsAttr().Get(2), body.positions.numpy())


def test_a_given_step_stays(folder, capsys):
    assert simulate("box", "-o", "a.usd", *BENT, "--dt", 1e-4, "--duration", 0.1, "--fps", 10) == 0
    assert re.search(r"time step +0\.1 ms", capsys.readouterr().out)


def test_a_pressure_stays_the_same_while_the_mesh_changes(folder, capsys):
    """Pressure on one side of the free half: the reactions are pressure times area, and the beam bends to that side."""
    still = ["--gravity", 0, 0, 0, "--device", "cpu"]
    follows = [
        "--remesh",
        "--refine-above",
        1.03,
        "--simplify-below",
        1.01,
        "--remesh-levels",
        3,
        8,
        "--remesh-every",
        40,
    ]
    press = ["--press", "y > ymax - 1e-6 and z > 0.09", 10.0, "--ramp", 0.3, "--damping", 15, "--duration", 0.9]
    probes = ["--probe", "z < zmin + 1e-6", "--probe", "z > zmax - 1e-6", "--fps", 10]
    assert simulate("box", "-o", "a.usd", *still, *follows, *press, *probes, "--csv", "a.csv") == 0
    first, most, _ = counts(capsys.readouterr().out)
    assert most > 1.3 * first
    columns = table(folder / "a.csv")
    area = 0.064 * 0.096
    assert columns["z < zmin + 1e-6 reaction y [N]"][-1] == pytest.approx(10.0 * area, rel=0.02)
    assert columns["z > zmax - 1e-6 uy [m]"][-1] < -0.01
    # The probe of the free end is the mean over its current nodes.
    _, tets = opened(folder / "a.usd")
    rest = np.array(UsdGeom.PrimvarsAPI(tets).GetPrimvar("rest").Get(9))
    end = rest[:, 2] > 0.192 - 1e-6
    moved = (np.array(tets.GetPointsAttr().Get(9)) - rest)[end, 1]
    assert columns["z > zmax - 1e-6 uy [m]"][-1] == pytest.approx(moved.mean(), rel=0.03)
    # The same pressure bends a mesh without remeshing about as far.
    assert simulate("box", "-o", "b.usd", *still, *press, *probes, "--csv", "b.csv") == 0
    stays = table(folder / "b.csv")["z > zmax - 1e-6 uy [m]"][-1]
    assert columns["z > zmax - 1e-6 uy [m]"][-1] == pytest.approx(stays, rel=0.1)


def test_a_body_stays_near_the_number_of_elements_that_was_asked_for(folder, capsys):
    trimesh.creation.capsule(0.1, 0.03).export(folder / "organ.stl")
    asked = ["--unit", "m", "--tets", 1000, "--remesh", "--duration", 0.1, "--fps", 10, "--device", "cpu"]
    assert simulate("organ.stl", "-o", "a.usd", *asked) == 0
    first, most, last = counts(capsys.readouterr().out)
    assert 900 <= first <= last <= most <= 1100
    assert simulate("organ.stl", "-o", "b.usd", *asked, "--remesh-levels", 0, 9) == 0
    first, _, last = counts(capsys.readouterr().out)
    assert last < 0.8 * first


def test_the_given_surface_is_drawn(folder, capsys):
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.05, max_level=3)
    surface = mesh.surface()
    trimesh.Trimesh(surface.points, surface.triangles).export(folder / "ball.stl")
    options = ["--unit", "m", "--tets", 500, "--duration", 0.1, "--fps", 20, "--young", 800]
    assert simulate("ball.stl", "-o", "a.usd", *BENT, *options, "--preview", "a.png") == 0
    first, most, last = counts(capsys.readouterr().out)
    assert most > first or last < first
    stage, _ = opened(folder / "a.usd")
    drawn = UsdGeom.Mesh.Get(stage, "/SoftBody/surface")
    assert drawn.GetPrim().GetDisplayName() == "ball"
    assert len(drawn.GetFaceVertexCountsAttr().Get()) == len(surface.triangles)
    assert drawn.GetFaceVertexIndicesAttr().GetTimeSamples() == []
    assert len(drawn.GetPointsAttr().Get(2)) == len(drawn.GetPointsAttr().Get(0))


@pytest.mark.parametrize(
    ("args", "said"),
    [
        (["warp:bear", "--remesh"], "--remesh is for box, surfaces and scans"),
        (["good.vtk", "--remesh"], "good.vtk has its own tetrahedra"),
        (["missing.vtk", "--remesh"], "missing.vtk: no such file"),
        (["box", "--refine-above", 1.1], "--refine-above is for --remesh"),
        (["box", "--remesh-levels", 1, 2], "--remesh-levels is for --remesh"),
        (
            ["box", "--remesh", "--refine-above", 1.0],
            "--simplify-below is 1.08; it must be below --refine-above, which is 1,",
        ),
        (["box", "--remesh", "--refine-above", "nan"], "--refine-above is nan; it must be a finite number"),
        (
            ["box", "--remesh", "--remesh-levels", 5, 4],
            "--remesh-levels MIN is 5; it must be at most --remesh-levels MAX, which is 4",
        ),
        (
            ["box", "--remesh", "--remesh-levels", 5, 49],
            "--remesh-levels MAX is 49; it must be a whole number from 0 to 48",
        ),
        (["box", "--remesh", "--remesh-levels", 5], "expected 2 arguments"),
        (["box", "--remesh", "--remesh-every", 0], "--remesh-every is 0; it must be a whole number, at least 1"),
        (["box", "--remesh", "--capacity", 0], "--capacity is 0; it must be a whole number, at least 1"),
        (
            ["box", "--remesh", "--capacity", 10],
            "--capacity is 10; it must be at least 1152, as many elements as the mesh has",
        ),
        (["box", "--remesh", "--model", "mass-spring"], "MassSpring"),
    ],
)
def test_what_is_refused(folder, capsys, args, said):
    write_vtk(folder / "good.vtk", np.eye(4, 3, k=-1) * 0.1, [[0, 1, 2, 3]])
    assert_refused(folder, capsys, said, *args, "-o", "out.usd", *SHORT)
    assert "out.usd" not in os.listdir(folder)
