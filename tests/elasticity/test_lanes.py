"""Elements side by side in the lanes of a CPU's registers do what each does alone: fibres, Prony series, viscosity."""

import numpy as np
import pytest
import warp as wp
from cases import mixed_forest, random_displacement
from fibres import random_axes

import warp_corot as wc
from warp_corot.elasticity.added_stress import Viscosity
from warp_corot.kernels.corotated.anisotropic import REINFORCED, ReinforcedMaterial
from warp_corot.kernels.elements.added import PronyMaterial, ViscousMaterial, relax, viscosity_stress
from warp_corot.kernels.elements.forces import element_law, scatter_forces
from warp_corot.kernels.elements.simd8 import LANES, PRONY

#: General meshes are the same code of another kind of elements, and compile for seconds.
KINDS = [False, pytest.param(True, marks=pytest.mark.slow)]


def mesh_of(is_general):
    """Elements of all types, or the same as general ones; the last lanes are empty."""
    forest = mixed_forest()
    assert len(forest.tets) % LANES
    return wc.TetMesh(forest.points, forest.tets) if is_general else forest


def isotropic(mesh, rng, amount):
    """A strained body, each of whose elements has its own modulus."""
    young = rng.uniform(1e4, 1e5, len(mesh.tets))
    body = wc.SoftBody(mesh, wc.Isotropic(young, 0.3, 1000.0), device="cpu")
    body.displacements = random_displacement(mesh, rng, amount)
    return body


def assert_as_alone(body, field, material, kind_of_material, stress, add_forces, tolerance=1e-5):
    """Forces that are added eight at a time are those of the stress of one element after another."""
    u, kind = body.state.displacements, body.discretization.element_kind
    expected, found = (wp.zeros_like(body.state.forces) for _ in range(2))
    alone = scatter_forces(kind, kind_of_material, stress)
    wp.launch(alone, len(body.mesh.tets), [field.elements, material, u], [expected], device="cpu")
    add_forces(u, found)
    atol = tolerance * np.abs(expected.numpy()).max()
    np.testing.assert_allclose(found.numpy(), expected.numpy(), rtol=0, atol=atol)


@pytest.mark.parametrize("is_general", [False, True])
@pytest.mark.parametrize("amount", [1e-4, 0.1, 1.0])
def test_fibres(is_general, amount, rng):
    """Each element has its own material, axes, angle and active stress; some are turned inside out."""
    mesh = mesh_of(is_general)
    count, axes = len(mesh.tets), random_axes(rng, len(mesh.tets))
    numbers = {
        "young": rng.uniform(100, 900, count),
        "k1": rng.uniform(100, 400, count),
        "k2": np.where(rng.uniform(size=count) < 0.1, 1e-8, rng.uniform(0.5, 50, count)),
        "kappa": rng.uniform(0, 0.3, count),
        "angle": np.where(rng.uniform(size=count) < 0.3, 0.0, rng.uniform(0, np.pi / 2, count)),
    }
    directions = {"direction": axes[..., 0, :], "across": axes[..., 1, :]}
    body = wc.SoftBody(mesh, wc.FibreReinforced(poisson=0.4, density=10.0, **numbers, **directions), device="cpu")
    body.activation.assign(rng.uniform(0, 300, count).astype(np.float32))
    body.displacements = random_displacement(mesh, rng, amount)
    field = wc.HolzapfelGasserOgden(dilatation="element").bind(body)
    assert_as_alone(body, field, field.material, ReinforcedMaterial, REINFORCED.stress, field.add_forces)


@pytest.mark.filterwarnings("ignore::warp_corot.StabilityWarning")  # its step is a time that passes
@pytest.mark.parametrize("is_general", KINDS)
def test_prony_series(is_general, rng):
    """Each element has its own history, whose relaxation is that of one element after another, too."""
    body = isotropic(mesh_of(is_general), rng, 0.3)
    field = wc.Prony((0.5, 1.5), (0.02, 0.3), wc.Corotated(dilatation="element")).bind(body)
    material, u = field.material, body.state.displacements
    material.known.assign(rng.normal(scale=0.1, size=len(material.known)).astype(np.float32))
    material.elapsed.fill_(0.01)
    stress = element_law(PRONY.code, PronyMaterial).stress
    assert_as_alone(body, field, material, PronyMaterial, stress, field.add_own_forces)

    pace = wc.Simulation(body, integrator=wc.SymplecticEuler(dt=0.01)).pace.arrays
    before, kind = material.known.numpy(), body.discretization.element_kind
    wp.launch(relax(kind), len(body.mesh.tets), [field.elements, u, pace, material], [], device="cpu")
    after = material.known.numpy()
    material.known.assign(before)
    field.complete_step(u, pace)
    np.testing.assert_allclose(material.known.numpy(), after, rtol=0, atol=1e-5 * np.abs(after).max())


@pytest.mark.parametrize("is_general", KINDS)
@pytest.mark.parametrize("amount", [0.0, 0.05, 1.0])
def test_viscosity(is_general, amount, rng):
    """Strained until some elements are turned inside out."""
    body = isotropic(mesh_of(is_general), rng, amount)
    body.velocities = rng.normal(size=body.mesh.points.shape)
    field, material = wc.Corotated().bind(body), ViscousMaterial()
    material.isotropic, material.seconds, material.velocities = field.isotropic, 0.1, body.state.velocities

    def add_forces(u, f):
        Viscosity(body, field, 0.1).add_forces()
        wp.copy(f, body.state.forces)

    assert_as_alone(body, field, material, ViscousMaterial, viscosity_stress, add_forces, tolerance=2e-5)
    rest, now = (np.linalg.det(np.diff(x[body.mesh.tets], axis=1)) for x in (body.mesh.points, body.positions.numpy()))
    assert (now / rest < 0.0).any() == (amount == 1.0)
