"""Static answers against Newton's method on the float64 oracle, scikit-fem, and states that are known."""

import numpy as np
import oracle
import pytest
from cases import CUBE, MATERIAL, MODELS, jittered, oracle_mesh
from scipy.sparse.linalg import spsolve

import warp_corot as wc

GRAVITY = (0.0, -9.8, 0.0)
LAWS = ("linear", "corotated", "stvk", "neo_hookean")
SHARING = ("element", "shared")


def beam(level, *, device="cpu", worlds=1, **material):
    """The paper's beam, held at one end."""
    mesh = wc.TetForest.box((1, 1, 3), CUBE, level)
    body = wc.SoftBody(mesh, wc.Isotropic(**(MATERIAL | material)), worlds=worlds, device=device)
    body.fix(mesh.points[:, 2] < 1e-9)
    return body


def displaced(body):
    return body.displacements.numpy().astype(float)


def expected(body, model, loads, fixed, young=MATERIAL["young"], poisson=MATERIAL["poisson"], **options):
    mesh = oracle_mesh(body.mesh)
    return oracle.equilibrium(model, mesh, *oracle.lame(young, poisson), fixed, loads, **options) - mesh.points


def weight(body):
    return oracle_mesh(body.mesh).masses(MATERIAL["density"])[:, None] * np.array(GRAVITY)


@pytest.mark.parametrize("model", LAWS)
@pytest.mark.parametrize("level", [3, pytest.param(6, marks=pytest.mark.slow)])
def test_tip_of_a_hanging_beam(model, level, device):
    """Within 1e-5 of the float64 solution; the wall carries the weight."""
    body = beam(level, device=device)
    report = wc.solve_static(body, model=MODELS[model](), gravity=GRAVITY)
    fixed = body.mesh.points[:, 2] < 1e-9
    right = expected(body, model, weight(body), fixed)
    error = np.abs(displaced(body) - right).max() / np.abs(right).max()
    print(
        f"{model}, level {level}: {report.iterations} iterations, {report.linear_iterations} linear, off by {error:.1e}"
    )
    assert report.converged
    assert report.load_share == 1.0
    assert error < 1e-5
    assert np.abs(right).max() > 0.05
    reactions = body.reactions.numpy().astype(float)
    assert reactions.sum(0) == pytest.approx(-weight(body).sum(0), abs=2e-4 * abs(weight(body).sum()))
    assert not reactions[~fixed].any()
    assert not body.velocities.numpy().any()


@pytest.mark.parametrize("model", ["edge_stvk", "mass_spring"])
def test_other_models_come_to_rest(model, device):
    """Their elastic forces balance the weight at every free node, to rounding."""
    body = beam(3, device=device)
    report = wc.solve_static(body, model=MODELS[model](), gravity=GRAVITY)
    field = MODELS[model]().bind(body)
    free = body.mesh.points[:, 2] > 1e-9
    forces = field.elastic_forces(body.state.displacements).numpy()[:, :3] + weight(body)
    assert report.converged
    assert np.abs(forces[free]).max() < 1e-3 * np.linalg.norm(weight(body), axis=1).max()


@pytest.mark.parametrize("make", [lambda: wc.TetForest.box((1, 1, 1), CUBE, 4), jittered])
@pytest.mark.parametrize("model", LAWS)
def test_patch(model, make, device):
    """With an affine motion of the surface the inside moves by the same, whatever the mesh."""
    mesh = make()
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    surface = np.unique(body.surface_triangles)
    gradient = np.array([[0.08, 0.05, 0.0], [-0.02, -0.05, 0.03], [0.0, 0.04, 0.06]])
    affine = mesh.points @ gradient.T
    body.fix(surface)
    start = np.zeros_like(affine)
    start[surface] = affine[surface]
    body.displacements = start
    report = wc.solve_static(body, model=MODELS[model](), gravity=(0, 0, 0))
    assert report.converged
    assert len(surface) < len(mesh.points)
    assert np.abs(displaced(body) - affine).max() < 2e-6 * np.abs(affine).max()


def test_worlds_are_solved_side_by_side(device):
    """Each with its own loads, as if alone; one without any does not move."""
    body, alone = beam(3, device=device, worlds=3), beam(3, device=device)
    tip = np.argmax(body.mesh.points.sum(1))
    forces = np.zeros((3, len(body.mesh.points), 3))
    forces[1, tip], forces[2, tip] = (0.002, 0.0, 0.0), (0.0, 0.0, -0.01)
    body.load(np.arange(len(body.mesh.points)), forces)
    report = wc.solve_static(body, gravity=(0, 0, 0))
    assert report.world_converged.tolist() == [True] * 3
    found = displaced(body).reshape(3, -1, 3)
    assert not found[0].any()
    for world in (1, 2):
        alone.displacements = np.zeros_like(alone.mesh.points)
        alone.load([tip], forces[world, tip])
        assert wc.solve_static(alone, gravity=(0, 0, 0)).converged
        assert np.abs(found[world] - displaced(alone)).max() < 1e-5 * np.abs(found[world]).max()


@pytest.mark.parametrize("young", [1.0, 1e9])
def test_soft_and_hard_tissue(young, device):
    """The beam of 1 Pa hangs twenty times as long as it is; that of 1 GPa sinks by 33 nm."""
    body = beam(3, device=device, young=young, poisson=0.4)
    report = wc.solve_static(body, model=wc.NeoHookean(dilatation="element"), gravity=GRAVITY)
    sag = -displaced(body)[:, 1].max(), -displaced(body)[:, 1].min()
    print(f"{young:g} Pa: {sag}, {report}")
    assert report.converged
    if young > 1.0:
        fixed = body.mesh.points[:, 2] < 1e-9
        right = expected(body, "linear", weight(body), fixed, young=1e3, poisson=0.4, increments=1)
        assert displaced(body) == pytest.approx(right * 1e3 / young, abs=1e-4 * sag[1])


@pytest.mark.parametrize("case", ["nearly incompressible", "hard and soft slices"])
def test_hard_cases_are_as_exact_as_others(case, device):
    """With nu = 0.49999, and with slices whose stiffness jumps by 10,000, float32 forces stay out of balance by a
    hundredth of the weight, but displacements are right to 1e-5."""
    mesh = wc.TetForest.box((1, 1, 3), CUBE, 3)
    height = mesh.points[mesh.tets].mean(1)[:, 2]
    slices = np.where((height * 30).astype(int) % 2 == 0, 1e2, 1e6)
    young, poisson = (500.0, 0.49999) if case == "nearly incompressible" else (slices, 0.45)
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, MATERIAL["density"]), device=device)
    fixed = mesh.points[:, 2] < 1e-9
    body.fix(fixed)
    report = wc.solve_static(body, model=MODELS["corotated"](), gravity=GRAVITY, iterations=500)
    right = expected(body, "corotated", weight(body), fixed, young=young, poisson=poisson, tolerance=1e-7)
    error = np.abs(displaced(body) - right).max() / np.abs(right).max()
    print(f"{case}: {report.iterations} iterations, residual {report.residual:.1e}, off by {error:.1e}")
    assert report.converged
    assert error < 1e-5


@pytest.mark.parametrize(
    ("start", "dilatation"),
    [
        *(("turned over", "element"), ("far away", "element")),
        *(("flat", d) for d in SHARING),
        pytest.param("far away", "shared", marks=pytest.mark.slow),
    ],
)
def test_any_start_leads_to_rest(start, dilatation, device):
    """The search starts from a beam crushed into a plane, turned inside out or blown up, and ends where the search from
    rest ends. Turned inside out, elements that share their dilatation have a state of rest of their own."""
    body, usual = beam(3, device=device), beam(3, device=device)
    model = wc.Corotated(dilatation=dilatation)
    assert wc.solve_static(usual, model=model, gravity=GRAVITY).converged
    u = body.mesh.points * np.array({"flat": [0, -1, 0], "turned over": [0, -2, 0], "far away": [0, 100, 0]}[start])
    u[body.mesh.points[:, 2] < 1e-9] = 0.0
    body.displacements = u
    report = wc.solve_static(body, model=model, gravity=GRAVITY)
    assert np.isfinite(displaced(body)).all()
    assert report.converged, report.message
    assert np.abs(displaced(body) - displaced(usual)).max() < 1e-5 * np.abs(displaced(usual)).max()


def test_a_body_that_nothing_holds(device):
    """Under gravity it has no state of rest, and the report says so; under forces in balance it has one."""
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(**MATERIAL), device=device)
    report = wc.solve_static(body, gravity=GRAVITY)
    assert not report.converged
    assert "no node is held" in report.message
    assert not displaced(body).any()
    ends = [np.flatnonzero(np.isclose(mesh.points[:, 2], z)) for z in (0.0, CUBE)]
    for nodes, pull in zip(ends, (-1.0, 1.0), strict=True):
        body.load(nodes, [0.0, 0.0, pull * 0.1 / len(nodes)])
    report = wc.solve_static(body, model=wc.Linear(), gravity=(0, 0, 0))
    assert report.converged, report.message
    longer = displaced(body)[ends[1], 2].mean() - displaced(body)[ends[0], 2].mean()
    assert longer > 0.0


@pytest.mark.parametrize(
    ("model", "held"), [("linear", "nothing"), ("linear", "a node"), ("linear", "an edge"), ("corotated", "an edge")]
)
def test_a_body_that_is_free_to_turn(model, held, device):
    """Loads with a moment about what holds it turn it, and the report says so; other loads do not, but the search for
    a body on one node may fail."""
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    x = mesh.points - 0.5 * CUBE
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.3, 10.0), device=device)
    edge = (mesh.points[:, 0] < 1e-9) & (mesh.points[:, 2] < 1e-9)
    body.fix({"nothing": np.zeros(len(x), bool), "a node": np.arange(len(x)) == 0, "an edge": edge}[held])
    nodes = np.arange(body.node_count)
    body.load(nodes, np.cross([0.0, 1.0, 0.0], x))
    report = wc.solve_static(body, model=MODELS[model](), gravity=(0.0, 0.0, 0.0), iterations=20)
    assert not report.converged
    assert "free to turn as a whole, and its loads turn it" in report.message
    assert not displaced(body).any()
    if held == "a node":
        return
    body.load(nodes, [0.0, 1e-3, 0.0] * np.sign(x))
    report = wc.solve_static(body, model=MODELS[model](), gravity=(0.0, 0.0, 0.0))
    assert report.converged, report.message


@pytest.mark.parametrize("model", [wc.Linear(), wc.Corotated()], ids=lambda model: type(model).__name__)
def test_a_free_bar_under_even_tension(model, device):
    """It lengthens by the stress over E and narrows by nu times that, also if more digits are requested than float32
    has."""
    young, poisson, stress = 1e5, 0.3, 100.0
    mesh = wc.TetForest.box((1, 1, 3), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(young, poisson, 1000.0), device=device)
    corners = mesh.points[body.surface_triangles]
    areas = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    forces = np.zeros_like(mesh.points)
    for height, pull in ((0.0, -stress), (3 * CUBE, stress)):
        end = np.isclose(corners[:, :, 2], height).all(axis=1)
        np.add.at(forces[:, 2], body.surface_triangles[end], pull * areas[end, None] / 3.0)
    body.load(np.arange(body.node_count), forces)
    report = wc.solve_static(body, model=model, gravity=(0.0, 0.0, 0.0), tolerance=1e-9)
    assert report.converged, report.message
    long, wide = (np.ptp(displaced(body)[:, axis]) / np.ptp(mesh.points[:, axis]) for axis in (2, 0))
    assert long == pytest.approx(stress / young, rel=1e-4)
    assert wide == pytest.approx(poisson * stress / young, rel=1e-4)


def test_a_load_without_an_answer_keeps_the_last_state_at_rest(device):
    """St. Venant and Kirchhoff's law gives way under a load that presses it flat; the report says which part of the
    load it carried."""
    body = beam(3, device=device)
    tip = body.mesh.points[:, 2] > 3 * CUBE - 1e-9
    body.load(np.flatnonzero(tip), [0.0, 0.0, -1e4])
    report = wc.solve_static(body, gravity=GRAVITY, model=wc.StVenantKirchhoff(), iterations=20)
    print(report.message)
    assert np.isfinite(displaced(body)).all()
    assert np.isfinite(report.energy)
    assert report.converged == (report.load_share == 1.0)
    body.load(np.flatnonzero(tip), [0.0, 1e30, 0.0])
    before = displaced(body)
    report = wc.solve_static(body, gravity=GRAVITY)
    assert not report.converged
    assert "not converged" in report.message
    assert np.array_equal(displaced(body), before)


def test_a_world_without_an_answer_leaves_others_theirs(device):
    body, alone = beam(3, device=device, worlds=3), beam(3, device=device)
    tip = body.mesh.points[:, 2] > 3 * CUBE - 1e-9
    body.load(np.flatnonzero(tip), [0.0, 1e30, 0.0], worlds=[1])
    found, expected = (wc.solve_static(each, gravity=GRAVITY, iterations=30) for each in (body, alone))
    assert expected.converged
    assert found.world_converged.tolist() == [True, False, True]
    assert not found.converged
    assert "not converged in 1 of 3 worlds" in found.message
    moved = displaced(body).reshape(3, -1, 3)
    for world in (0, 2):
        np.testing.assert_allclose(moved[world], displaced(alone), rtol=0.0, atol=1e-5 * np.abs(moved[world]).max())


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"tolerance": 0.0}, "tolerance is 0.0"),
        ({"iterations": 0}, "iterations"),
        ({"load_steps": 1.5}, "load_steps"),
        ({"preconditioner": "none"}, "preconditioner is 'none'"),
        ({"model": 3}, "model"),
        ({"gravity": (0, 1)}, "gravity"),
    ],
)
def test_invalid_options_are_refused(options, says):
    with pytest.raises(wc.InputError, match=says):
        wc.solve_static(beam(3), **options)


def test_no_body_or_no_free_node_is_refused():
    with pytest.raises(wc.InputError, match="body is 3"):
        wc.solve_static(3)
    body = beam(3)
    body.fix(np.arange(body.node_count))
    with pytest.raises(wc.InputError, match="at least one must be free"):
        wc.solve_static(body)


@pytest.mark.parametrize("poisson", [0.3, 0.49], ids=["plain", "shared"])
def test_answers_in_float64_balance_to_its_rounding(poisson, device):
    """Far better than float32 can, and near its answer."""
    ends = {}
    for precision in ("float32", "float64"):
        body = wc.SoftBody(wc.TetForest.box((1, 1, 2), 0.064, 3), wc.Isotropic(2e4, poisson, 1000.0), device=device)
        body.fix("z == zmin")
        report = wc.solve_static(body, gravity=(0.0, -9.81, 0.0), precision=precision)
        assert report.converged
        ends[precision] = body.displacements.numpy().astype(float)
    assert report.residual < 1e-12
    assert report.correction < 1e-12
    assert report.displacements.dtype == np.float64
    np.testing.assert_allclose(ends["float64"], report.displacements, atol=1e-7 * np.abs(report.displacements).max())
    np.testing.assert_allclose(ends["float32"], ends["float64"], atol=1e-5 * np.abs(report.displacements).max())


@pytest.mark.parametrize("model", ["linear", "corotated", "neo_hookean"])
def test_answers_in_float64_where_stiffness_jumps_by_a_million(model, device):
    """Rounding of the stiff elements leaves more than elsewhere. With linear elasticity the oracle's matrix has the
    same answer, to the rounding that its condition, some 1e9, allows."""
    mesh = wc.TetForest.box((1, 1, 2), 0.064, 3)
    young = np.where(np.random.default_rng(1).random(len(mesh.tets)) < 0.5, 1e3, 1e9)
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4, MATERIAL["density"]), device=device)
    fixed = mesh.points[:, 2] < 1e-9
    body.fix(fixed)
    report = wc.solve_static(body, model=MODELS[model](), gravity=GRAVITY, precision="float64")
    assert report.converged, report.message
    assert report.correction < 1e-8
    if model == "linear":
        reference = oracle_mesh(mesh)
        matrix = oracle.tangent_matrix("linear", reference, mesh.points, *oracle.lame(young, 0.4))
        free = np.repeat(~fixed, 3)
        right = np.zeros(mesh.points.size)
        right[free] = spsolve(matrix[free][:, free].tocsc(), weight(body).ravel()[free])
        right = right.reshape(-1, 3)
        np.testing.assert_allclose(report.displacements, right, rtol=0.0, atol=1e-6 * np.abs(right).max())


def test_cases_without_a_float64_answer_are_refused():
    free = wc.SoftBody(wc.TetForest.box((1, 1, 1), 0.064, 0), wc.Isotropic(2e4, 0.3, 1000.0), device="cpu")
    with pytest.raises(wc.InputError, match="it needs held nodes in each world"):
        wc.solve_static(free, gravity=(0.0, 0.0, 0.0), precision="float64")
    free.fix("z == zmin")
    with pytest.raises(wc.InputError, match="with obstacles or contact it must be 'float32'"):
        wc.solve_static(free, obstacles=wc.Ground(), precision="float64")
    with pytest.raises(wc.InputError, match="precision is 'half'"):
        wc.solve_static(free, precision="half")
    with pytest.raises(wc.InputError, match="it needs an isotropic material and Linear"):
        wc.solve_static(free, model=wc.Ogden(mu=(1.0,), alpha=(2.0,)), precision="float64")
