"""``mpirun -n 2 warp-corot simulate``, and ranks that end early."""

import csv
from pathlib import Path

import numpy as np
import pytest
from command_line import simulate
from grown_parts import layers
from mpirun import needs_mpi, on_ranks

pytestmark = needs_mpi

FAULTY = Path(__file__).parents[1] / "support" / "faulty.py"
BEAM = ("box", "--level", "3", "--duration", "0.1", "--probe", "z == zmax", "--device", "cpu")


def last_row(path):
    with open(path, newline="") as file:
        return np.array(list(csv.reader(file))[-1], float)


def counts_of(name):
    """The numbers of tetrahedra of a stage's meshes, and its last frame."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(name)
    tets = [UsdGeom.TetMesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.TetMesh)]
    return [len(each.GetTetVertexIndicesAttr().Get()) for each in tets], stage.GetEndTimeCode()


def assert_as_alone(words, said="", columns=None, **tolerances):
    """Two ranks have the summary, the table, whose first columns are compared, and the stage of one process."""
    on_two = on_ranks(2, "-m", "warp_corot", "simulate", *words, "--csv", "two.csv", "-o", "two.usda")
    assert on_two.returncode == 0, on_two.stderr
    assert "2 ranks" in on_two.stdout
    assert said in on_two.stdout
    assert simulate(*words, "--csv", "one.csv", "-o", "one.usda") == 0
    with open("one.csv", newline="") as a, open("two.csv", newline="") as b:
        assert next(csv.reader(a)) == next(csv.reader(b))
    assert counts_of("two.usda") == counts_of("one.usda")
    np.testing.assert_allclose(last_row("two.csv")[:columns], last_row("one.csv")[:columns], **tolerances)


@pytest.mark.slow
def test_two_ranks_do_what_one_process_does(folder):
    # Places, times and lengths of steps; the beam bends by centimetres.
    assert_as_alone(BEAM, "time step", rtol=0.02, atol=1e-4)


@pytest.mark.slow
def test_two_ranks_mesh_a_surface(folder):
    bunny = ("warp:bunny", "--level", "2", "--fix", "y < 0.06", "--young", "8kPa", "--dt", "0.4ms", "--duration", "0.1")
    # The bunny's ears sink by centimetres.
    assert_as_alone((*bunny, "--probe", "y > 0.15", "--device", "cpu", "--draw-tets"), "bunny", rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_two_ranks_mesh_a_scan_of_several_materials(folder):
    import nibabel

    domain = layers()
    nibabel.save(nibabel.Nifti1Image(domain.numbers, np.diag([10.0, 10.0, 10.0, 1.0])), "scan.nii.gz")
    scan = ("scan.nii.gz", "--labels", "top@1=3kPa:0.45,bottom@2=8kPa,layer@3=10kPa:0.4,tip@4=1kPa", "--dt", "0.4ms")
    scan += ("--fix", "x < 0.06", "--duration", "0.05", "--fps", "40", "--probe", "x > 0.2", "--device", "cpu")
    # The end has sunk by millimetres.
    assert_as_alone((*scan, "--level", "2"), "bottom: E = 8 kPa, nu = 0.45", rtol=1e-4, atol=1e-6)


@pytest.mark.slow
def test_two_ranks_press_a_body_that_begins_at_rest(folder):
    """The pressure changes with time, and every rank finds the state of rest."""
    bear = ("warp:bear", "--press", "top", "300", "--ramp", "0.05", "--probe", "top", "--device", "cpu")
    # The bear's top sinks by 3 cm. Both runs choose their own steps.
    assert_as_alone((*bear, "--duration", "0.1"), columns=4, rtol=1e-3, atol=1e-5)
    assert_as_alone((*bear, "--static", "--duration", "0.05"), "at rest after", columns=4, rtol=1e-3, atol=1e-5)
    wrong = on_ranks(2, "-m", "warp_corot", "simulate", *bear, "--fix", "nonsense", "-o", "out.usda", timeout=120.0)
    assert wrong.returncode != 0
    assert sum(line.startswith("warp-corot: error:") for line in wrong.stderr.splitlines()) == 1


@pytest.mark.slow
def test_two_ranks_draw_the_contact_of_the_whole_body(folder):
    from pxr import Usd, UsdGeom

    box = ("box", "--level", "3", "--ground", "--duration", "0.05", "--device", "cpu")
    done = on_ranks(2, "-m", "warp_corot", "simulate", *box, "-o", "two.usda")
    assert done.returncode == 0, done.stderr
    assert simulate(*box, "-o", "one.usda") == 0
    found = []
    for name in ("one.usda", "two.usda"):
        stage = Usd.Stage.Open(name)
        mesh = stage.GetPrimAtPath("/SoftBody/tetrahedra")
        found.append(np.array(UsdGeom.PrimvarsAPI(mesh).GetPrimvar("contactForce").Get(1.0)))
    assert found[0][:, 1].sum() > 0.01
    # Both runs choose their own steps, and the body has just landed.
    np.testing.assert_allclose(found[1][:, 1].sum(), found[0][:, 1].sum(), rtol=0.2)


@pytest.mark.slow
def test_two_ranks_remesh_as_one_process_does(folder):
    bar = ("box", "--level", "5", "--remesh", "--refine-above", "1.03", "--simplify-below", "1.01", "--dt", "0.2ms")
    bar += ("--duration", "0.09", "--probe", "z == zmax", "--device", "cpu")
    done = on_ranks(2, "-m", "warp_corot", "simulate", *bar, "--csv", "two.csv", "-o", "two.usda")
    assert done.returncode == 0, done.stderr
    assert "652 in the last" in done.stdout
    assert simulate(*bar, "--csv", "one.csv", "-o", "one.usda") == 0
    # The bar's end has moved by centimetres.
    np.testing.assert_allclose(last_row("two.csv")[1:4], last_row("one.csv")[1:4], atol=1e-6)


@pytest.mark.slow
def test_what_does_not_work_is_refused_in_one_line(folder):
    done = on_ranks(2, "-m", "warp_corot", "simulate", "box", "--level", "3", "--model", "edge-stvk", "-o", "out.usda")
    assert done.returncode != 0
    said = [line for line in done.stderr.splitlines() if line.startswith("warp-corot: error:")]
    assert len(said) == 1
    assert "does not work on several ranks yet" in said[0]


@pytest.mark.slow
def test_help_and_errors_wait_for_no_rank(folder):
    """Rank 0 ends all as soon as it has reported, and no rank waits after the help."""
    for words, status, said in ((("--version",), 0, ""), (("simulate", "no.stl", "-o", "a.usd"), 2, "no such file")):
        done = on_ranks(2, "-m", "warp_corot", *words, timeout=60.0)
        assert done.returncode == status
        assert said in done.stderr
        # MPI's own end waits for ranks, which then disagree.
        assert "PMIX ERROR" not in done.stderr


@pytest.mark.parametrize("how", ["failed", *(pytest.param(how, marks=pytest.mark.slow) for how in ("killed", "hung"))])
def test_a_rank_that_ends_takes_the_others_along(how, monkeypatch):
    if how == "hung":
        monkeypatch.setenv("WARP_COROT_PATIENCE", "5")
    done = on_ranks(2, str(FAULTY), how, timeout=120.0)
    assert done.returncode != 0
    if how == "failed":
        said = [line for line in done.stderr.splitlines() if line.startswith("warp-corot:")]
        assert said == ["warp-corot: rank 1 of 2 ends all others: ValueError: rank 1 has had enough"]
    if how == "killed":
        said = [line for line in done.stderr.splitlines() if line.startswith("warp-corot:")]
        assert said == ["warp-corot: rank 1 of 2 was killed, which ends all others"]
    if how == "hung":
        assert "rank 0 of 2 has waited 5 s for others (an exchange), and ends all" in done.stderr
