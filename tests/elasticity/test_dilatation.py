"""Dilatation that elements share: energies and forces against float64, stiffness, no locking, rigid motions, worlds."""

import functools

import numpy as np
import oracle
import pytest
import shared_dilatation as reference
import warp as wp
from cases import CUBE, jittered, mixed_forest
from shortened import crossed
from tangents import diagonal

import warp_corot as wc
from warp_corot.discretization.discretization import FixedMesh, deviatoric
from warp_corot.elasticity import ForceField
from warp_corot.elasticity.corotated.fields import SubtreeField
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.elasticity.laws import LawField

YOUNG, POISSON = 1e4, 0.4
MODELS = {
    "linear": wc.Linear,
    "stvk": wc.StVenantKirchhoff,
    "neo_hookean": wc.NeoHookean,
    "corotated": wc.Corotated,
}
MESHES = {
    "level 2": (lambda: wc.TetForest.box((1, 1, 2), CUBE, 2), reference.of_forest),
    "level 0": (lambda: wc.TetForest.box((2, 1, 1), CUBE, 0), reference.of_forest),
    "level 3": (lambda: wc.TetForest.box((1, 1, 2), CUBE, 3), reference.of_eights),
    "level 4": (lambda: wc.TetForest.box((1, 1, 1), CUBE, 4), reference.of_eights),
    "level 8": (lambda: wc.TetForest.box((1, 1, 1), CUBE, 8), reference.of_eights),
    "mixed levels": (mixed_forest, reference.of_forest),
    "general": (jittered, reference.of_neighbours),
}


def is_short(law, kind):
    """Whether the default run has this case: all meshes under one law with a logarithm, all laws on one mesh."""
    return law == "neo_hookean" or kind == "level 3"


def vec4(values, device):
    wide = np.concatenate([values, np.zeros((len(values), 1))], axis=1)
    return wp.array(wide.astype(np.float32), dtype=wp.vec4, device=device)


def strained(mesh, rng, amount=0.1):
    """A large homogeneous strain, and a little of everything besides; in float32's numbers."""
    smallest = np.cbrt(np.min(mesh.volumes))
    noise = 0.05 * smallest * rng.uniform(-1.0, 1.0, mesh.points.shape)
    return (mesh.points @ (amount * rng.uniform(-1.0, 1.0, (3, 3))) + noise).astype(np.float32).astype(float)


def bound(law, mesh, device, **options):
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), device=device)
    return body, MODELS[law](dilatation="shared", **options).bind(body)


def nodal(array):
    return array.numpy()[:, :3].astype(float)


@pytest.mark.parametrize(("law", "kind"), crossed(MODELS, ["level 3", "mixed levels", "general"], is_short))
def test_forces_of_elements_with_large_changes_of_volume(law, kind, device, rng):
    """Some elements have lost or gained more than half of their volume and are held back on their own."""
    mesh = MESHES[kind][0]()
    stretched = strained(mesh, rng) + mesh.points @ np.diag([0.4, 0.3, -0.05])
    reference_mesh = oracle.Mesh(mesh.points, mesh.tets)
    volumes = np.linalg.det(reference_mesh.deformation_gradients(mesh.points + stretched))
    assert (volumes > 1.5).any()
    check_forces(law, kind, device, rng, stretched.astype(np.float32).astype(float))


@pytest.mark.parametrize(("law", "kind"), crossed(MODELS, MESHES, is_short))
def test_forces_are_minus_the_derivative_of_the_energy(law, kind, device, rng):
    check_forces(law, kind, device, rng, strained(MESHES[kind][0](), rng))


def check_forces(law, kind, device, rng, u):
    make, groups_of = MESHES[kind]
    mesh = make()
    lam = YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    body, field = bound(law, mesh, device)
    shear = MODELS[law]().bind(deviatoric(body.discretization))
    groups = groups_of(mesh)
    expected = reference.energy(law, mesh, groups, lam, u)
    found = field.elastic_energy(vec4(u, device)) - shear.elastic_energy(vec4(u, device))
    assert found == pytest.approx(expected, rel=2e-5)
    forces = nodal(field.elastic_forces(vec4(u, device))) - nodal(shear.elastic_forces(vec4(u, device)))
    for _ in range(3):
        p = rng.uniform(-1.0, 1.0, u.shape) * np.abs(u).max()
        step = 1e-5
        up, down = (reference.energy(law, mesh, groups, lam, u + sign * step * p) for sign in (1, -1))
        assert np.sum(forces * p) == pytest.approx(-(up - down) / (2 * step), rel=1e-3, abs=2e-6 * np.abs(forces).sum())


@pytest.mark.parametrize(("law", "kind"), crossed(MODELS, ["level 2", "level 3", "mixed levels", "general"], is_short))
def test_stiffness_is_minus_the_derivative_of_the_forces(law, kind, device, rng):
    mesh = MESHES[kind][0]()
    _, field = bound(law, mesh, device)
    exact = {"exact": True} if law == "corotated" else {}
    u = strained(mesh, rng)
    p, q = (rng.uniform(-1.0, 1.0, u.shape).astype(np.float32) for _ in range(2))
    products = []
    for direction in (p, q):
        y = wp.zeros(len(u), dtype=wp.vec4, device=device)
        field.add_stiffness(vec4(u, device), vec4(direction, device), y, **exact)
        products.append(nodal(y))
    step = 0.02 * np.cbrt(np.min(mesh.volumes))
    ahead, behind = (nodal(field.elastic_forces(vec4(u + sign * step * p, device))) for sign in (1, -1))
    difference = -(ahead - behind) / (2 * step)
    assert np.abs(products[0] - difference).max() < 5e-3 * np.abs(difference).max()
    assert np.sum(products[0] * q) == pytest.approx(
        np.sum(products[1] * p), rel=1e-3, abs=1e-4 * np.abs(products).sum()
    )


@pytest.mark.parametrize(("law", "kind"), crossed(["neo_hookean"], ["level 3", "mixed levels", "general"], is_short))
def test_diagonal(law, kind, device, rng):
    """The blocks are those of K where groups share a dilatation; elsewhere K has no more."""
    mesh = MESHES[kind][0]()
    _, field = bound(law, mesh, device)
    u, count = strained(mesh, rng, 0.02), len(mesh.points)
    blocks = diagonal(field, u).astype(float)
    for node in rng.choice(count, 5, replace=False):
        block = np.empty((3, 3))
        for axis in range(3):
            unit = np.zeros((count, 3))
            unit[node, axis] = 1.0
            y = wp.zeros(count, dtype=wp.vec4, device=device)
            field.add_stiffness(vec4(u, device), vec4(unit, device), y)
            block[:, axis] = nodal(y)[node]
        excess = blocks[node] - block
        assert np.linalg.eigvalsh(0.5 * (excess + excess.T)).min() > -2e-4 * np.abs(block).max()
        if kind != "general":
            assert np.abs(excess).max() < 1e-4 * np.abs(block).max()


def stiffness_matrix(field, count, device):
    """K at rest, column by column [3N, 3N]."""
    rest, columns = wp.zeros(count, dtype=wp.vec4, device=device), []
    for i in range(3 * count):
        unit = np.zeros((count, 3))
        unit[i // 3, i % 3] = 1.0
        y = wp.zeros(count, dtype=wp.vec4, device=device)
        field.add_stiffness(rest, vec4(unit, device), y)
        columns.append(nodal(y).ravel())
    return np.stack(columns, axis=1)


@pytest.mark.parametrize("law", MODELS)
def test_a_free_body_has_six_motions_without_energy(law, device):
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, 0.4999, 1000.0), device=device)
    stiffness = stiffness_matrix(MODELS[law](dilatation="shared").bind(body), len(mesh.points), device)
    values = np.linalg.eigvalsh(0.5 * (stiffness + stiffness.T))
    assert np.abs(values[:6]).max() < 1e-6 * values[-1]
    assert values[6] > 1e-2 * YOUNG * CUBE / 8


@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_a_beam_of_nearly_incompressible_tissue_does_not_lock(poisson, device):
    """Its sag is that of float64, up to what float32 loses where lambda is much larger than mu; plain elements lock."""
    mesh = wc.TetForest.box((1, 1, 3), CUBE, 3)
    material, gravity = wc.Isotropic(5e4, poisson, 1000.0), (0.0, -9.8, 0.0)
    fixed = mesh.points[:, 2] < 1e-9
    body = wc.SoftBody(mesh, material, device=device)
    stiffness = stiffness_matrix(wc.Corotated(dilatation="shared").bind(body), len(mesh.points), device)
    free = np.flatnonzero(np.repeat(~fixed, 3))
    loads = np.asarray(body.discretization.masses)[:, None] * np.array(gravity)
    sag = np.zeros(3 * len(mesh.points))
    sag[free] = np.linalg.solve(stiffness[np.ix_(free, free)], loads.ravel()[free])
    expected = reference.linear_sag(mesh, reference.of_eights(mesh), 5e4, poisson, 1000.0, gravity, fixed)
    tolerance = 1e-4 + 3e-6 * 2 * poisson / (1 - 2 * poisson)
    assert np.abs(sag.reshape(-1, 3) - expected).max() < tolerance * np.abs(expected).max()
    plain = reference.linear_sag(mesh, None, 5e4, poisson, 1000.0, gravity, fixed)
    assert np.abs(expected[:, 1]).max() > (1.05 if poisson == 0.3 else 1.15) * np.abs(plain[:, 1]).max()


@pytest.mark.parametrize(("law", "kind"), crossed(MODELS, ["level 3", "mixed levels", "general"], is_short)[3:])
def test_rigid_motion_makes_no_force(law, kind, device, rng):
    mesh = MESHES[kind][0]()
    _, field = bound(law, mesh, device)
    axis, angle = np.array([0.6, 0.0, 0.8]), 0.5
    k = np.cross(np.eye(3), -axis)
    rotation = np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k
    forces = nodal(field.elastic_forces(vec4(mesh.points @ (rotation - np.eye(3)).T + 0.01, device)))
    scale = YOUNG * np.cbrt(np.min(mesh.volumes)) ** 2
    assert np.abs(forces).max() < 1e-4 * scale


@pytest.mark.parametrize("law", ["neo_hookean", "corotated"])
def test_one_launch_gives_the_forces_of_several_passes(law, device, rng, monkeypatch):
    """This includes flat and inverted elements, many materials, and elements that the law leaves out."""
    mesh = mixed_forest()
    material = wc.Isotropic(rng.uniform(1e3, 1e4, len(mesh.tets)), rng.uniform(0.0, 0.49, len(mesh.tets)), 1000.0)
    body = wc.SoftBody(mesh, material, device=device)
    u = vec4(rng.uniform(-0.02, 0.02, mesh.points.shape), device)
    together = nodal(MODELS[law](dilatation="shared").bind(body).elastic_forces(u))
    monkeypatch.setattr(ForceField, "share_dilatation", lambda *_: False)
    for kind in (SubtreeField, LawField):
        monkeypatch.setattr(kind, "in_clusters", None)
    apart = nodal(MODELS[law](dilatation="shared").bind(body).elastic_forces(u))
    assert np.abs(together - apart).max() < 2e-5 * np.abs(apart).max()


@pytest.mark.parametrize(("poisson", "is_shared"), [(0.44, False), (0.45, True), ([0.3, 0.46], True)])
def test_elements_share_by_default_from_a_ratio_on(poisson, is_shared, device):
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    ratios = np.resize(poisson, len(mesh.tets)) if np.ndim(poisson) else poisson
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, ratios, 1000.0), device=device)
    assert isinstance(wc.Corotated().bind(body), DilatationField) == is_shared
    assert not isinstance(wc.Corotated(dilatation="element").bind(body), DilatationField)


def test_worlds_equal_single_bodies(device, rng):
    mesh, young = mixed_forest(), rng.uniform(1e3, 1e4, (2, 1))
    states = [strained(mesh, rng) for _ in range(2)]
    both = wc.SoftBody(mesh, wc.Isotropic(young, POISSON, 1000.0), worlds=2, device=device)
    together = nodal(wc.NeoHookean(dilatation="shared").bind(both).elastic_forces(vec4(np.concatenate(states), device)))
    for world, u in enumerate(states):
        body = wc.SoftBody(mesh, wc.Isotropic(young[world, 0], POISSON, 1000.0), device=device)
        alone = nodal(wc.NeoHookean(dilatation="shared").bind(body).elastic_forces(vec4(u, device)))
        of_world = together[world * len(u) : (world + 1) * len(u)]
        assert np.abs(of_world - alone).max() < 1e-5 * np.abs(alone).max()


def test_a_run_with_remeshing_keeps_its_energy(device):
    """A block is twisted by its weight while its mesh follows; forces are those of a body bound afresh."""
    mesh = wc.TetForest.box((1, 1, 2), CUBE, 4)
    body = wc.SoftBody(mesh, wc.Isotropic(3e3, 0.49, 1000.0), device=device)
    body.fix(mesh.points[:, 2] < 1e-6)
    model = wc.Corotated(dilatation="shared")
    remesh = wc.OnlineRemesh(every=20, refine_above=1.05, simplify_below=1.01, max_level=7)
    sim = wc.Simulation(body, model=model, gravity=(0, -9.8, 0), remesh=remesh)
    sim.advance(0.05)
    assert len(body.mesh.tets) > len(mesh.tets)
    assert np.isfinite(body.positions.numpy()).all()
    fresh = wc.SoftBody(body.mesh, wc.Isotropic(3e3, 0.49, 1000.0), device=device)
    u = body.positions.numpy() - body.mesh.points
    expected = nodal(model.bind(fresh).elastic_forces(vec4(u, device)))[: len(u)]
    found = sim.forces(body).numpy()[: len(u)]
    assert np.abs(found - expected).max() < 1e-3 * np.abs(expected).max()


@pytest.mark.parametrize("model", [wc.Linear, wc.Corotated, wc.NeoHookean, wc.StVenantKirchhoff, wc.EdgeStVK])
def test_invalid_options_are_refused(model):
    with pytest.raises(wc.InputError, match="dilatation is 'nodal'"):
        model(dilatation="nodal")


def test_forces_of_separate_dilatations_have_slots_of_their_own(device, rng, monkeypatch):
    """In a deterministic run, which has slots on CUDA only, the plan's slots are those of subtrees and groups."""
    mesh = mixed_forest()
    body = wc.SoftBody(mesh, wc.Isotropic(YOUNG, POISSON, 1000.0), worlds=2, device=device)
    count = body.node_count
    u, found = vec4(rng.uniform(-1e-3, 1e-3, (count, 3)), device), []
    for deterministic in (False, True):
        plan = functools.partial(FixedMesh.plan, deterministic=deterministic)
        monkeypatch.setattr(FixedMesh, "plan", lambda self, *a, plan=plan, deterministic, **o: plan(self, *a, **o))
        field = wc.Corotated(dilatation="shared").bind(body)
        monkeypatch.undo()
        assert (field.slots is not None) == deterministic
        f = wp.zeros(64 * count, dtype=wp.vec4, device=device)

        field.unshare(u, f[:count])
        assert not f.numpy()[count:].any()
        found.append(f.numpy()[:count])
    scale = np.abs(found[0]).max()
    assert scale > 0.0
    np.testing.assert_allclose(found[1], found[0], atol=1e-5 * scale)


def test_springs_and_fibres_have_no_dilatation_to_share(device):
    with pytest.raises(wc.InputError, match="which has springs"):
        wc.MassSpring(dilatation="shared")
    mesh = wc.TetForest.box((1, 1, 1), CUBE, 3)
    along = wc.TransverselyIsotropic(3e3, 1e3, 0.4, 0.45, 3e2, direction=(0, 0, 1), density=1000.0)
    body = wc.SoftBody(mesh, along, device=device)
    with pytest.raises(wc.InputError, match="it must be 'auto' or 'element'"):
        wc.Corotated(dilatation="shared").bind(body)
