"""Explicit or implicit steps, if the user does not say which."""

from types import SimpleNamespace

import meshio
import numpy as np
import pytest
from command_line import simulate

import warp_corot as wc
from warp_corot.cli.run_setup import _stable_step


def steps_of(capsys, *options):
    assert simulate("box", "--device", "cpu", "--duration", "0.05", *options) == 0
    out, err = capsys.readouterr()
    return "backward-euler" in out, "--integrator symplectic-euler" in err


def test_stiff_bodies_take_implicit_steps_and_say_why(tmp_path, capsys):
    path = ["-o", tmp_path / "box.usd"]
    assert steps_of(capsys, *path, "--young", "30MPa") == (True, True)
    assert steps_of(capsys, *path) == (False, False)


def test_steps_that_would_be_unstable_are_implicit(tmp_path, capsys):
    path = ["-o", tmp_path / "box.usd"]
    assert steps_of(capsys, *path, "--young", "30kPa", "--dt", "16ms") == (True, True)
    assert steps_of(capsys, *path, "--young", "10Pa", "--dt", "4ms") == (False, False)
    assert steps_of(capsys, *path, "--young", "30kPa", "--dt", "16ms", "--self-contact") == (True, True)


def test_tetrahedra_of_a_file_take_implicit_steps_if_explicit_ones_are_unstable(tmp_path, capsys):
    mesh = wc.TetForest.box((1, 1, 2), 0.1, 3)
    meshio.write(tmp_path / "bar.vtk", meshio.Mesh(mesh.points, {"tetra": mesh.tets}))
    given = [tmp_path / "bar.vtk", "--young", "30kPa", "--device", "cpu", "--duration", "0.1", "-o", tmp_path / "a.usd"]
    assert simulate(*given, "--dt", "20ms") == 0
    assert "backward-euler" in capsys.readouterr().out
    assert simulate(*given) == 0
    assert "backward-euler" not in capsys.readouterr().out


@pytest.mark.parametrize(
    "given", [["--integrator", "symplectic-euler"], ["--dt", "2us"], ["--viscosity", "1us"], ["--self-contact"]]
)
def test_users_choose(tmp_path, capsys, given):
    path = ["-o", tmp_path / "box.usd", "--fps", "100"]
    assert steps_of(capsys, *path, "--duration", "0.01", "--young", "3MPa", *given) == (False, False)


@pytest.mark.parametrize("poisson", [0.3, 0.44])
def test_the_estimate_of_the_stable_step(device, poisson):
    """Where elements are of several sizes, and some stiffer than others."""
    mesh = wc.TetForest.box((2, 1, 1), 0.05, 4)
    mesh.refine(np.flatnonzero(mesh.points[mesh.tets].mean(axis=1)[:, 0] < 0.03))
    young = np.where(mesh.points[mesh.tets].mean(axis=1)[:, 2] < 0.02, 2e4, 5e3)
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), device=device)
    assert _stable_step(SimpleNamespace(soft=body)) == pytest.approx(wc.Simulation(body).stable_dt, rel=0.25)
