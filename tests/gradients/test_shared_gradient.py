"""Gradients of static answers of elements that share their dilatation."""

import numpy as np
import oracle
import pytest
import shared_dilatation
import warp as wp
from cases import CUBE, jittered

import warp_corot as wc
from warp_corot.gradients.parameters import ElementWork

GRAVITY = np.array([0.0, -9.8, 0.0])


def work_by_differences(law, mesh, groups, u, motion):
    """The work of forces in a motion, as a function of lambda [T] and of rest positions, by the oracle's energy."""

    def energy(lam, rest, x):
        other = oracle.Mesh(rest, mesh.tets)
        return shared_dilatation.energy(law, other, groups, lam, x - rest)

    def work(lam, rest):
        x, step = mesh.points + u, 2e-5
        near, far = (
            energy(lam, rest, x + k * step * motion) - energy(lam, rest, x - k * step * motion) for k in (1, 2)
        )
        return -(8.0 * near - far) / (12.0 * step)

    return work


@pytest.mark.parametrize(
    ("law", "mesh"),
    [
        ("corotated", "forest"),
        ("neo_hookean", "general"),
        *(
            pytest.param(law, mesh, marks=pytest.mark.slow)
            for law, mesh in (
                ("linear", "forest"),
                ("stvk", "forest"),
                ("neo_hookean", "forest"),
                ("corotated", "general"),
                ("stvk", "general"),
            )
        ),
    ],
)
def test_work_of_a_shared_dilatation(law, mesh, device):
    """The shear modulus is almost zero; in groups of a forest and of a general mesh."""
    rng = np.random.default_rng(5)
    if mesh == "forest":
        mesh = wc.TetForest.box((1, 1, 3), CUBE, 3).refine(np.arange(144) % 17 == 0)
        groups = shared_dilatation.of_forest(mesh)
    else:
        mesh = jittered()
        groups = shared_dilatation.of_neighbours(mesh)
    young = 1000.0 * rng.uniform(0.5, 2.0, len(mesh.tets))
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.4999995, 10.0), device=device)
    lam = body.discretization.lam.numpy().astype(float)
    u, motion = (scale * rng.standard_normal(mesh.points.shape).astype(np.float32) for scale in (0.0005, 1.0))
    body.displacements = u
    model = {"linear": wc.Linear, "stvk": wc.StVenantKirchhoff, "neo_hookean": wc.NeoHookean, "corotated": wc.Corotated}
    work = ElementWork(model[law](dilatation="shared").bind(body), {"lame", "rest"})
    padded = np.pad(motion, ((0, 0), (0, 1))).astype(np.float32)
    work.add(body.state.displacements, wp.array(padded, dtype=wp.vec4, device=device))
    right = work_by_differences(law, mesh, groups, u.astype(float), motion.astype(float))
    rest = np.asarray(mesh.points)
    cases = {
        "lambda": (work.of_lame()[1], lam * rng.standard_normal(lam.shape), lambda s: right(lam + s, rest), 1e-2),
        "rest": (work.of_rest(), 1e-3 * rng.standard_normal(u.shape), lambda s: right(lam, rest + s), 1e-2),
    }
    for name, (found, way, of, step) in cases.items():
        near, far = (of(k * step * way) - of(-k * step * way) for k in (1, 2))
        difference = (8.0 * near - far) / (12.0 * step)
        error = abs(np.sum(found * way) - difference) / np.linalg.norm(found * way)
        print(f"{name}: {np.sum(found * way):.7g} against {difference:.7g}, off by {error:.1e}")
        assert error < 2e-5


def test_the_default_of_nearly_incompressible_bodies(device):
    """Against differences of static answers of float32 themselves, whose rounding leaves 1e-3."""
    mesh = wc.TetForest.box((1, 1, 3), CUBE, 3)
    tip = mesh.points[:, 2] > 3 * CUBE - 1e-9
    weights = np.zeros_like(mesh.points)
    weights[tip, 1] = 1.0 / tip.sum()

    def sag(young):
        body = wc.SoftBody(mesh, wc.Isotropic(young, 0.49, 10.0), device=device)
        body.fix(mesh.points[:, 2] < 1e-9)
        options = {"wrt": ("young", "gravity"), "gravity": GRAVITY}
        return wc.static_gradient(body, lambda x: (float((weights * x.numpy()).sum()), weights), **options)

    found = sag(500.0)
    difference = (sag(510.0).value - sag(490.0).value) / 20.0
    print(f"{found.young:.6g} against {difference:.6g}")
    assert found.young == pytest.approx(difference, rel=1e-3)


@pytest.mark.parametrize(
    ("law", "mesh"),
    [
        ("corotated", "forest"),
        ("neo_hookean", "general"),
        pytest.param("stvk", "forest", marks=pytest.mark.slow),
        pytest.param("linear", "general", marks=pytest.mark.slow),
    ],
)
def test_a_shared_dilatation_in_float64(law, mesh, device):
    """Against differences of the answers of float64 themselves, to 1e-8."""
    rng = np.random.default_rng(7)
    if mesh == "forest":
        mesh = wc.TetForest.box((1, 1, 2), CUBE, 3).refine(np.arange(96) % 19 == 0)
        fixed = mesh.points[:, 2] < 1e-9
    else:
        mesh = jittered(cells=(1, 1, 2), level=3)
        fixed = mesh.points[:, 2] < 0.3 * CUBE
    weights = rng.standard_normal(mesh.points.shape)
    model = {"linear": wc.Linear, "stvk": wc.StVenantKirchhoff, "neo_hookean": wc.NeoHookean, "corotated": wc.Corotated}
    values = {"young": 500.0 * rng.uniform(0.5, 2.0, len(mesh.tets)), "poisson": np.float64(0.48)}
    if isinstance(mesh, wc.TetMesh):
        values["rest"] = np.asarray(mesh.points)
    names = (*values, "gravity")

    def at(precision="float64", **changed):
        now = values | {"gravity": GRAVITY} | changed
        rest = now.get("rest")
        body = wc.SoftBody(
            mesh if rest is None else wc.TetMesh(rest, mesh.tets),
            wc.Isotropic(now["young"], now["poisson"], 10.0),
            device=device,
        )
        body.fix(fixed)
        return wc.static_gradient(
            body,
            lambda x: (float((weights * x.numpy()).sum()), weights),
            wrt=names,
            model=model[law](dilatation="shared"),
            gravity=now["gravity"],
            precision=precision,
        )

    found, rough = at(), at("float32")
    assert found.value == pytest.approx(rough.value, rel=1e-5)
    assert found.young == pytest.approx(rough.young, abs=1e-4 * np.abs(found.young).max())
    if "rest" in names:
        assert found.rest == pytest.approx(rough.rest, abs=1e-4 * np.abs(found.rest).max())
    ways = {name: 1e-3 * values[name] * rng.standard_normal(np.shape(values[name])) for name in values}
    ways["gravity"] = 1e-2 * rng.standard_normal(3)
    if "rest" in ways:
        ways["rest"] = 1e-5 * CUBE * rng.standard_normal(mesh.points.shape)
    for name, way in ways.items():
        start = GRAVITY if name == "gravity" else values[name]
        near, far = (at(**{name: start + k * way}).value - at(**{name: start - k * way}).value for k in (1, 2))
        along, right = float(np.sum(found[name] * way)), (8.0 * near - far) / 12.0
        error = abs(along - right) / max(abs(right), np.linalg.norm(found[name] * way))
        print(f"{name}: {along:.10g} against {right:.10g}, off by {error:.1e}")
        assert error < 1e-8
