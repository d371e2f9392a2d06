"""Kernels that a compiler got wrong: the shipped ones on thousands of elements, every node against float64.

With Warp's own flags LLVM once silently compiled a large unrolled kernel into wrong code: forces were wrong at
some nodes and right at the others. So each shipped kernel runs here on random states, in every lane, for every
leaf of every type of subtree and with partly filled last lanes; and each node is compared. Rounding is some
1e-6 of the largest force, a wrong lane, sign or register at least a hundredth of it.
"""

import numpy as np
import oracle
import pytest
from cases import MODELS, oracle_mesh, place, random_displacement, simulation
from thousands import FORESTS, MATERIAL, TOLERANCE, materials, meshed, shared_rotations, turned

import warp_corot as wc


def hooke_von_mises(reference, x, mu, lam, R):
    """Von Mises stress [T] (Pa) of corotated elements."""
    _, P = oracle.corotated(reference.deformation_gradients(x), mu, lam, R)
    stress = np.swapaxes(R, 1, 2) @ P
    deviator = stress - np.trace(stress, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
    return np.sqrt(1.5 * np.sum(deviator**2, axis=(1, 2)))


def check(sim, body, expected, energies, valid=slice(None)):
    """Forces at every node, and the energy, to which one element contributes some 1e-4."""
    forces = sim.forces().numpy()
    assert np.isfinite(forces).all()
    wrong = np.abs(forces - expected)[valid].max(axis=1) > TOLERANCE * np.abs(expected).max()
    assert not wrong.any(), f"{wrong.sum()} of {wrong.size} nodes"
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=TOLERANCE)


@pytest.mark.parametrize("uniform", [True, False], ids=["one material", "material per element"])
@pytest.mark.parametrize("levels_up", [None, 1, 3, 4, 5])
@pytest.mark.parametrize("name", FORESTS)
def test_corotated_forests(name, levels_up, uniform, device, rng):
    """Own rotations, and rotations one and three to five levels up: leaf by leaf, at the subtree's root, above it."""
    mesh = meshed(name)
    level = None if levels_up is None else int(np.bincount(mesh.levels).argmax()) - levels_up
    material, (mu, lam) = materials(len(mesh.tets), uniform, rng)
    sim, body = simulation(mesh, wc.Corotated(rotation_level=level), device, dt=1e-5, material=material)
    u = turned(mesh, rng, 0.1)
    place(body, u)
    reference, x = oracle_mesh(mesh), mesh.points + u.astype(float)
    own = oracle.polar(reference.deformation_gradients(x))
    R = own if level is None else shared_rotations(mesh, x, level)
    energies, expected = oracle.evaluate("corotated", reference, x, mu, lam, R=R)
    check(sim, body, expected, energies)
    stress = hooke_von_mises(reference, x, mu, lam, R)
    assert np.abs(sim.von_mises() - stress).max() < TOLERANCE * np.max(2 * mu + lam)


@pytest.mark.parametrize("uniform", [True, False], ids=["one material", "material per element"])
def test_corotated_general_elements(uniform, device, rng):
    mesh = meshed("general")
    material, (mu, lam) = materials(len(mesh.tets), uniform, rng)
    sim, body = simulation(mesh, wc.Corotated(), device, dt=1e-5, material=material)
    u = turned(mesh, rng, 0.1)
    place(body, u)
    reference, x = oracle_mesh(mesh), mesh.points + u.astype(float)
    R = oracle.polar(reference.deformation_gradients(x))
    check(sim, body, *reversed(oracle.evaluate("corotated", reference, x, mu, lam, R=R)))
    stress = hooke_von_mises(reference, x, mu, lam, R)
    assert np.abs(sim.von_mises() - stress).max() < TOLERANCE * np.max(2 * mu + lam)


@pytest.mark.parametrize("name", ["type 0", "type 1", "type 2", "general"])
def test_some_elements_are_left_to_the_second_kernel(name, device, rng):
    """Every tenth node is displaced by an edge and more: elements that the fast iteration leaves out lie in lanes
    between those that it handles.

    Nodes of inverted elements whose smaller singular values nearly meet are excluded: they have no definite rotation.
    """
    mesh = meshed(name)
    sim, body = simulation(mesh, wc.Corotated(), device, dt=1e-5, material=MATERIAL)
    chosen = rng.random((len(mesh.points), 1)) < 0.1
    u = np.where(chosen, 15, 1) * random_displacement(mesh, rng, 0.08)
    place(body, u)
    reference, x = oracle_mesh(mesh), mesh.points + u.astype(float)
    F = reference.deformation_gradients(x)
    det = np.linalg.det(F)
    assert 0.01 < (det < 0).mean() < 0.2
    sigma = np.linalg.svd(F, compute_uv=False)
    valid = np.ones(len(mesh.points), bool)
    valid[mesh.tets[sigma[:, 1] + sigma[:, 2] * np.sign(det) < 0.1 * sigma[:, 0]]] = False
    assert valid.mean() > 0.5
    energies, expected = oracle.evaluate("corotated", reference, x, *oracle.lame(1e4, 0.4))
    check(sim, body, expected, energies, valid)


@pytest.mark.parametrize(
    "model",
    [
        wc.Corotated(subtrees=False),
        wc.Corotated(iterations=4),
    ],
    ids=["leaf by leaf", "4 iterations"],
)
def test_other_forms_of_the_corotated_force(model, device, rng):
    mesh = meshed("mixed levels")
    material, (mu, lam) = materials(len(mesh.tets), False, rng)
    sim, body = simulation(mesh, model, device, dt=1e-5, material=material)
    u = turned(mesh, rng, 0.1)
    place(body, u)
    reference = oracle_mesh(mesh)
    check(sim, body, *reversed(oracle.evaluate("corotated", reference, mesh.points + u.astype(float), mu, lam)))


@pytest.mark.parametrize("name", ["mixed levels", "general"])
@pytest.mark.parametrize("model", [model for model in MODELS if model != "corotated"])
def test_other_models(model, name, device, rng):
    mesh = meshed(name)
    material, (mu, lam) = materials(len(mesh.tets), False, rng)
    sim, body = simulation(mesh, model, device, dt=1e-5, material=material)
    u = random_displacement(mesh, rng, 0.1) if model == "linear" else turned(mesh, rng, 0.1)
    place(body, u)
    check(sim, body, *reversed(oracle.evaluate(model, oracle_mesh(mesh), mesh.points + u.astype(float), mu, lam)))
    assert body.masses == pytest.approx(oracle_mesh(mesh).masses(material["density"]), rel=1e-12)
