"""K p and the diagonal blocks of K against differences of the float64 oracle's forces, for every isotropic law.

Corotated with the exact stiffness is one of them here; see ``test_corotated_stiffness`` for the paper's R K R^T.
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import MATERIAL, MESHES, MODELS, edge_scale, jittered, mixed_forest, oracle_mesh, random_displacement
from fibres import made, muscle
from remesh_cases import CUBE, apply_marks, random_marks
from shortened import crossed
from tangents import (
    assert_diagonal,
    assert_equal,
    assert_keeps_translations,
    assert_symmetric,
    diagonal,
    difference,
    on_device,
    product,
    tangent,
)

import warp_corot as wc

MU, LAM = oracle.lame(MATERIAL["young"], MATERIAL["poisson"])
CASES = ("level 3", "level 4", "level 5", "mixed levels", "general")


def exact(model):
    return {"exact": True} if model == "corotated" else {}


def bound(mesh, model, device, *, worlds=1, deterministic=False, **material):
    body = wc.SoftBody(mesh, wc.Isotropic(**(MATERIAL | material)), worlds=worlds, device=device)
    return MODELS[model]().bind(body, deterministic=deterministic)


def displaced(mesh, model, rng, amount=0.1):
    """Random displacements, with a large rotation if the model allows it."""
    u = random_displacement(mesh, rng, amount)
    if model != "linear":
        turn = oracle.polar(rng.standard_normal((3, 3)))
        u = ((mesh.points + u) @ turn.T - mesh.points).astype(np.float32)
    return u


def expected(model, mesh, u, p, mu=MU, lam=LAM):
    reference = oracle_mesh(mesh)
    return difference(lambda x: oracle.evaluate(model, reference, x, mu, lam)[1], reference.points + u.astype(float), p)


def is_short(model, case):
    """Whether the default run has this case: springs on general meshes compile slowly, and one kind tells as much."""
    return case not in ("general", jittered) or model != "edge_stvk_quadratic"


@pytest.mark.parametrize(("model", "case"), crossed(MODELS, CASES, is_short))
def test_product_equals_differences_of_the_oracles_forces(model, case, device, rng):
    """Strains around 0.3, on forests of all three types and on a general mesh; with the invariants and
    the diagonal blocks of K there."""
    mesh = MESHES[case]()
    field = bound(mesh, model, device)
    u, p = displaced(mesh, model, rng), random_displacement(mesh, rng, 1.0)
    assert_equal(product(field, u, p, **exact(model)), expected(model, mesh, u, p))
    assert_symmetric(field, mesh, u, rng, **exact(model))
    assert_keeps_translations(field, u, rng, **exact(model))
    assert_diagonal(field, u, rng.choice(len(u), 5, replace=False), **exact(model))


@pytest.mark.parametrize("case", ["level 3", "general"])
@pytest.mark.parametrize("model", [model for model in MODELS if "quadratic" not in model and model != "mass_spring"])
def test_inverted_elements(model, case, device, rng):
    """Displacements of a whole edge invert elements. Corotated: nodes of elements with nearly undefined rotations are
    left out."""
    mesh = MESHES[case]()
    field = bound(mesh, model, device)
    u, p = random_displacement(mesh, rng, 0.9), random_displacement(mesh, rng, 1.0)
    F = oracle_mesh(mesh).deformation_gradients(mesh.points + u.astype(float))
    assert (np.linalg.det(F) < -0.1).sum() > 5
    well = np.ones(len(mesh.points), bool)
    found, reference = product(field, u, p, **exact(model)), expected(model, mesh, u, p)
    if model == "corotated":
        sigma = np.linalg.svd(F, compute_uv=False)
        gap = sigma[:, 1] + sigma[:, 2] * np.sign(np.linalg.det(F))
        well[mesh.tets[gap < 0.1 * sigma[:, 0]]] = False
        reference[~well] = 0.0
    assert well.sum() > 10
    assert_equal(found, reference, well)


@pytest.mark.parametrize("strain", [1e-3, 1e-5])
@pytest.mark.parametrize("model", ["linear", "stvk", "neo_hookean", "edge_stvk", "corotated"])
def test_digits_of_small_displacements(model, strain, device, rng):
    """Small strains and small p keep their digits: both enter as differences of displacements, not of positions."""
    mesh = mixed_forest()
    field = bound(mesh, model, device)
    u, p = random_displacement(mesh, rng, 0.3 * strain), random_displacement(mesh, rng, strain)
    assert_equal(product(field, u, p, **exact(model)), expected(model, mesh, u, p / strain) * strain)


@pytest.mark.parametrize(("model", "make"), crossed(MODELS, [mixed_forest, jittered], is_short))
def test_worlds_of_different_materials(model, make, device, rng):
    """Every world has a different material in each element, a different state and a different p."""
    mesh, worlds = make(), 3
    young, poisson = (rng.uniform(*limits, (worlds, len(mesh.tets))) for limits in ((200, 2000), (0.0, 0.45)))
    field = bound(mesh, model, device, worlds=worlds, young=young, poisson=poisson)
    states = [(displaced(mesh, model, rng), random_displacement(mesh, rng, 1.0)) for _ in range(worlds)]
    u, p = (np.concatenate(values) for values in zip(*states, strict=True))
    mu, lam = oracle.lame(young, poisson)
    whole = [expected(model, mesh, *state, *lame) for state, *lame in zip(states, mu, lam, strict=True)]
    assert_equal(product(field, u, p, **exact(model)), np.concatenate(whole))
    assert_diagonal(field, u, rng.choice(len(u), 3, replace=False), **exact(model))


@pytest.fixture(scope="module")
def ball():
    """A sphere in elements of two levels, half of them cut by it."""
    mesh = wc.TetForest.from_domain(wc.Domain.sphere(0.05), 0.04, max_level=6, surface_error=1e-3)
    assert 0.2 < np.mean(mesh.fill != 1.0) < 0.9
    return mesh


@pytest.mark.parametrize("model", MODELS)
def test_filled_share(ball, model, device, rng):
    """Elements count by their filled fraction."""
    field = bound(ball, model, device)
    u, p = displaced(ball, model, rng), random_displacement(ball, rng, 1.0)
    found = product(field, u, p, **exact(model))
    assert_equal(found, expected(model, ball, u, p, MU * ball.fill, LAM * ball.fill))


@pytest.mark.parametrize("model", ["corotated", "neo_hookean", "mass_spring"])
def test_products_are_added_and_need_no_slots(model, device, rng):
    """Products are added to existing values; and a field whose forces go to slots adds to nodes."""
    mesh = mixed_forest()
    plain, field = (bound(mesh, model, device, deterministic=settled) for settled in (False, True))
    u, p = displaced(mesh, model, rng), random_displacement(mesh, rng, 1.0)
    once, block = product(plain, u, p), diagonal(plain, u)
    y, blocks = on_device(once, field), wp.array(block, dtype=wp.mat33, device=device)
    field.add_stiffness(on_device(u, field), on_device(p, field), y)
    tangent(field, u).add_diagonal(blocks)
    assert_equal(y.numpy()[:, :3], 2 * once)
    assert_equal(blocks.numpy(), 2 * block)


FINITE = {
    "the paper's": ("level 3", {"exact": False}),
    "exact": ("level 3", {"exact": True}),
    "the paper's, general": ("general", {"exact": False}),
    "exact, general": ("general", {"exact": True}),
    "wood": ("level 3", {}),
    "wood, general": pytest.param("general", {}, marks=pytest.mark.slow),
}


@pytest.mark.parametrize(("case", "options"), FINITE.values(), ids=FINITE)
def test_every_state_is_finite(case, options, device, rng):
    """At rest, flat, a point, a point reflection, inverted and stretched a thousandfold."""
    mesh = MESHES[case]()
    material = wc.Isotropic(**MATERIAL) if options else made("wood field", mesh, rng)[0]
    field = wc.Corotated(dilatation="element").bind(wc.SoftBody(mesh, material, device=device))
    p = random_displacement(mesh, rng, 1.0)
    flat = (-mesh.points * [0, 0, 1]).astype(np.float32)
    for u in (0 * flat, flat, (-mesh.points).astype(np.float32), (-2 * mesh.points).astype(np.float32), 1e3 * flat):
        assert np.isfinite(product(field, u, p, **options)).all()
        assert np.isfinite(diagonal(field, u, **options)).all()


REMESHED = {
    "corotated": wc.Corotated(),
    "level": wc.Corotated(rotation_level=4),
    "tolerance": wc.Corotated(rotation_level=0.1),
    "neo-hookean": wc.NeoHookean(),
    "edge springs": wc.EdgeStVK(),
    "active muscle": wc.Corotated(),
}


@pytest.mark.parametrize("name", REMESHED)
def test_a_mesh_that_has_changed(name, device, rng):
    """The product equals that on a mesh made that way, with varying material; padding gets nothing."""
    forest = wc.TetForest.box((2, 1, 1), CUBE, 6)
    forest = forest.refine(rng.choice(len(forest.tets), 5, replace=False))
    count, is_muscle = len(forest.tets), "muscle" in name
    material = muscle(rng.standard_normal((count, 3))) if is_muscle else None
    body = wc.SoftBody(forest, material or wc.Isotropic(rng.uniform(1e4, 3e4, count), 0.4, 1000.0), device=device)
    if is_muscle:
        body.activate(rng.uniform(-1e3, 1e3, count))
    options = wc.OnlineRemesh(capacity=4 * count, min_level=0, max_level=48)
    sim = wc.Simulation(body, model=REMESHED[name], remesh=options)
    changing, field = sim.remeshing.changing[0], sim.fields[0]
    for _ in range(2):
        apply_marks(changing.passes, random_marks(changing.forest, rng, 0.05, 0.2))
        changing.renew()
        mesh, count, places = changing.forest.to_forest(), body.node_count, len(body.node_displacements)
        other = wc.SoftBody(mesh, body.material, device=device)
        if is_muscle:
            other.activate(body.activation.numpy())
        alone = REMESHED[name].bind(other)
        # Small enough that some subtrees share rotations within the tolerance.
        u, p = 0.05 * edge_scale(mesh) * rng.uniform(-1, 1, (count, 3)), rng.standard_normal((count, 3))
        found, reference = product(field, u, p, places=places), product(alone, u, p)
        assert_equal(found[:count], reference)
        assert not found[count:].any()
        blocks = diagonal(field, u, places=places)
        assert_equal(blocks[:count], diagonal(alone, u))
