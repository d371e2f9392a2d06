"""Static answers that begin at the answer on a coarser mesh of the same forest."""

import numpy as np
import pytest
from cases import CUBE

import warp_corot as wc
from warp_corot.mesh.coarser import coarser
from warp_corot.solvers.implicit import static
from warp_corot.solvers.implicit.static import StaticSolver

GRAVITY = (0.0, -9.8, 0.0)
PLAIN = wc.Corotated(dilatation="element")


def box(level=6):
    return wc.TetForest.box((1, 1, 3), CUBE, level)


def graded():
    """Three levels deeper at the clamped end."""
    mesh = box(3)
    for _ in range(3):
        mesh = mesh.refine(mesh.points[mesh.tets].mean(axis=1)[:, 2] < 0.05)
    return mesh


def clamped(mesh, young=50e3, worlds=1):
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 1000.0), worlds=worlds, device="cpu")
    body.fix("z < 1e-9")
    return body


def layered():
    """Stiffness that changes from element to element, a function of the place."""
    return clamped(box(), lambda points: np.where(points[:, 0] < 0.5 * CUBE, 20e3, 80e3))


def two_worlds():
    """Two copies with other materials and loads on a selection."""
    body = clamped(box(), [[40e3], [60e3]], worlds=2)
    body.load("z > 0.191", (0.0, 2e-3, 1e-3), worlds=1)
    return body


def pulled():
    """Both ends held, one of them twisted and pulled away."""
    body = clamped(box())
    end = body.mesh.points[:, 2] > 0.191
    body.fix(end)
    u = np.zeros((body.node_count, 3))
    x = body.mesh.points[end]
    u[end] = np.column_stack([0.3 * (x[:, 1] - 0.032), -0.3 * (x[:, 0] - 0.032), np.full(len(x), 0.03)])
    body.displacements = u
    return body


def answer(monkeypatch, make, fewest, model=PLAIN):
    """The report, the displacements, and the starts that were found."""
    starts = []

    def spied(*arguments):
        starts.append(static.nested_start(*arguments))
        return starts[-1]

    monkeypatch.setattr(static, "FEWEST_NESTED", fewest)
    monkeypatch.setattr("warp_corot.simulation.static.nested_start", spied)
    body = make()
    report = wc.solve_static(body, model=model, gravity=GRAVITY)
    assert report.converged
    return report, body.displacements.numpy().astype(float), starts


@pytest.mark.parametrize(
    ("make", "model"),
    [
        (lambda: clamped(box()), PLAIN),
        (lambda: clamped(box()), wc.NeoHookean(dilatation="shared")),
        (lambda: clamped(graded()), PLAIN),
        (layered, PLAIN),
        (two_worlds, PLAIN),
        (pulled, PLAIN),
    ],
    ids=["beam", "shared", "graded", "layered", "worlds", "pulled"],
)
def test_same_answer_in_fewer_iterations(make, model, monkeypatch):
    slow, right, starts = answer(monkeypatch, make, 10**9, model)
    assert starts == [None]
    quick, found, (start,) = answer(monkeypatch, make, 300, model)
    size = np.abs(right).max()
    assert np.abs(found - right).max() < 3e-6 * size
    # Plain elements of level 3 sag by a quarter less than those of level 6.
    assert np.abs(start[: len(right), :3] - right).max() < 0.3 * size
    assert quick.iterations < 0.7 * slow.iterations


def test_supports_and_starts_that_it_does_not_suit(monkeypatch):
    """Bodies that do not begin at rest begin where they are; cut elements and free bodies have no such start."""
    monkeypatch.setattr(static, "FEWEST_NESTED", 10)
    body = clamped(box(3))
    field = PLAIN.bind(body)
    loads = np.zeros((body.node_count, 3))
    body.displacements = 1e-3 * body.mesh.points
    body.state.adopt_positions()
    assert static.nested_start(body, PLAIN, field, loads) is None
    free = wc.SoftBody(box(3), wc.Isotropic(50e3, 0.4, 1000.0), device="cpu")
    assert static.nested_start(free, PLAIN, PLAIN.bind(free), loads) is None
    cut = wc.SoftBody(
        wc.TetForest.from_domain(wc.Domain.sphere(0.03, device="cpu"), 0.08, max_level=5),
        wc.Isotropic(50e3, 0.4, 1000.0),
        device="cpu",
    )
    cut.fix("y < ymin + 0.01")
    assert static.nested_start(cut, PLAIN, PLAIN.bind(cut), np.zeros((cut.node_count, 3))) is None


def test_starts_that_are_no_better_are_left_out():
    """A start with more energy, or with elements turned over, changes nothing."""
    ends = []
    for scale in (None, 0.01, 0.2):
        body = clamped(box(3))
        solver = StaticSolver(
            body, PLAIN.bind(body), GRAVITY, tolerance=1e-6, most=100, load_steps=1, preconditioner=None
        )
        near = None
        if scale is not None:
            near = np.zeros((len(body.state.displacements), 4), np.float32)
            free = np.flatnonzero(body.conditions.inverse_mass.numpy() > 0.0)
            near[free, :3] = np.random.default_rng(1).normal(0.0, scale * CUBE, (len(free), 3))
        assert solver.solve(near).converged.all()
        ends.append(body.state.displacements.numpy())
    assert np.array_equal(ends[0], ends[1])
    assert np.array_equal(ends[0], ends[2])


@pytest.mark.parametrize("make", [box, graded], ids=["uniform", "graded"])
def test_coarser_meshes(make):
    """A coarser mesh consists of its finer leaves' ancestors, with the same nodes as a box of that level."""
    fine = make()
    found = coarser(fine, 3)
    mesh = found.forest
    assert mesh.levels.max() == 3
    assert np.bincount(found.leaves, weights=fine.volumes) == pytest.approx(mesh.volumes)
    assert np.array_equal(mesh.points, fine.lattice_points[found.nodes])
    centres = np.zeros((len(mesh.tets), 3))
    np.add.at(centres, found.leaves, fine.points[fine.tets].mean(axis=1) * fine.volumes[:, None])
    assert centres / mesh.volumes[:, None] == pytest.approx(mesh.points[mesh.tets].mean(axis=1))
    right = box(3)
    assert len(mesh.tets) == len(right.tets)
    assert {tuple(p) for p in mesh.lattice.tolist()} == {tuple(p) for p in right.lattice.tolist()}
    where = {tuple(p): k for k, p in enumerate(mesh.lattice.tolist())}
    for node, (a, b) in enumerate(mesh.node_ends):
        if a >= 0:
            middle = (mesh.lattice[a] + mesh.lattice[b]) // 2
            assert where[tuple(middle.tolist())] == node
