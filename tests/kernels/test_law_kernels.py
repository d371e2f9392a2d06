"""CUDA's kernels of elastic laws, on random strained states, every node against float64.

Their arithmetic is the same on both devices; features that only CUDA has, shared memory of groups and sums in warps,
are tested there through the public models (see ``test_miscompile``).
"""

import numpy as np
import oracle
import pytest
import warp as wp
from cases import oracle_mesh, random_displacement
from fibres import WOOD, made, random_axes, wood
from pairs import add_forces
from thousands import FORESTS, TOLERANCE, materials, meshed, turned

import warp_corot as wc
from warp_corot.discretization.planner import ForcePlan
from warp_corot.elasticity.anisotropic import ACTIVE, AnisotropicField
from warp_corot.elasticity.clusters import ClusterScatter, clustered
from warp_corot.elasticity.model import Kept, isotropic_material
from warp_corot.kernels.clusters.laws import ActiveMaterial, anisotropic_law, isotropic_law, reinforced_law
from warp_corot.kernels.corotated.anisotropic import FibreMaterial, ReinforcedMaterial, fibre_stress
from warp_corot.kernels.corotated.corotated import corotated_stress
from warp_corot.kernels.corotated.well_conditioned import quaternions_of
from warp_corot.kernels.elements import constitutive
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.elements.forces import scatter_chosen, scatter_forces
from warp_corot.kernels.math.rotation import byers_xu, quick_rotation
from warp_corot.kernels.subtrees.anisotropic import repair_leaves, scatter_anisotropic_subtrees
from warp_corot.kernels.subtrees.cuda import scatter_law_subtrees
from warp_corot.kernels.subtrees.degenerate import NO_LIST
from warp_corot.kernels.subtrees.memory import BLOCK
from warp_corot.kernels.tables.cluster_layout import ANISOTROPIC

LAWS = {
    "linear": constitutive.law_functions("linear").stress,
    "stvk": constitutive.law_functions("stvk").stress,
    "neo_hookean": constitutive.law_functions("neo-hookean").stress,
}


def state(mesh, law, rng):
    """Displacements in the device's form, and positions in float64."""
    u = random_displacement(mesh, rng, 0.1) if law == "linear" else turned(mesh, rng, 0.1)
    return np.pad(u, ((0, 0), (0, 1))), mesh.points + u.astype(float)


def by_node(subtrees, device):
    """Node numbers as kernels for CUDA read them, [10, subtrees]."""
    if device.is_cpu:
        transposed = np.ascontiguousarray(subtrees.nodes.numpy().T)
        subtrees.nodes = subtrees.targets = wp.array(transposed, dtype=wp.int32, device=device)


def assert_right(forces, expected):
    wrong = np.abs(forces - expected).max(axis=1) > TOLERANCE * np.abs(expected).max()
    assert not wrong.any(), f"{wrong.sum()} of {wrong.size} nodes"


def _of_subtrees(chosen, others):
    """Pairs of a forest and an option of its kernels: each compiles for a second or two, so ``others`` are slow."""
    pairs = [(name, other) for other in others for name in FORESTS]
    return [pytest.param(*pair, marks=() if pair in chosen else pytest.mark.slow, id=", ".join(pair)) for pair in pairs]


#: Every type of a law's kernel, every law, and every kind of an anisotropic material.
OF_LAWS = [
    ("type 0", "neo_hookean"),
    ("type 0", "one material"),
    ("type 1", "linear"),
    ("type 2", "stvk"),
]
OF_KINDS = [("type 0", "muscle field"), ("type 2", "stiffness field")]


def isotropic_of(discretization):
    return isotropic_material([discretization.mu, discretization.lam, discretization.material_stride])


@pytest.mark.parametrize(("name", "law"), _of_subtrees(OF_LAWS, [*LAWS, "one material"]))
def test_subtrees_one_by_one(name, law, device, rng):
    """All subtrees of a forest, without single leaves; with one material for the last of the laws."""
    uniform = law == "one material"
    law = "neo_hookean" if uniform else law
    mesh = meshed(name)
    given, (mu, lam) = materials(len(mesh.tets), uniform, rng)
    body = wc.SoftBody(mesh, wc.Isotropic(**given), device=device)
    u, x = state(mesh, law, rng)
    on_device = wp.array(u, dtype=wp.vec4, device=device)
    f = wp.zeros_like(on_device)
    plan = ForcePlan.of_forest(mesh, None, wp.get_device(device), grouped=False)
    for batch in plan.batches:
        by_node(batch.subtrees, body.device)
        kernel = scatter_law_subtrees(batch.shape, False, uniform, LAWS[law])
        inputs = [batch.subtrees, isotropic_of(body.discretization), on_device]
        wp.launch(kernel, batch.count, inputs, [f, batch.flagged, NO_LIST], device=device, block_dim=BLOCK)
    inside = np.ones(len(mesh.tets), bool)
    inside[plan.flat.leaves.numpy()] = False
    assert inside.sum() > 100
    mu, lam = (np.broadcast_to(value, inside.shape)[inside] for value in (mu, lam))
    _, expected = oracle.evaluate(law, oracle.Mesh(mesh.points, mesh.tets[inside]), x, mu, lam)
    assert_right(f.numpy()[:, :3], expected)


@pytest.mark.parametrize("uniform", [True, False], ids=["one material", "material per element"])
@pytest.mark.parametrize("law", [*LAWS, "corotated"])
def test_general_elements(law, uniform, device, rng):
    mesh = meshed("general")
    given, (mu, lam) = materials(len(mesh.tets), uniform, rng)
    body = wc.SoftBody(mesh, wc.Isotropic(**given), device=device)
    u, x = state(mesh, law, rng)
    on_device = wp.array(u, dtype=wp.vec4, device=device)
    f = wp.zeros_like(on_device)
    stress = LAWS.get(law) or corotated_stress
    material = isotropic_of(body.discretization)
    add_forces(ClusterScatter(body.discretization.elements, isotropic_law(stress)), material, on_device, f)
    assert_right(f.numpy()[:, :3], oracle.evaluate(law, oracle_mesh(mesh), x, mu, lam)[1])


@pytest.mark.parametrize(("name", "kind"), _of_subtrees(OF_KINDS, ["muscle field", "wood", "stiffness field"]))
def test_anisotropic_subtrees_one_by_one(name, kind, device, rng):
    """Every hundredth node is displaced by an edge and more, so that some leaves of uniform forests need the
    robust rotation; with active stress."""
    mesh = meshed(name)
    material = anisotropic(kind, mesh, rng)
    body = wc.SoftBody(mesh, material, device=device)
    on_device, active = strained(mesh, rng, device)
    whole = AnisotropicField(body.discretization, byers_xu, False)
    axes = quaternions(whole)
    options = ("muscle" in kind, whole.passive.axes_stride == 0, whole.passive.stride == 0)
    plan = ForcePlan.of_forest(mesh, None, wp.get_device(device), grouped=False)
    f, flags, fibres = wp.zeros_like(on_device), 0, with_activation(whole, active)
    for batch in plan.batches:
        by_node(batch.subtrees, body.device)
        kernel = scatter_anisotropic_subtrees(batch.shape, False, *options)
        inputs = [batch.subtrees, Kept(ActiveMaterial, *ACTIVE)(whole.passive, axes, 1, active), on_device]
        wp.launch(kernel, batch.count, inputs, [f, batch.flagged, NO_LIST], device=device, block_dim=BLOCK)
        left = batch.flags_by_eights
        inputs = [8, left, batch.subtrees.first, body.discretization.elements, fibres, on_device]
        wp.launch(repair_leaves, 8 * len(left), inputs=inputs, outputs=[f], device=device)
        flags += np.unpackbits(batch.flagged.numpy()).sum()
    flat = plan.flat
    if len(flat):
        inputs = [plan.elements, flat.leaves, fibres, on_device]
        of_flat = scatter_chosen(ForestElements, FibreMaterial, fibre_stress(quick_rotation))
        wp.launch(of_flat, len(flat), inputs=inputs, outputs=[f], device=device)
    assert flags < 0.3 * len(mesh.tets)
    assert flags > 0 or name == "mixed levels"
    assert_right(f.numpy()[:, :3], leaf_by_leaf(whole, active, on_device))


OGDEN = wc.Ogden((1.4, 0.6), (8.0, -4.0), dilatation="element")


@pytest.mark.parametrize("name", ["type 2", pytest.param("general", marks=pytest.mark.slow)])
@pytest.mark.parametrize("model", [OGDEN, wc.HolzapfelGasserOgden("element")], ids=["ogden", "fibres"])
def test_laws_in_clusters_are_those_leaf_by_leaf(model, name, device, rng):
    """Deterministic sums on CUDA are leaf by leaf; on the CPU eight leaves at a time."""
    mesh = meshed(name)
    given, _ = materials(len(mesh.tets), False, rng)
    law, Material, material = reinforced_law, ReinforcedMaterial, wc.Isotropic(**given)
    if model is OGDEN:
        law, Material = isotropic_law(constitutive.law_functions(model.terms).stress), IsotropicMaterial
    else:
        along, across, _ = random_axes(rng)
        material = wc.FibreReinforced(k1=1e4, k2=5.0, direction=along, across=across, angle=0.5, kappa=0.1, **given)
    body = wc.SoftBody(mesh, material, device=device)
    on_device = wp.array(state(mesh, "corotated", rng)[0], dtype=wp.vec4, device=device)
    found, expected = wp.zeros_like(on_device), wp.zeros_like(on_device)
    field = model.bind(body, deterministic=True)
    field.add_forces(on_device, expected)
    values = field.isotropic if model is OGDEN else field.material
    add_forces(ClusterScatter(body.discretization.elements, law, Material), values, on_device, found)
    assert_right(found.numpy()[:, :3], expected.numpy()[:, :3])


@pytest.mark.parametrize("kind", ["muscle", "wood field", pytest.param("stiffness field", marks=pytest.mark.slow)])
def test_anisotropic_general_elements(kind, device, rng):
    mesh = meshed("general")
    material = anisotropic(kind, mesh, rng)
    body = wc.SoftBody(mesh, material, device=device)
    on_device, active = strained(mesh, rng, device)
    f = wp.zeros_like(on_device)
    field = AnisotropicField(body.discretization, quick_rotation, False)
    axes = quaternions(field)
    law, chosen = anisotropic_law("muscle" in kind), clustered(body.discretization)
    scatter = ClusterScatter(field.elements, law, ActiveMaterial, chosen=chosen, layout=ANISOTROPIC)
    add_forces(scatter, Kept(ActiveMaterial, *ACTIVE)(field.passive, axes, 1, active), on_device, f)
    assert_right(f.numpy()[:, :3], leaf_by_leaf(field, active, on_device))


def quaternions(field):
    axes = wp.empty(len(field.passive.axes), dtype=wp.quat, device=field.device)
    field.launch(quaternions_of, len(axes), [field.passive.axes], [axes])
    return axes


def anisotropic(kind, mesh, rng):
    if kind == "stiffness field":
        return wood(random_axes(rng), young=rng.uniform(0.5, 2, (len(mesh.tets), 1)) * WOOD["young"])
    return made(kind, mesh, rng)[0]


def strained(mesh, rng, device):
    """Displacements, every hundredth node's by an edge and more; and active stress."""
    u, _ = state(mesh, "corotated", rng)
    u[:, :3] += np.where(rng.random((len(mesh.points), 1)) < 0.01, random_displacement(mesh, rng, 1.2), 0)
    active = rng.uniform(0, 1e4, len(mesh.tets))
    return wp.array(u, dtype=wp.vec4, device=device), wp.array(active, dtype=wp.float32, device=device)


def with_activation(field, active):
    fibres = FibreMaterial()
    fibres.passive, fibres.is_active, fibres.activation = field.passive, 1, active
    return fibres


def leaf_by_leaf(field, active, u):
    """Forces [N, 3] of the kernel that test_anisotropy compares with the oracle."""
    f = wp.zeros_like(u)
    kernel = scatter_forces(field.discretization.element_kind, FibreMaterial, fibre_stress(byers_xu))
    inputs = [field.discretization.elements, with_activation(field, active), u]
    wp.launch(kernel, field.element_count, inputs=inputs, outputs=[f], device=u.device)
    return f.numpy()[:, :3]
