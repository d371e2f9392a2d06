"""Gradients of static answers against differences of Newton's method on the float64 oracle."""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import CUBE, MODELS, jittered

import warp_corot as wc

GRAVITY = np.array([0.0, -9.8, 0.0])
NAMES = ("young", "poisson", "density", "loads", "boundary", "rest", "gravity")
LAWS = (
    "corotated",
    pytest.param("neo_hookean", marks=pytest.mark.slow),
    pytest.param("stvk", marks=pytest.mark.slow),
    pytest.param("linear", marks=pytest.mark.slow),
    pytest.param("edge_stvk_quadratic", marks=pytest.mark.slow),
)
#: Of a derivative along a random direction, over what its entries' sizes would make of it.
TOLERANCE = 1e-4


class Case:
    """A body under random loads and its weight, held at one end, and J = sum of w . x with random w."""

    def __init__(self, mesh, law, device, seed=0):
        self.mesh, self.law, self.rng = mesh, law, np.random.default_rng(seed)
        count, nodes = len(mesh.tets), len(mesh.points)
        end = mesh.points[:, 2].min() if isinstance(mesh, wc.TetForest) else np.sort(mesh.points[:, 2])[nodes // 5]
        self.fixed = mesh.points[:, 2] <= end
        self.given = {
            "young": 500.0 * self.rng.uniform(0.5, 2.0, count),
            "poisson": 0.4,
            "density": 10.0,
            # In float32, as the body has them.
            "loads": (1e-4 * self.rng.standard_normal((nodes, 3))).astype(np.float32).astype(float),
            "boundary": np.zeros((nodes, 3)),
            "rest": np.asarray(mesh.points),
            "gravity": GRAVITY,
        }
        self.weights = self.rng.standard_normal((nodes, 3))
        material = wc.Isotropic(self.given["young"], self.given["poisson"], self.given["density"])
        self.body = wc.SoftBody(mesh, material, device=device)
        self.body.fix(self.fixed)
        self.body.load(np.arange(nodes), self.given["loads"])

    def gradient(self, **options):
        def objective(x):
            return float((self.weights * x.numpy()).sum()), self.weights

        return wc.static_gradient(self.body, objective, model=MODELS[self.law](), gravity=GRAVITY, **options)

    def value(self, **changed):
        """J by the oracle, with some of the arguments changed."""
        given = self.given | changed
        mesh = oracle.Mesh(given["rest"], self.mesh.tets)
        loads = given["loads"] + mesh.masses(given["density"])[:, None] * given["gravity"]
        lame = oracle.lame(given["young"], given["poisson"])
        start = given["rest"] + given["boundary"]
        options = {"increments": 1, "tolerance": 1e-12, "start": start}
        x = oracle.equilibrium(self.law, mesh, *lame, self.fixed, loads, **options)
        return float((self.weights * x).sum())

    def direction(self, name):
        size = {"boundary": 1e-2 * CUBE, "rest": 1e-2 * CUBE, "loads": 1e-4}.get(name)
        given = np.asarray(self.given[name])
        way = self.rng.standard_normal(given.shape) * (np.abs(given) if size is None else size)
        if name == "gravity":
            way = self.rng.standard_normal(3)
        return way * self.fixed[:, None] if name == "boundary" else way

    def difference(self, name, way, step):
        """The derivative along a direction, of fourth order."""
        near, far = (
            self.value(**{name: self.given[name] + k * step * way})
            - self.value(**{name: self.given[name] - k * step * way})
            for k in (1, 2)
        )
        return (8.0 * near - far) / (12.0 * step)


def check(case, found, names, step=1e-3, tolerance=TOLERANCE):
    for name in names:
        way = case.direction(name)
        along, right = float(np.sum(found[name] * way)), case.difference(name, way, step)
        error = abs(along - right) / max(abs(right), np.linalg.norm(found[name] * way))
        print(f"{name}: {along:.8g} against {right:.8g}, off by {error:.1e}")
        assert error < tolerance


@pytest.mark.parametrize("law", LAWS)
def test_all_derivatives_of_a_forest(law, device):
    case = Case(wc.TetForest.box((1, 1, 3), CUBE, 3), law, device)
    names = [name for name in NAMES if name != "rest" or law != "edge_stvk_quadratic"]
    found = case.gradient(wrt=names)
    assert found.value == pytest.approx(case.value(), abs=1e-6)
    assert found.report.converged
    assert found.adjoint_residual < 1e-4
    assert all(found[name].shape == case.mesh.points.shape for name in names if name in ("loads", "boundary", "rest"))
    assert not found.loads[case.fixed].any()
    assert not found.boundary[~case.fixed].any()
    check(case, found, names)


@pytest.mark.slow
@pytest.mark.parametrize("law", ["corotated", "neo_hookean"])
def test_derivatives_of_a_general_mesh(law, device):
    case = Case(jittered(cells=(1, 1, 2), level=3), law, device, seed=3)
    names = ("young", "loads", "rest", "boundary")
    check(case, case.gradient(wrt=names), names)


@pytest.mark.parametrize("law", ["corotated", "neo_hookean", "stvk", "linear"])
def test_derivatives_in_float64(law, device):
    """To 1e-8 of central differences."""
    make = jittered if law == "stvk" else wc.TetForest.box
    case = Case(make(cells=(1, 1, 2), level=3, **({} if law == "stvk" else {"cell_size": CUBE})), law, device)
    found = case.gradient(wrt=NAMES, precision="float64")
    assert found.value == pytest.approx(case.value(), rel=1e-12)
    check(case, found, NAMES, tolerance=1e-8)


@wp.kernel(enable_backward=True)
def add_squares(x: wp.array[wp.vec3], loss: wp.array[float]):
    i = wp.tid()
    wp.atomic_add(loss, 0, wp.dot(x[i], x[i]))


def test_objectives_of_both_kinds_agree(device):
    """An objective with a tape, and one that returns a value and its gradient."""
    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), CUBE, 3), wc.Isotropic(500.0, 0.4, 10.0), device=device)
    body.fix(body.mesh.points[:, 2] < 1e-9)

    def taped(x):
        loss = wp.zeros(1, dtype=float, device=device, requires_grad=True)
        wp.launch(add_squares, len(x), [x], [loss], device=device)
        return loss

    def paired(x):
        return float((x.numpy().astype(float) ** 2).sum()), 2.0 * x.numpy()

    options = {"wrt": ("young", "loads"), "model": MODELS["corotated"](), "gravity": GRAVITY}
    first, second = (wc.static_gradient(body, objective, **options) for objective in (taped, paired))
    assert first.value == pytest.approx(second.value, rel=1e-5)
    assert isinstance(first.young, float)
    assert first.young == pytest.approx(second.young, rel=1e-4)
    assert first.loads == pytest.approx(second.loads, abs=1e-5 * np.abs(second.loads).max())


def test_each_world_has_its_own_gradient(device):
    """Shapes follow the material's; each world's gradient is that of the body alone."""
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    young = np.array([[400.0], [900.0]])
    weights = np.random.default_rng(1).standard_normal((2, len(mesh.points), 3))

    def gradient(body, w):
        body.fix(mesh.points[:, 2] < 1e-9)
        options = {"wrt": ("young", "density", "rest"), "model": MODELS["corotated"](), "gravity": GRAVITY}
        return wc.static_gradient(body, lambda x: (0.0, w.reshape(-1, 3)), **options)

    both = gradient(wc.SoftBody(mesh, wc.Isotropic(young, 0.4, 10.0), worlds=2, device=device), weights)
    assert both.young.shape == (2, 1)
    assert isinstance(both.density, float)
    for world in range(2):
        alone = gradient(wc.SoftBody(mesh, wc.Isotropic(young[world, 0], 0.4, 10.0), device=device), weights[world])
        assert both.young[world, 0] == pytest.approx(alone.young, rel=1e-4)
        rest = both.rest.reshape(2, -1, 3)[world]
        assert rest == pytest.approx(alone.rest, abs=1e-4 * np.abs(alone.rest).max())


def test_relaxed_tissue_has_the_gradient_of_the_law(device):
    """With Maxwell elements beside the law, the gradient at rest is that of the law alone."""
    body = wc.SoftBody(wc.TetForest.box((1, 1, 1), CUBE, 3), wc.Isotropic(500.0, 0.4, 10.0), device=device)
    body.fix(body.mesh.points[:, 2] < 1e-9)
    options = {"wrt": ("loads", "density"), "gravity": 50.0 * GRAVITY}
    law = MODELS["corotated"]()
    slow, plain = (
        wc.static_gradient(body, lambda x: (0.0, x.numpy()), model=model, **options)
        for model in (wc.Prony(0.5, 0.1, law), law)
    )
    assert slow.loads == pytest.approx(plain.loads, abs=1e-4 * np.abs(plain.loads).max())
    assert slow.density == pytest.approx(plain.density, rel=1e-4)


# --- muscles ----------------------------------------------------------------------------------------------------------


MUSCLE = wc.TransverselyIsotropic(3e4, 8e3, 0.4, 0.3, 4e3, direction=(0.2, 0.1, 1.0), density=1000.0)
FIBRES = wc.FibreReinforced(1e4, 0.3, 5e3, 5.0, direction=(0.2, 0.1, 1.0), density=1000.0)


@pytest.mark.parametrize(
    ("name", "muscle", "model"),
    [
        ("activation", MUSCLE, wc.Corotated()),
        pytest.param("rest", MUSCLE, wc.Corotated(), marks=pytest.mark.slow),
        ("rest", FIBRES, wc.HolzapfelGasserOgden()),
    ],
)
def test_active_stress(name, muscle, model, device):
    """Derivatives along a direction against differences of static answers of float32, whose rounding leaves 1e-3."""
    mesh = jittered(cells=(1, 1, 2), level=3) if name == "rest" else wc.TetForest.box((1, 1, 2), CUBE, 3)
    rng = np.random.default_rng(2)
    weights, fixed = rng.standard_normal(mesh.points.shape), mesh.points[:, 2] < 0.3 * CUBE
    values = {"activation": np.full(len(mesh.tets), 2000.0), "rest": np.asarray(mesh.points)}
    ways = {
        "activation": 500.0 * rng.uniform(0.5, 1.5, len(mesh.tets)),
        "rest": 1e-3 * CUBE * rng.standard_normal(mesh.points.shape),
    }

    def at(**changed):
        now = values | changed
        moved = mesh if name == "activation" else wc.TetMesh(now["rest"], mesh.tets)
        body = wc.SoftBody(moved, muscle, device=device)
        body.fix(fixed)
        body.activate(now["activation"])
        options = {"wrt": name, "gravity": GRAVITY, "model": model}
        return wc.static_gradient(body, lambda x: (float((weights * x.numpy()).sum()), weights), **options)

    found, way = at()[name], ways[name]
    difference = at(**{name: values[name] + way}).value - at(**{name: values[name] - way}).value
    along = 2.0 * float(np.sum(found.reshape(way.shape) * way))
    print(f"{name}: {along:.6g} against {difference:.6g}")
    assert along == pytest.approx(difference, rel=2e-3)


# --- what is refused --------------------------------------------------------------------------------------------------


def test_refusals(device):
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(500.0, 0.4, 10.0), device=device)

    def nothing(x):
        return 0.0, np.zeros((len(x), 3))

    with pytest.raises(wc.InputError, match="no node is held; a body that may be anywhere"):
        wc.static_gradient(body, nothing)
    body.fix(mesh.points[:, 2] < 1e-9)
    for options, message in (
        ({"wrt": "colour"}, "wrt has 'colour'; it must be one or several of 'young'"),
        ({"wrt": ()}, "wrt is empty"),
        ({"wrt": "activation"}, "wrt has 'activation', but only anisotropic materials"),
        ({"model": wc.Corotated(rotation_level=0)}, "the model shares rotations"),
        ({"model": wc.Prony(model=wc.Corotated(rotation_level=0)), "wrt": "loads"}, "the model shares rotations"),
        ({"model": wc.MassSpring()}, "have no derivative with respect to moduli"),
        ({"model": wc.EdgeStVK(springs="quadratic"), "wrt": ("young", "rest")}, "with respect to the rest shape;"),
        ({"precision": "float16"}, "precision is 'float16'; it must be 'float32' or 'float64'"),
        ({"model": wc.MassSpring(), "wrt": "loads", "precision": "float64"}, "precision is 'float64'; it needs an iso"),
        ({"adjoint_tolerance": 2.0}, "adjoint_tolerance is 2.0; it must be between 0 and 1"),
    ):
        with pytest.raises(wc.InputError, match=message):
            wc.static_gradient(body, nothing, **options)
    for objective, message in (
        (3.0, "objective is 3.0; it must be a function"),
        (lambda x: 1.0, "objective gives 1.0; it must give a wp.array"),
        (lambda x: (1.0, np.zeros(3)), r"has shape \(3,\); it must be \[27, 3\]"),
        (lambda x: (np.nan, np.zeros((len(x), 3))), "not finite"),
        (lambda x: wp.zeros(1, dtype=float, device=device), "requires_grad=False"),
    ):
        with pytest.raises(wc.InputError, match=message):
            wc.static_gradient(body, objective)
    with pytest.raises(wc.ConvergenceError, match="there is no gradient: not converged"):
        wc.static_gradient(body, nothing, iterations=1, tolerance=1e-12, gravity=(0, -1e5, 0))
    found = wc.static_gradient(body, lambda x: (1.0, np.ones((len(mesh.points), 3))))
    assert found["young"] == found.young
    with pytest.raises(wc.InputError, match="'loads' is not one of the requested"):
        found["loads"]
