"""Transversely isotropic and orthotropic materials under the corotated model: float64 oracle, laws, closed forms."""

import numpy as np
import oracle
import pytest
from cases import MESHES, jittered, oracle_mesh, place, random_displacement
from fibres import (
    DENSITY,
    MUSCLE,
    WOOD,
    Bar,
    made,
    muscle,
    random_axes,
    simulated,
    turned,
    wood,
    wood_tensor,
)

import warp_corot as wc

TOLERANCE = 1e-5  # of the largest nodal force: rounding, see test_forces
FORCE_MESHES = ("level 3", "level 4", "level 5", "mixed levels", "general")
KINDS = ("muscle", "wood", "muscle field", "wood field")


def turned_displacement(mesh, rng, amount):
    u = random_displacement(mesh, rng, amount)
    return ((mesh.points + u) @ random_axes(rng).T - mesh.points).astype(np.float32)


def everywhere(tensor, mesh):
    return np.broadcast_to(tensor, (len(mesh.tets), 3, 3, 3, 3))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", FORCE_MESHES)
def test_forces_and_energy_equal_the_oracle(name, kind, device, rng):
    """Strains around 0.3, with a large rotation."""
    mesh = MESHES[name]()
    material, tensor = made(kind, mesh, rng)
    sim, body = simulated(mesh, material, device)
    u = turned_displacement(mesh, rng, 0.1)
    place(body, u)
    x = mesh.points + u.astype(float)
    energies, forces = oracle.continuum(oracle.anisotropic, oracle_mesh(mesh), x, everywhere(tensor, mesh), None)
    assert np.abs(sim.forces().numpy() - forces).max() < TOLERANCE * np.abs(forces).max()
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=TOLERANCE)


@pytest.mark.parametrize("name", ["level 3", "general"])
def test_crushed_and_inverted_elements_equal_the_oracle(name, device, rng):
    """Displacements of a whole edge. Undefined rotations do not matter here: the law blends into an isotropic one,
    and its force is the derivative of its energy everywhere."""
    mesh = MESHES[name]()
    material, tensor = made("wood field", mesh, rng)
    sim, body = simulated(mesh, material, device)
    u = random_displacement(mesh, rng, 0.9)
    place(body, u)
    x = mesh.points + u.astype(float)
    F = oracle_mesh(mesh).deformation_gradients(x)
    assert (np.linalg.det(F) < -0.1).sum() > 5
    energies, forces = oracle.continuum(oracle.anisotropic, oracle_mesh(mesh), x, tensor, None)
    assert np.abs(sim.forces().numpy() - forces).max() < TOLERANCE * np.abs(forces).max()
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=TOLERANCE)


def test_single_elements_of_all_stretches(device, rng):
    """Elements without common nodes, compared one by one: those that the fast iteration handles, those that it leaves
    out, and those flattened to where the law blends into the isotropic one."""
    count = 2003
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]) + rng.uniform(-0.1, 0.1, (count, 4, 3))
    mesh = wc.TetMesh(corners.reshape(-1, 3), np.arange(4 * count).reshape(-1, 4))
    stretches = np.exp(rng.uniform(np.log(0.2), np.log(5.0), (count, 3)))
    a, b, c = np.moveaxis(stretches, 1, 0)
    definite = (a + b) * (b + c) * (c + a) / np.linalg.norm(stretches, axis=1) ** 3
    assert (definite < 0.4).sum() > 100
    assert (definite > 0.5).sum() > 1000
    F = random_axes(rng, count) * stretches[:, None] @ random_axes(rng, count)
    material, tensor = made("wood field", mesh, rng)
    sim, body = simulated(mesh, material, device)
    u = (corners @ np.swapaxes(F, 1, 2)).reshape(-1, 3) - mesh.points
    place(body, u)
    x = mesh.points + body.displacements.numpy().astype(float)
    _, forces = oracle.continuum(oracle.anisotropic, oracle_mesh(mesh), x, tensor, None)
    off, scale = (np.abs(f).reshape(count, -1).max(axis=1) for f in (sim.forces().numpy() - forces, forces))
    # Differences of the oracle's energy are not valid across the kink in its second derivative.
    wrong = (off > TOLERANCE * scale) & (np.abs(definite - 0.4) > 0.01)
    assert not wrong.any(), f"{wrong.sum()} of {count} elements"


@pytest.mark.parametrize("stretches", [(3.2, 3.2**-0.5, 3.2**-0.5), (0.4, 0.4, 0.4), (1.5, 0.9, 0.02), (2.0, 0.3, 1.5)])
def test_energy_of_a_stretched_body(stretches, device, rng):
    """V/2 e : C : e with e the principal stretches minus one: the law holds at these strains, too."""
    mesh = MESHES["general"]()
    material, C = made("wood", mesh, rng)
    V = random_axes(rng)
    e = V @ np.diag(np.array(stretches) - 1) @ V.T
    sim, body = simulated(mesh, material, device)
    body.displacements = mesh.points @ (random_axes(rng) @ (e + np.eye(3))).T - mesh.points
    expected = 0.5 * np.einsum("ij,ijkl,kl->", e, C, e) * mesh.volumes.sum()
    assert sim.energy().elastic == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("kind", ["muscle field", "wood"])
@pytest.mark.parametrize("general", [False, True])
def test_thousands_of_elements_node_by_node(general, kind, device, rng):
    """Every tenth node is far displaced, so that elements for the second kernel lie in lanes between those of the fast
    one, and eight does not divide the number of elements: a wrong lane or register shows."""
    mesh = wc.TetForest.box((1, 1, 1), 0.1, 9)
    if general:
        mesh = jittered(cells=(1, 1, 1), level=9)
        mesh = wc.TetMesh(mesh.points, mesh.tets[:-3])
    material, tensor = made(kind, mesh, rng)
    sim, body = simulated(mesh, material, device)
    chosen = rng.random((len(mesh.points), 1)) < 0.1
    u = np.where(chosen, 15, 1) * random_displacement(mesh, rng, 0.08)
    place(body, u)
    x = mesh.points + u.astype(float)
    assert 0.01 < (np.linalg.det(oracle_mesh(mesh).deformation_gradients(x)) < 0).mean() < 0.2
    energies, forces = oracle.continuum(oracle.anisotropic, oracle_mesh(mesh), x, everywhere(tensor, mesh), None)
    wrong = np.abs(sim.forces().numpy() - forces).max(axis=1) > TOLERANCE * np.abs(forces).max()
    assert not wrong.any(), f"{wrong.sum()} of {wrong.size} nodes"
    assert sim.energy().elastic == pytest.approx(energies.sum(), rel=TOLERANCE)


def net(mesh, u, forces):
    """Net force over the sum of all, and net torque over the sum of all times the radius of the body."""
    x = mesh.points + u.astype(float)
    arm = x - x.mean(axis=0)
    total = np.linalg.norm(forces, axis=1).sum()
    torque = np.linalg.norm(np.cross(arm, forces).sum(axis=0))
    return np.linalg.norm(forces.sum(axis=0)) / total, torque / (total * np.linalg.norm(arm, axis=1).max())


@pytest.mark.parametrize("amount", [0.1, 0.3, 0.9])
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", ["level 0", "general"])
def test_no_net_force_and_no_torque(name, kind, amount, device, rng):
    mesh = MESHES[name]()
    sim, body = simulated(mesh, made(kind, mesh, rng)[0], device)
    u = turned_displacement(mesh, rng, amount)
    place(body, u)
    force, torque = net(mesh, u, sim.forces().numpy().astype(float))
    assert force < 1e-6
    assert torque < 1e-6


@pytest.mark.parametrize("name", ["mixed levels", "general"])
def test_isotropic_constants_give_the_isotropic_law(name, device, rng):
    """Forces, energy, von Mises stress and stable step equal those of ``Corotated``, for inverted elements, too."""
    mesh = MESHES[name]()
    young, nu = 5e3, 0.4
    shear = young / (2 * (1 + nu))
    materials = (
        wc.TransverselyIsotropic(young, young, nu, nu, shear, rng.standard_normal((len(mesh.tets), 3)), DENSITY),
        wc.Orthotropic([young] * 3, [nu] * 3, [shear] * 3, random_axes(rng), DENSITY),
    )
    isotropic, reference = simulated(mesh, wc.Isotropic(young, nu, DENSITY), device)
    for material in materials:
        sim, body = simulated(mesh, material, device)
        # The iteration stops before the last digits.
        assert sim.stable_dt == pytest.approx(isotropic.stable_dt, rel=1e-3)
        for amount in (0.1, 0.9):
            u = turned_displacement(mesh, rng, amount)
            place(body, u)
            place(reference, u)
            expected, stress = isotropic.forces().numpy(), isotropic.von_mises()
            assert np.abs(sim.forces().numpy() - expected).max() < TOLERANCE * np.abs(expected).max()
            assert sim.energy().elastic == pytest.approx(isotropic.energy().elastic, rel=TOLERANCE)
            assert np.abs(sim.von_mises() - stress).max() < TOLERANCE * stress.max()


@pytest.mark.parametrize("angle", [0, 30, 90])
def test_bar_under_tension(angle, device):
    """Fibres at an angle to the pull: stretch, lateral contraction and shear follow the compliance.

    Along the pull 1/E = c^4/E_f + s^4/E_t + (1/G - 2 nu/E_f) s^2 c^2. Strains of 1e-3 are linear to some 1e-3.
    """
    c, s = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    E_f, E_t, nu, nu_t, G = MUSCLE.values()
    modulus = 1 / (c**4 / E_f + s**4 / E_t + (1 / G - 2 * nu / E_f) * s**2 * c**2)
    bar = Bar(muscle([0, s, c]), device)
    bar.pull(1e-3 * modulus)
    strain, spread = bar.strain()
    assert strain[2, 2] == pytest.approx(1e-3, rel=3e-3)
    # Across fibres and pull: -nu times the fibres' share and -nu_t times the other's.
    assert strain[0, 0] == pytest.approx(-1e-3 * modulus * (c**2 * nu / E_f + s**2 * nu_t / E_t), rel=5e-3)
    axes = np.array([[0, s, c], [0, c, -s], [1, 0, 0]])
    sigma = np.zeros((3, 3))
    sigma[2, 2] = 1e-3 * modulus
    stresses = (axes @ sigma @ axes.T)[tuple(np.transpose(oracle.VOIGT))]
    local = oracle.compliance(*oracle.transverse(*MUSCLE.values())) @ stresses
    expected = np.zeros((3, 3))
    for (i, j), e in zip(oracle.VOIGT, local, strict=True):
        expected[i, j] = expected[j, i] = e if i == j else e / 2
    assert np.abs(strain - axes.T @ expected @ axes).max() < 5e-6
    assert spread < 5e-6


def test_orthotropic_bar_along_each_axis(device):
    """Pulled along axis i: E_i, and contractions nu_ij along the others."""
    young, ratios = np.array(WOOD["young"]), WOOD["poisson"]
    nu = {(0, 1): ratios[0], (0, 2): ratios[1], (1, 2): ratios[2]}
    nu |= {(j, i): value * young[j] / young[i] for (i, j), value in nu.items()}
    for i in range(3):
        others = [j for j in range(3) if j != i]
        axes = np.zeros((3, 3))
        axes[i, 2] = axes[others[0], 0] = axes[others[1], 1] = 1.0
        bar = Bar(wood(axes), device)
        bar.pull(1e-3 * young[i])
        strain, _ = bar.strain()
        expected = [-1e-3 * nu[i, others[0]], -1e-3 * nu[i, others[1]], 1e-3]
        assert np.diag(strain) == pytest.approx(expected, rel=5e-3)


def test_stiffness_is_the_inverse_of_the_compliance(rng):
    """Nine constants against the inverse of the 6x6 matrix; the nearest isotropic material against the mean of C over
    many rotations."""
    axes = random_axes(rng)
    material, C = wood(axes), wood_tensor(axes)
    frame = material.frames()
    assert np.linalg.det(frame) == pytest.approx(1)
    own = turned(C, frame)
    found = [own[i, i, i, i] for i in range(3)]
    found += [own[i, i, j, j] for i, j in ((0, 1), (0, 2), (1, 2))] + [
        own[i, j, i, j] for i, j in ((0, 1), (0, 2), (1, 2))
    ]
    assert material.stiffness() == pytest.approx(found, rel=1e-10)
    samples = turned(C, random_axes(rng, 20000)).mean(axis=0)
    near = material.isotropic
    assert samples[0, 1, 0, 1] == pytest.approx(near.mu, rel=0.02)
    assert samples[0, 0, 1, 1] == pytest.approx(near.lam, rel=0.03)
    assert (near.mu, near.lam) == pytest.approx(oracle.nearest_isotropic(C), rel=1e-10)


@pytest.mark.parametrize("name", ["level 3", "general"])
def test_nothing_becomes_nan(name, device, rng):
    """Crushed to a plane, a line and a point, mirrored, tiny and huge: finite forces, and zero ones at zero."""
    mesh = MESHES[name]()
    sim, body = simulated(mesh, made("wood field", mesh, rng)[0], device)
    for stretch in (
        [1, 1, 0],
        [1, 0, 0],
        [0, 0, 0],
        [1, 1, -1],
        [-1, -1, -1],
        [1e-20] * 3,
        [1e12] * 3,
        [1, 1e-9, -1e-9],
    ):
        body.displacements = mesh.points * (np.array(stretch) - 1.0)
        assert np.isfinite(sim.forces().numpy()).all(), stretch
        assert np.isfinite(sim.energy().elastic), stretch
        assert np.isfinite(sim.von_mises()).all(), stretch


def test_rotations_by_the_singular_value_decomposition(device, rng):
    mesh = MESHES["general"]()
    material, tensor = made("wood field", mesh, rng)
    sim, body = simulated(mesh, material, device, model=wc.Corotated(rotation="svd"))
    u = turned_displacement(mesh, rng, 0.1)
    place(body, u)
    _, forces = oracle.continuum(oracle.anisotropic, oracle_mesh(mesh), mesh.points + u.astype(float), tensor, None)
    assert np.abs(sim.forces().numpy() - forces).max() < TOLERANCE * np.abs(forces).max()
