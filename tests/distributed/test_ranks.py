"""The same run on 1, 2 and 3 ranks; the slow form on 7, too, and in all cases: contact of bodies, multigrid, …"""

import fcntl
import os
from pathlib import Path

import numpy as np
import pytest
import ranked
from mpirun import needs_mpi, on_ranks

import warp_corot as wc

SIZES = (1, 2, 3)
#: Leaves of several levels, worlds with viscosity, contact of a block and of an organ, and implicit steps of a general
#: mesh with viscosity.
CASES = ("forest", "worlds", "touched", "organ", "newmark")
#: On two ranks there is one case.
SHORT = {2: "forest"}

pytestmark = needs_mpi


def made_on(count, folder, cases):
    """The results of this number of ranks; three ranks make those of one and two ranks, too. Workers that need the same
    wait for the first."""
    found = {}
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / f"{count}.npz").exists():
            done = on_ranks(count, str(Path(ranked.__file__)), str(folder), ",".join(cases), timeout=1200.0)
            assert done.returncode == 0, done.stderr
    for size in SIZES if count == 3 else (count,):
        with np.load(folder / f"{size}.npz") as archive:
            found[size] = dict(archive)
    found["folder"] = folder
    return found


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    shared = tmp_path_factory.getbasetemp()
    folder = (shared.parent if "PYTEST_XDIST_WORKER" in os.environ else shared) / "ranks"
    folder.mkdir(exist_ok=True)
    return made_on(3, folder, CASES)


def sizes_of(case):
    """The numbers of ranks above one that have made a case."""
    return [size for size in SIZES[1:] if case in SHORT.get(size, CASES)]


@pytest.mark.parametrize("case", CASES)
def test_a_deterministic_run_is_the_same_bit_by_bit(runs, case):
    for size in sizes_of(case):
        for what in ("x", "v", "numbers", *(["wrench1"] if case in ranked.TOUCHING else [])):
            np.testing.assert_array_equal(runs[size][f"{case}.True.{what}"], runs[1][f"{case}.True.{what}"])


@pytest.mark.slow
def test_all_cases_are_the_same_on_seven_ranks(tmp_path):
    found = made_on(3, tmp_path, ranked.CASES) | made_on(7, tmp_path, ranked.CASES)
    for case in ranked.CASES:
        for size in (3, 7):
            np.testing.assert_array_equal(found[size][f"{case}.True.x"], found[1][f"{case}.True.x"])
            if f"{case}.{size}.x" in found[size]:
                np.testing.assert_array_equal(found[size][f"{case}.{size}.x"], found[1][f"{case}.True.saved.x"])
        assert_as_one_process(case, found[7])
    np.testing.assert_array_equal(found[7]["parts.x"], found[1]["worlds.True.x"])


@pytest.mark.slow
def test_three_ranks_go_on_from_checkpoints_of_four(tmp_path):
    made_on(4, tmp_path, ("touched", "worlds"))
    found = made_on(3, tmp_path, ("touched", "worlds"))
    for name, case in (("touched", "touched"), ("parts", "worlds")):
        for what in ("x", "numbers"):
            np.testing.assert_array_equal(found[3][f"{name}.4.{what}"], found[1][f"{case}.True.saved.{what}"])


@pytest.mark.slow
def test_ranks_keep_record_and_reset_bodies_that_are_remeshed(tmp_path):
    found = made_on(3, tmp_path, ranked.REMESHED)
    for case in ranked.REMESHED:
        alone = {name: found[1][f"{case}.True.{name}"] for name in ("saved.x", "saved.numbers", "frames", "again.x")}
        assert alone["frames"][0] == len(ranked.bodies_of(case)[0].mesh.tets)
        assert len(set(alone["frames"])) > 1
        for name, values in alone.items():
            np.testing.assert_array_equal(found[3][f"{case}.True.{name}"], values)
        for size in (1, 3):
            for what in ("x", "numbers"):
                np.testing.assert_array_equal(found[3][f"{case}.{size}.{what}"], alone[f"saved.{what}"])
        assert_pieces_are_closed(tmp_path / f"{case}.3.usda", alone["frames"])
        assert_as_one_process(case, found[3])
        one = wc.Simulation.load(tmp_path / f"{case}.3.npz")
        one.advance(0.01)
        assert one.steps == alone["saved.numbers"][0]
        assert one.body.positions.numpy().shape == alone["saved.x"].shape
        if case == "stretched":
            np.testing.assert_allclose(one.body.positions.numpy(), alone["saved.x"], atol=1e-6)


def assert_pieces_are_closed(path, counts):
    """The surfaces of all pieces together enclose their tetrahedra in every frame."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.GetTypeName() == "Mesh"]
    for frame, count in enumerate(counts):
        elements, volume, enclosed = 0, 0.0, 0.0
        for mesh in meshes:
            solid = UsdGeom.TetMesh(stage.GetPrimAtPath(mesh.GetPath().GetParentPath().AppendChild("tetrahedra")))
            x = np.array(solid.GetPointsAttr().Get(frame), np.float64)
            a, b, c, d = np.moveaxis(x[np.array(solid.GetTetVertexIndicesAttr().Get(frame))], 1, 0)
            elements += len(a)
            volume += np.einsum("nk,nk->", np.cross(b - a, c - a), d - a) / 6.0
            x = np.array(mesh.GetPointsAttr().Get(frame), np.float64)
            a, b, c = np.moveaxis(x[np.array(mesh.GetFaceVertexIndicesAttr().Get(frame)).reshape(-1, 3)], 1, 0)
            enclosed += np.einsum("nk,nk->", np.cross(a, b), c) / 6.0
        assert elements == count
        np.testing.assert_allclose(enclosed, volume, rtol=1e-5)


def test_a_mesh_that_no_rank_holds_whole_gives_the_same_run(runs):
    np.testing.assert_array_equal(runs[3]["parts.x"], runs[1]["worlds.True.x"])
    np.testing.assert_array_equal(runs[3]["parts.touched.x"], runs[1]["touched.True.x"])
    np.testing.assert_array_equal(runs[3]["divided.x"], runs[1]["forest.True.x"])
    np.testing.assert_array_equal(runs[3]["loaded.newmark.x"], runs[1]["newmark.True.x"])


def test_ranks_write_pieces_of_one_stage(runs):
    from pxr import Usd, UsdGeom

    folder, size = runs["folder"], 3
    stage = Usd.Stage.Open(str(folder / f"{size}.usda"))
    assert stage.GetEndTimeCode() == 3.0
    meshes = [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.GetTypeName() == "Mesh"]
    assert len(meshes) == size
    area, tets, shown = 0.0, 0, []
    for mesh in meshes:
        x = np.array(mesh.GetPointsAttr().Get(0.0))[np.array(mesh.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)]
        area += 0.5 * np.linalg.norm(np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0]), axis=1).sum()
        shown.append(np.array(mesh.GetPointsAttr().Get(3.0)))
        tetrahedra = UsdGeom.TetMesh(stage.GetPrimAtPath(mesh.GetPath().GetParentPath().AppendChild("tetrahedra")))
        tets += len(tetrahedra.GetTetVertexIndicesAttr().Get())
    # The surface is closed, and ranks draw no faces between them.
    np.testing.assert_allclose(area, 14 * 0.064**2, rtol=1e-6)
    assert tets == 3 * 6 * 2**4
    there = np.concatenate([np.load(folder / f"{size}.{rank}.npy") for rank in range(size)])
    apart = np.abs(np.concatenate(shown)[:, None] - there).max(axis=2).min(axis=1)
    assert apart.max() < 1e-7
    assert f"rank {size - 1} of {size}" in str(runs[size]["recorded"])


def test_rank_0_draws_obstacles(runs):
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(runs["folder"] / "touches.3.usda"))
    tool = stage.GetPrimAtPath("/SoftBody/rank_0000/obstacles/tool_1")
    heights = [UsdGeom.Xformable(tool).ComputeLocalToWorldTransform(k).ExtractTranslation()[1] for k in (0.0, 1.0)]
    # It comes down from 0.047 m at 0.02 s to 0.034 m at 0.05 s; frames are at 0.04 s and 0.044 s.
    np.testing.assert_allclose(heights, [0.034 + 0.013 / 3.0, 0.034 + 0.013 / 5.0], atol=1e-6)
    assert not stage.GetPrimAtPath("/SoftBody/rank_0001/obstacles")


def test_any_run_is_the_same_to_rounding(runs):
    """Runs differ only by rounding and by the steps that rounding changes; the beams have moved by some centimetres."""
    np.testing.assert_allclose(runs[3]["forest.False.x"], runs[1]["forest.True.x"], atol=1e-5)
    energies = [runs[size][f"forest.{kind}.energy"] for size, kind in ((3, "False"), (1, "True"))]
    np.testing.assert_allclose(*energies, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("case", CASES)
def test_energies_are_those_of_all_ranks(runs, case):
    for size in sizes_of(case):
        np.testing.assert_allclose(runs[size][f"{case}.True.energy"], runs[1][f"{case}.True.energy"], rtol=1e-12)


def assert_as_one_process(case, found):
    bodies, options = ranked.bodies_of(case), ranked.options_of(case)
    sim = wc.Simulation(bodies, **options | {"model": options["model"] or wc.Corotated()})
    ranked.moved(sim, bodies[0])
    if case in ranked.TOUCHING:
        assert np.abs(found[f"{case}.True.wrench1"]).max() > 0.01
    if case in ("multigrid", "newton"):
        assert sim.solves is not None
        assert abs(found[f"{case}.True.iterations"] - np.array(sim.solves)).max() <= 1
    elif case == "pressed":
        assert sim.solves is not None
        assert found[f"{case}.True.iterations"][2] <= 1.1 * sim.solves.linear_iterations
    moved = max(np.abs(body.displacements.numpy()).max() for body in bodies)
    assert moved > 0.005
    everywhere = np.concatenate([body.positions.numpy() for body in bodies])
    if case in ranked.REMESHED:
        assert found[f"{case}.True.elements"] != len(ranked.bodies_of(case)[0].mesh.tets)
    if case in ranked.REMESHED:
        assert found[f"{case}.True.elements"] == bodies[0].element_count
    np.testing.assert_allclose(found[f"{case}.True.x"], everywhere, atol=2e-3 * moved)


@pytest.mark.parametrize("case", CASES)
def test_ranks_do_what_one_process_does(runs, case):
    assert_as_one_process(case, runs[3])


def test_costs_of_all_ranks_are_measured(runs):
    for size in SIZES:
        costs = runs[size]["forest.True.costs"]
        assert len(costs) == size
        assert (costs > 0.0).all()


@pytest.mark.parametrize(("case", "size"), [("forest", 1), ("touched", 3), ("organ", 3)])
def test_a_checkpoint_goes_on_with_any_number_of_ranks(runs, case, size):
    """Three ranks go on from their own, and from that of one process."""
    for what in ("x", "numbers"):
        resumed = runs[3][f"{case}.{size}.{what}"]
        np.testing.assert_array_equal(resumed, runs[1][f"{case}.True.saved.{what}"])


@pytest.mark.parametrize("size", [1, 3])
def test_a_checkpoint_in_parts_goes_on_with_any_number_of_ranks(runs, size):
    for what in ("x", "numbers"):
        np.testing.assert_array_equal(runs[3][f"parts.{size}.{what}"], runs[1][f"worlds.True.saved.{what}"])


def test_a_checkpoint_of_a_body_in_parts_goes_on(runs):
    """Of divided meshes, and with contact."""
    for name, case in (("divided", "forest"), ("general", "newmark"), ("touches", "touched")):
        for what in ("x", "numbers"):
            np.testing.assert_array_equal(runs[3][f"{name}.3.{what}"], runs[1][f"{case}.True.saved.{what}"])


def test_one_process_goes_on_from_a_checkpoint_of_a_body_in_parts(runs):
    for name, case in (("parts", "worlds"), ("divided", "forest"), ("touches", "touched")):
        one = wc.Simulation.load(runs["folder"] / f"{name}.3.npz")
        one.advance(ranked.after(name))
        x = runs[1][f"{case}.True.saved.x"]
        moved = np.abs(runs[1][f"{case}.True.v"]).max() * 0.05
        np.testing.assert_allclose(one.body.positions.numpy(), x, atol=2e-3 * moved)
