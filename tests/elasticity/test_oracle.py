"""The oracle itself: against central differences, closed forms and scikit-fem."""

import numpy as np
import oracle
import pytest
from sequential import Bisection

MU, LAM = oracle.lame(500.0, 0.4)


def random_mesh(rng, cells=2):
    """A jittered grid of tetrahedra, every other one wound the wrong way."""
    bisection = Bisection((cells, 1, 1), 1)
    corners = np.array([bisection.points(leaf, 0.1) for leaf in sorted(bisection.leaves)])
    points, inverse = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    tets = inverse.reshape(-1, 4)
    tets[::2] = tets[::2, [1, 0, 2, 3]]
    return oracle.Mesh(points + 0.008 * rng.standard_normal(points.shape), tets)


def deformed(mesh, rng, amount=0.3):
    return mesh.points + amount * 0.1 * rng.standard_normal(mesh.points.shape)


@pytest.mark.parametrize("model", oracle.MODELS)
def test_force_is_minus_energy_gradient(model, rng):
    """Central differences of the energy, error O(h^2): 1e-6 of the largest force. Elements here are also inverted."""
    mesh = random_mesh(rng)
    x = deformed(mesh, rng, 0.6)
    mu, lam = MU * rng.uniform(0.5, 2, len(mesh.tets)), LAM * rng.uniform(0.5, 2, len(mesh.tets))
    if model in oracle.DENSITIES:
        assert np.linalg.det(mesh.deformation_gradients(x)).min() < 0
    _, forces = oracle.evaluate(model, mesh, x, mu, lam)
    h, numerical = 1e-7, np.zeros_like(x)
    for index in np.ndindex(x.shape):
        step = np.zeros_like(x)
        step[index] = h
        plus, minus = (oracle.evaluate(model, mesh, x + s * step, mu, lam)[0].sum() for s in (1, -1))
        numerical[index] = -(plus - minus) / (2 * h)
    assert np.abs(forces - numerical).max() < 1e-6 * np.abs(forces).max()


@pytest.mark.parametrize("model", oracle.TANGENTS)
def test_tangent_is_stress_derivative(model, rng):
    F = np.eye(3) + 0.3 * rng.standard_normal((20, 3, 3))
    tangent, density, h = oracle.TANGENTS[model](F, MU, LAM), oracle.DENSITIES[model], 1e-6
    for k, L in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[k, L] = h
        numerical = (density(F + step, MU, LAM)[1] - density(F - step, MU, LAM)[1]) / (2 * h)
        assert np.abs(tangent[..., k, L] - numerical).max() < 1e-6 * np.abs(tangent).max()


def test_fixed_rotation_force_is_gradient_with_rotation_held(rng):
    mesh = random_mesh(rng)
    x, direction = deformed(mesh, rng, 0.1), rng.standard_normal(mesh.points.shape)
    R = oracle.polar(rng.standard_normal((len(mesh.tets), 3, 3)))

    def energy(t):
        return oracle.evaluate("corotated", mesh, x + t * direction, MU, LAM, R=R)[0].sum()

    _, forces = oracle.evaluate("corotated", mesh, x, MU, LAM, R=R)
    assert -np.sum(forces * direction) == pytest.approx((energy(1e-6) - energy(-1e-6)) / 2e-6, rel=1e-7)


def test_polar_is_the_best_proper_rotation(rng):
    F = rng.standard_normal((200, 3, 3))
    R = oracle.polar(F)
    assert np.allclose(R @ np.swapaxes(R, 1, 2), np.eye(3), atol=1e-13)
    assert np.allclose(np.linalg.det(R), 1, atol=1e-13)
    best = np.einsum("tij,tij->t", R, F)
    for other in oracle.polar(rng.standard_normal((200, 3, 3))):
        assert (np.einsum("ij,tij->t", other, F) <= best + 1e-12).all()


@pytest.mark.parametrize("model", oracle.MODELS)
def test_rigid_motion_gives_no_force(model, rng):
    """A rigid motion gives no force; for linear elasticity, this holds only for translations."""
    mesh = random_mesh(rng)
    turn = np.eye(3) if model == "linear" else oracle.polar(rng.standard_normal((3, 3)))
    energies, forces = oracle.evaluate(model, mesh, mesh.points @ turn.T + [0.3, -0.1, 0.2], MU, LAM)
    assert np.abs(forces).max() < 1e-12 * MU * 0.1**2 * 100
    assert np.abs(energies).max() < 1e-14 * MU * 0.1**3


@pytest.mark.parametrize("model", [model for model in oracle.MODELS if model != "mass_spring"])
def test_small_strain_limit(model, rng):
    """Every continuum model and both edge springs have the small-strain stiffness as their tangent at rest."""
    mesh = random_mesh(rng)
    u = 1e-7 * 0.1 * rng.standard_normal(mesh.points.shape)
    _, forces = oracle.evaluate(model, mesh, mesh.points + u, MU, LAM)
    expected = -np.einsum("tpq,tq->tp", oracle.stiffness(mesh, MU, LAM), u[mesh.tets].reshape(-1, 12))
    expected = mesh.assemble(expected.reshape(-1, 4, 3))
    # the springs' forces are differences of lengths near 0.1, so rounding is 1e-16/1e-7 per operation
    assert np.abs(forces - expected).max() < 1e-6 * np.abs(expected).max()


def test_mass_spring_is_poisson_quarter_on_average(rng):
    """Over random edge directions the springs store the energy of E and nu = 1/4, for any nu of the material."""
    corners = oracle.polar(rng.standard_normal((20000, 3, 3))) @ rng.standard_normal((3, 4))
    points = np.swapaxes(corners, 1, 2)
    mesh = oracle.Mesh(points.reshape(-1, 3), np.arange(80000).reshape(-1, 4))
    strain = rng.standard_normal((3, 3))
    strain = 1e-5 * (strain + strain.T)
    young = 700.0
    stored, _ = oracle.mass_spring(mesh, mesh.points @ (np.eye(3) + strain), *oracle.lame(young, 0.4))
    expected, _ = oracle.hooke(strain, *oracle.lame(young, 0.25))
    assert stored.sum() / mesh.volumes.sum() == pytest.approx(expected, rel=0.01)


def test_edge_springs_equal_st_venant_kirchhoff(rng):
    mesh = random_mesh(rng)
    x = deformed(mesh, rng)
    energies, forces = oracle.evaluate("edge_stvk", mesh, x, MU, LAM)
    expected_energies, expected_forces = oracle.evaluate("stvk", mesh, x, MU, LAM)
    assert np.allclose(energies, expected_energies, rtol=1e-12)
    assert np.abs(forces - expected_forces).max() < 1e-12 * np.abs(forces).max()


@pytest.mark.parametrize("model", oracle.DENSITIES)
def test_patch(model, rng):
    """A homogeneous deformation leaves every interior node without force."""
    bisection = Bisection((2, 2, 2), 3)
    corners = np.array([bisection.points(leaf) for leaf in bisection.leaves]).reshape(-1, 3)
    points, inverse = np.unique(corners, axis=0, return_inverse=True)
    interior = ((points > 0) & (points < 2)).all(1)
    points[interior] += 0.02 * rng.standard_normal((interior.sum(), 3))
    mesh = oracle.Mesh(points, inverse.reshape(-1, 4))
    F = np.eye(3) + 0.2 * rng.standard_normal((3, 3))
    _, forces = oracle.evaluate(model, mesh, points @ F.T + [1.0, 2.0, 3.0], MU, LAM)
    assert interior.sum() > 5
    assert np.abs(forces[interior]).max() < 1e-12 * np.abs(forces).max()


@pytest.mark.parametrize(
    ("model", "pull"),
    [
        ("linear", lambda s, E: E * (s - 1)),
        ("corotated", lambda s, E: E * (s - 1)),
        ("stvk", lambda s, E: E * s * (s**2 - 1) / 2),
    ],
)
@pytest.mark.parametrize("s", [0.8, 1.3])
def test_uniaxial_bar(model, pull, s):
    """Stretched by s with free sides: P11 = E e, with e = s - 1, or s (E e) with e = (s^2 - 1)/2."""
    young, poisson = 500.0, 0.4
    e = (s**2 - 1) / 2 if model == "stvk" else s - 1
    lateral = np.sqrt(1 - 2 * poisson * e) if model == "stvk" else 1 - poisson * e
    _, P = oracle.DENSITIES[model](np.diag([s, lateral, lateral])[None], *oracle.lame(young, poisson))
    assert P[0] == pytest.approx(np.diag([pull(s, young), 0, 0]), abs=1e-9 * young)


def test_neo_hookean_incompressible_limit():
    """As nu -> 1/2 a bar under uniaxial stretch s pulls with mu (s - 1/s^2)."""
    s, (mu, lam) = 1.5, oracle.lame(3.0, 0.4999999)
    J = 1 + mu * (1 - 1 / s) / lam  # no lateral stress: lam ln J = mu (1 - t^2), and t^2 = 1/s to first order in 1/lam
    t = np.sqrt(J / s)
    _, P = oracle.neo_hookean(np.diag([s, t, t])[None], mu, lam)
    assert P[0, 1, 1] == pytest.approx(0, abs=1e-5)
    assert P[0, 0, 0] == pytest.approx(mu * (s - s**-2), rel=1e-5)


def test_neo_hookean_continuation_is_smooth():
    """U(J) continues through J0 = 0.5 with its value and first two derivatives, a parabola that falls throughout."""
    mu, lam = 2.0, 5.0
    below, above = (oracle.neo_hookean_volumetric(np.array(0.5 + d), mu, lam) for d in (-1e-9, 1e-9))
    assert below == pytest.approx(above, rel=1e-6)
    U, dU, ddU = oracle.neo_hookean_volumetric(np.linspace(-3, 0.5, 2001), mu, lam)
    assert np.allclose(np.gradient(U, 3.5 / 2000)[1:-1], dU[1:-1])
    assert (dU < 0).all()
    assert np.allclose(ddU, 4 * (mu + lam * (1 + np.log(2))))
    log = np.log(1.7)
    assert oracle.neo_hookean_volumetric(np.array(1.7), mu, lam)[0] == pytest.approx(-mu * log + lam / 2 * log**2)


def test_stiffness_agrees_with_scikit_fem(rng):
    skfem = pytest.importorskip("skfem")
    from skfem.models.elasticity import linear_elasticity

    mesh = random_mesh(rng)
    basis = skfem.Basis(skfem.MeshTet(mesh.points.T, mesh.tets.T), skfem.ElementVector(skfem.ElementTetP1()))
    expected = linear_elasticity(Lambda=float(LAM), Mu=float(MU)).assemble(basis).toarray()
    dofs = basis.nodal_dofs.T.ravel()
    expected = expected[np.ix_(dofs, dofs)]
    ours = oracle.tangent_matrix("linear", mesh, mesh.points, MU, LAM).toarray()
    assert np.abs(ours - expected).max() < 1e-12 * np.abs(expected).max()
    K = np.zeros_like(ours)
    for element, tet in zip(oracle.stiffness(mesh, MU, LAM), mesh.tets, strict=True):
        dof = (3 * tet[:, None] + np.arange(3)).ravel()
        K[np.ix_(dof, dof)] += element
    assert np.abs(K - expected).max() < 1e-12 * np.abs(expected).max()


def test_st_venant_kirchhoff_agrees_with_scikit_fem(rng):
    """The virtual work of StVK's P, written as a scikit-fem form with the displacement as a discrete field."""
    skfem = pytest.importorskip("skfem")
    from skfem.helpers import ddot, grad, identity, mul, trace, transpose

    mesh = random_mesh(rng)
    basis = skfem.Basis(skfem.MeshTet(mesh.points.T, mesh.tets.T), skfem.ElementVector(skfem.ElementTetP1()))

    @skfem.LinearForm
    def virtual_work(v, w):
        F = grad(w["u"]) + identity(grad(w["u"]))
        E = 0.5 * (mul(transpose(F), F) - identity(F))
        return ddot(mul(F, 2 * float(MU) * E + float(LAM) * trace(E) * identity(E)), grad(v))

    x = deformed(mesh, rng, 0.1)
    dofs, u = basis.nodal_dofs.T, np.zeros(basis.N)
    u[dofs] = x - mesh.points
    expected = -virtual_work.assemble(basis, u=basis.interpolate(u))[dofs]
    _, forces = oracle.evaluate("stvk", mesh, x, MU, LAM)
    assert np.abs(forces - expected).max() < 1e-12 * np.abs(expected).max()


@pytest.mark.parametrize("model", oracle.TANGENTS)
def test_equilibrium_balances_the_load(model, rng):
    mesh = random_mesh(rng)
    fixed = mesh.points[:, 0] < 0.05
    loads = np.where(fixed[:, None], 0, 0.02 * rng.standard_normal(mesh.points.shape))
    x = oracle.equilibrium(model, mesh, MU, LAM, fixed, loads)
    _, forces = oracle.evaluate(model, mesh, x, MU, LAM)
    assert np.array_equal(x[fixed], mesh.points[fixed])
    assert np.abs(x - mesh.points).max() > 1e-3
    assert np.abs((forces + loads)[~fixed]).max() < 1e-10 * np.abs(loads).max()
    assert forces[fixed].sum(0) == pytest.approx(loads.sum(0), abs=1e-9)


def test_bisection_counts_and_conformity(rng):
    """Random refinement fills the box and stays conforming: no vertex lies in the middle of a leaf's edge."""
    assert len(Bisection((1, 1, 3), 6).leaves) == 1152
    bisection = Bisection((2, 1, 1), 2)
    for _ in range(40):
        leaves = sorted(bisection.leaves)
        bisection.refine(leaves[rng.integers(len(leaves))])
    vertices = {vertex for leaf in bisection.leaves for vertex in leaf[1:]}
    volume = 0.0
    for leaf in bisection.leaves:
        corners = bisection.points(leaf)
        volume += abs(np.linalg.det(corners[1:] - corners[0])) / 6
        for edge in bisection._edges(leaf):
            a, b = edge
            assert tuple((p + q) // 2 for p, q in zip(a, b, strict=True)) not in vertices
    assert volume == pytest.approx(2.0)
    assert len({leaf[0] for leaf in bisection.leaves}) > 2
