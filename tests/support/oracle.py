"""The reference mathematics of the solver: float64 NumPy, from points [N, 3] and tetrahedra [T, 4] alone.

Nothing here knows types, levels, frames or Warp. Material parameters ``mu`` and ``lam`` [Pa] are scalars or
arrays [T]. A density is a function ``(F, mu, lam) -> psi [T] (J/m^3), P [T, 3, 3] (Pa)`` of the deformation
gradients F [T, 3, 3].
"""

from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.linalg import spsolve

EDGES = tuple(combinations(range(4), 2))
IDENTITY = np.eye(3)
LEVI_CIVITA = np.array([[[(i - j) * (j - k) * (k - i) / 2 for k in range(3)] for j in range(3)] for i in range(3)])


def lame(young, poisson):
    """mu and lambda [Pa]."""
    young, poisson = np.asarray(young, float), np.asarray(poisson, float)
    return young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))


# --- geometry ---------------------------------------------------------------------------------------------------------


@dataclass
class Mesh:
    """Rest points [N, 3], tetrahedra [T, 4] of either winding, volumes [T] and hat function gradients [T, 4, 3]."""

    points: np.ndarray
    tets: np.ndarray
    volumes: np.ndarray = field(init=False)
    gradients: np.ndarray = field(init=False)

    def __post_init__(self):
        self.points, self.tets = np.asarray(self.points, float), np.asarray(self.tets)
        corners = self.points[self.tets]
        edges = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)  # columns x1 - x0, x2 - x0, x3 - x0
        inverse = np.linalg.inv(edges)
        self.volumes = np.abs(np.linalg.det(edges)) / 6
        self.gradients = np.concatenate([-inverse.sum(1, keepdims=True), inverse], axis=1)

    def deformation_gradients(self, x):
        """F_iJ = sum_a x_ai dN_a/dX_J, for deformed positions x [N, 3]."""
        return np.einsum("tai,taJ->tiJ", np.asarray(x, float)[self.tets], self.gradients)

    def assemble(self, element_vectors):
        """Sum of per-element nodal vectors [T, 4, 3] at the nodes [N, 3]."""
        total = np.zeros_like(self.points)
        np.add.at(total, self.tets, element_vectors)
        return total

    def masses(self, density):
        """Lumped nodal masses [kg]: a quarter of each element's mass to each of its nodes."""
        total = np.zeros(len(self.points))
        np.add.at(total, self.tets, np.broadcast_to((density * self.volumes / 4)[:, None], self.tets.shape))
        return total

    def volume(self, x):
        """Signed volume of the deformed mesh [m^3]."""
        return float(np.sum(np.linalg.det(self.deformation_gradients(x)) * self.volumes))


def polar(F):
    """The rotation [..., 3, 3] with det +1 that maximises tr(R^T F), by SVD; F finite, mirrored or singular."""
    U, _, Vt = np.linalg.svd(F)
    U[..., :, 2] *= np.sign(np.linalg.det(U) * np.linalg.det(Vt))[..., None]
    return U @ Vt


# --- elastic energies -------------------------------------------------------------------------------------------------


def _transpose(A):
    return np.swapaxes(A, -1, -2)


def _trace(A):
    return np.trace(A, axis1=-2, axis2=-1)


def _times(scalar, A):
    return np.asarray(scalar)[..., None, None] * A


def hooke(strain, mu, lam):
    """W = mu e:e + lam/2 tr(e)^2 and the stress 2 mu e + lam tr(e) I."""
    trace = _trace(strain)
    psi = mu * np.sum(strain**2, axis=(-2, -1)) + 0.5 * lam * trace**2
    return psi, _times(2 * np.asarray(mu), strain) + _times(lam * trace, IDENTITY)


def linear(F, mu, lam):
    return hooke(0.5 * (F + _transpose(F)) - IDENTITY, mu, lam)


def corotated(F, mu, lam, R=None):
    """Strain sym(R^T F) - I; R [T, 3, 3] is the element's own rotation unless given (a shared one, held fixed)."""
    R = polar(F) if R is None else R
    stretch = _transpose(R) @ F
    psi, stress = hooke(0.5 * (stretch + _transpose(stretch)) - IDENTITY, mu, lam)
    return psi, R @ stress


def stvk(F, mu, lam):
    psi, stress = hooke(0.5 * (_transpose(F) @ F - IDENTITY), mu, lam)
    return psi, F @ stress


def neo_hookean_volumetric(J, mu, lam, J0=0.5):
    """U(J) = -mu ln J + lam/2 (ln J)^2 for J >= J0, its Taylor polynomial of order 2 about J0 below; U', U''."""
    above = np.maximum(J, J0)
    step = np.minimum(J - J0, 0.0)
    log = np.log(above)
    value = -mu * log + 0.5 * lam * log**2
    slope = (lam * log - mu) / above
    curvature = (mu + lam * (1 - log)) / above**2
    return value + step * (slope + 0.5 * curvature * step), slope + curvature * step, curvature


def cofactor(F):
    return 0.5 * np.einsum("ikm,JLN,...kL,...mN->...iJ", LEVI_CIVITA, LEVI_CIVITA, F, F)


def neo_hookean(F, mu, lam):
    U, dU, _ = neo_hookean_volumetric(np.linalg.det(F), mu, lam)
    psi = 0.5 * mu * (np.sum(F**2, axis=(-2, -1)) - 3) + U
    return psi, _times(mu, F) + _times(dU, cofactor(F))


def continuum(density, mesh, x, mu, lam, **options):
    """Energies [T] (J) and nodal forces [N, 3] (N) of a density: W = V psi, f_a = -V P grad N_a."""
    psi, P = density(mesh.deformation_gradients(x), mu, lam, **options)
    forces = -np.einsum("t,tiJ,taJ->tai", mesh.volumes, P, mesh.gradients)
    return mesh.volumes * psi, mesh.assemble(forces)


def edge_lengths(mesh, x):
    """Edge vectors x_j - x_i [T, 6, 3] in the order of EDGES, and their lengths [T, 6]."""
    corners = np.asarray(x, float)[mesh.tets]
    i, j = np.transpose(EDGES)
    vectors = corners[:, j] - corners[:, i]
    return vectors, np.linalg.norm(vectors, axis=-1)


def edge_stiffness(mesh, mu, lam):
    """K_ef [T, 6, 6] of the St. Venant-Kirchhoff energy W = 1/2 sum K_ef D_e D_f, D = l^2 - L^2."""
    i, j = np.transpose(EDGES)
    dots = np.einsum("taJ,tbJ->tab", mesh.gradients, mesh.gradients)
    c = dots[:, i, j]
    shear = dots[:, i[:, None], i] * dots[:, j[:, None], j] + dots[:, i[:, None], j] * dots[:, j[:, None], i]
    dilation = c[:, :, None] * c[:, None, :]
    quarter = mesh.volumes / 4
    return _times(quarter * lam, dilation) + _times(quarter * mu, shear)


def edge_stvk(mesh, x, mu, lam, springs="biquadratic"):
    """Energies [T] and forces [N, 3]; D = l^2 - L^2 (biquadratic) or 2 L (l - L) (quadratic)."""
    vectors, length = edge_lengths(mesh, x)
    _, L = edge_lengths(mesh, mesh.points)
    if springs == "biquadratic":
        D, slope = length**2 - L**2, 2 * length
    else:
        D, slope = 2 * L * (length - L), 2 * L
    tension = np.einsum("tef,tf->te", edge_stiffness(mesh, mu, lam), D)
    return 0.5 * np.sum(D * tension, axis=1), _pull(mesh, vectors, length, tension * slope)


def mass_spring(mesh, x, mu, lam):
    """Springs k = sum E V / L^2 over the elements around an edge; energies [T] are each element's share."""
    mu, lam = np.asarray(mu), np.asarray(lam)
    young = mu * (3 * lam + 2 * mu) / (lam + mu)
    vectors, length = edge_lengths(mesh, x)
    _, L = edge_lengths(mesh, mesh.points)
    k = (young * mesh.volumes)[:, None] / L**2
    return 0.5 * np.sum(k * (length - L) ** 2, axis=1), _pull(mesh, vectors, length, k * (length - L))


def _pull(mesh, vectors, lengths, tension):
    """Nodal forces of edges under tension [N]."""
    forces = np.zeros((len(mesh.tets), 4, 3))
    pulls = tension[..., None] * vectors / lengths[..., None]
    for e, (i, j) in enumerate(EDGES):
        forces[:, i] += pulls[:, e]
        forces[:, j] -= pulls[:, e]
    return mesh.assemble(forces)


DENSITIES = {"linear": linear, "corotated": corotated, "stvk": stvk, "neo_hookean": neo_hookean}
SPRINGS = {
    "edge_stvk": edge_stvk,
    "edge_stvk_quadratic": lambda mesh, x, mu, lam: edge_stvk(mesh, x, mu, lam, springs="quadratic"),
    "mass_spring": mass_spring,
}
MODELS = (*DENSITIES, *SPRINGS)


def evaluate(model, mesh, x, mu, lam, **options):
    """Energies [T] (J) and nodal forces [N, 3] (N) of one of MODELS at positions x [N, 3]."""
    if model in SPRINGS:
        return SPRINGS[model](mesh, x, mu, lam, **options)
    return continuum(DENSITIES[model], mesh, x, mu, lam, **options)


def stress(model, mesh, x, mu, lam, **options):
    """First Piola-Kirchhoff stress P [T, 3, 3] (Pa) of one of DENSITIES."""
    return DENSITIES[model](mesh.deformation_gradients(x), mu, lam, **options)[1]


# --- small-strain stiffness -------------------------------------------------------------------------------------------


def stiffness(mesh, mu, lam):
    """Small-strain stiffness matrices [T, 12, 12] (N/m).

    Row 3 a + i, column 3 b + j: V (lam g_ai g_bj + mu g_aj g_bi + mu g_a.g_b delta_ij).
    """
    g = mesh.gradients
    lam, mu, V = (np.broadcast_to(np.asarray(value, float), len(g)) for value in (lam, mu, mesh.volumes))
    K = np.einsum("t,tai,tbj->taibj", lam, g, g) + np.einsum("t,taj,tbi->taibj", mu, g, g)
    K += np.einsum("t,taK,tbK,ij->taibj", mu, g, g, IDENTITY)
    return V[:, None, None] * K.reshape(-1, 12, 12)


# --- tangents and static equilibrium ----------------------------------------------------------------------------------


def _hooke_tensor(mu, lam):
    delta = IDENTITY
    symmetric = np.einsum("ik,jl->ijkl", delta, delta) + np.einsum("il,jk->ijkl", delta, delta)
    return np.multiply.outer(np.asarray(mu), symmetric) + np.multiply.outer(
        np.asarray(lam), np.einsum("ij,kl->ijkl", delta, delta)
    )


def linear_tangent(F, mu, lam):
    return np.broadcast_to(_hooke_tensor(mu, lam), (*F.shape, 3, 3))


def stvk_tangent(F, mu, lam):
    C = np.broadcast_to(_hooke_tensor(mu, lam), (*F.shape, 3, 3))
    _, second_piola = hooke(0.5 * (_transpose(F) @ F - IDENTITY), mu, lam)
    material = np.einsum("tiM,tMJNL,tkN->tiJkL", F, C, F, optimize=True)
    return material + np.einsum("ik,tLJ->tiJkL", IDENTITY, second_piola)


def corotated_tangent(F, mu, lam):
    """From P = 2 mu (F - R) + lam (R:F - 3) R and dR = R [w]x, (tr(S) I - S) w = axial(R^T dF - dF^T R)."""
    mu, lam = np.asarray(mu), np.asarray(lam)
    R = polar(F)
    S = _transpose(R) @ F
    S = 0.5 * (S + _transpose(S))
    spin = np.linalg.inv(_times(_trace(S), IDENTITY) - S)
    axial = np.einsum("aML,tkM->takL", -LEVI_CIVITA, R)  # axial vector of R^T dF - dF^T R, as a map of dF_kL
    w = np.einsum("tab,tbkL->takL", spin, axial)
    dR = np.einsum("tiM,MJa,takL->tiJkL", R, -LEVI_CIVITA, w, optimize=True)  # [w]x_MJ = -eps_MJa w_a
    identity = np.einsum("ik,JL->iJkL", IDENTITY, IDENTITY)
    along = (lam * (np.einsum("tiJ,tiJ->t", R, F) - 3) - 2 * mu)[:, None, None, None, None]
    twice_mu, lam = (np.broadcast_to(value, len(F))[:, None, None, None, None] for value in (2 * mu, lam))
    return twice_mu * identity + lam * np.einsum("tiJ,tkL->tiJkL", R, R) + along * dR


def neo_hookean_tangent(F, mu, lam):
    _, dU, ddU = neo_hookean_volumetric(np.linalg.det(F), mu, lam)
    cof = cofactor(F)
    dcof = np.einsum("ikm,JLN,tmN->tiJkL", LEVI_CIVITA, LEVI_CIVITA, F)
    identity = np.einsum("ik,JL->iJkL", IDENTITY, IDENTITY)
    terms = (np.broadcast_to(mu, dU.shape), dU, ddU)
    mu, first, second = (term[:, None, None, None, None] for term in terms)
    return mu * identity + first * dcof + second * np.einsum("tiJ,tkL->tiJkL", cof, cof)


TANGENTS = {
    "linear": linear_tangent,
    "corotated": corotated_tangent,
    "stvk": stvk_tangent,
    "neo_hookean": neo_hookean_tangent,
}


def tangent_matrix(model, mesh, x, mu, lam):
    """Sparse Hessian of the elastic energy [3 N, 3 N] (N/m)."""
    if model not in TANGENTS:
        step = 1e-6 * np.ptp(mesh.points) * np.eye(x.size).reshape(-1, *x.shape)
        forces = [[evaluate(model, mesh, x + sign * way, mu, lam)[1].ravel() for sign in (-1, 1)] for way in step]
        return csr_matrix([(before - after) / (2.0 * step.max()) for before, after in forces])
    A = TANGENTS[model](mesh.deformation_gradients(x), mu, lam)
    blocks = np.einsum("t,tiJkL,taJ,tbL->taibk", mesh.volumes, A, mesh.gradients, mesh.gradients, optimize=True)
    dofs = (3 * mesh.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
    rows, columns = np.broadcast_arrays(dofs[:, :, None], dofs[:, None, :])
    size = 3 * len(mesh.points)
    return coo_matrix((blocks.ravel(), (rows.ravel(), columns.ravel())), shape=(size, size)).tocsr()


def equilibrium(model, mesh, mu, lam, fixed, loads, increments=4, tolerance=1e-11, start=None):
    """Positions [N, 3] at rest under nodal loads [N, 3] (N), fixed nodes (mask [N]) at their rest positions.

    Newton's method on the total potential, with a backtracking line search, the load applied in increments.
    Raises RuntimeError if the residual does not fall below ``tolerance`` times the norm of the loads.
    """
    free = np.repeat(~np.asarray(fixed), 3)
    x = np.array(mesh.points if start is None else start, float)
    for fraction in np.arange(1, increments + 1) / increments:
        external = fraction * loads
        for _ in range(100):
            energies, forces = evaluate(model, mesh, x, mu, lam)
            residual = (forces + external).ravel()[free]
            if np.linalg.norm(residual) <= tolerance * np.linalg.norm(loads):
                break
            step = np.zeros(x.size)
            step[free] = spsolve(tangent_matrix(model, mesh, x, mu, lam)[free][:, free].tocsc(), residual)
            slope = -float(step[free] @ residual)
            step = step.reshape(x.shape)
            potential, size = energies.sum() - np.sum(external * x), 1.0
            while size > 1e-6:
                trial = x + size * step
                value = evaluate(model, mesh, trial, mu, lam)[0].sum() - np.sum(external * trial)
                if value <= potential + 1e-4 * size * slope + 1e-12 * abs(potential):
                    break
                size *= 0.5
            x = x + size * step
        else:
            raise RuntimeError(f"{model}: no equilibrium at load fraction {fraction}")
    return x


def symplectic_euler(model, mesh, x, v, mu, lam, masses, dt, steps, *, gravity=(0, 0, 0), damping=0.0, fixed=None):
    """Positions and velocities [N, 3] after ``steps`` of v <- (v + dt (f/m + g)) / (1 + dt damping), x <- x + dt v."""
    x, v = np.array(x, float), np.array(v, float)
    for _ in range(steps):
        _, forces = evaluate(model, mesh, x, mu, lam)
        v = (v + dt * (forces / masses[:, None] + np.asarray(gravity))) / (1 + dt * damping)
        if fixed is not None:
            v[fixed] = 0.0
        x = x + dt * v
    return x, v


# --- anisotropic materials --------------------------------------------------------------------------------------------

VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))


def compliance(young, poisson, shear):
    """6x6 compliance in the order of VOIGT, engineering shears, of E_1 E_2 E_3, nu_12 nu_13 nu_23, G_12 G_13 G_23."""
    (e1, e2, _), (n12, n13, n23), (g12, g13, g23) = young, poisson, shear
    S = np.diag(1 / np.array([*young, g23, g13, g12]))
    S[0, 1] = S[1, 0] = -n12 / e1
    S[0, 2] = S[2, 0] = -n13 / e1
    S[1, 2] = S[2, 1] = -n23 / e2
    return S


def transverse(young_along, young_across, poisson_along, poisson_across, shear_along):
    """The nine constants of ``compliance`` with fibres along axis 1."""
    across = young_across / (2 * (1 + poisson_across))
    ratios = (poisson_along, poisson_along, poisson_across)
    return (young_along, young_across, young_across), ratios, (shear_along, shear_along, across)


def elasticity(young, poisson, shear, axes=IDENTITY):
    """C [3, 3, 3, 3] (Pa) in rest space of a material whose axes 1, 2, 3 are the rows of ``axes``."""
    matrix = np.linalg.inv(compliance(young, poisson, shear))
    C = np.zeros((3, 3, 3, 3))
    for p, (i, j) in enumerate(VOIGT):
        for q, (k, m) in enumerate(VOIGT):
            C[i, j, k, m] = C[j, i, k, m] = C[i, j, m, k] = C[j, i, m, k] = matrix[p, q]
    return np.einsum("abcd,ai,bj,ck,dm->ijkm", C, axes, axes, axes, axes)


def nearest_isotropic(C):
    """mu and lambda [...] of Voigt's average of C [..., 3, 3, 3, 3] over all directions."""
    dilation, shear = np.einsum("...iijj->...", C), np.einsum("...ijij->...", C)
    mu = (3 * shear - dilation) / 30
    return mu, dilation / 9 - 2 / 3 * mu


def anisotropic_energy(F, C):
    """psi = 1/2 e:C:e, e = sym(R^T F) - I; near F without a definite rotation it blends into the nearest isotropic law.

    With principal stretches s (the last negative in an inverted F) and x = (s1 + s2)(s2 + s3)(s3 + s1) / |s|^3, below
    x = 0.4 it is psi_iso + b (psi - psi_iso), b = 3 y^2 - 2 y^3 of y = x / 0.4.
    """
    strain = _transpose(polar(F)) @ F
    strain = 0.5 * (strain + _transpose(strain)) - IDENTITY
    psi = 0.5 * np.einsum("...ij,...ijkl,...kl->...", strain, C, strain)
    isotropic, _ = hooke(strain, *nearest_isotropic(C))
    s = np.linalg.svd(F, compute_uv=False)
    s[..., 2] *= np.sign(np.linalg.det(F))
    x = np.prod(s + np.roll(s, 1, axis=-1), axis=-1) / np.linalg.norm(s, axis=-1) ** 3
    y = np.clip(x / 0.4, 0, 1)
    return isotropic + (3 * y**2 - 2 * y**3) * (psi - isotropic)


def anisotropic(F, C, _=None):
    """psi and its derivative P, by central differences of fourth order."""
    P = np.empty_like(F)
    for i, J in np.ndindex(3, 3):
        step = np.zeros((3, 3))
        step[i, J] = 1e-3
        near, far = (anisotropic_energy(F + k * step, C) - anisotropic_energy(F - k * step, C) for k in (1, 2))
        P[:, i, J] = (8 * near - far) / 12e-3
    return anisotropic_energy(F, C), P


def active(F, stress, direction):
    """P = s (F d) d^T [T, 3, 3] (Pa)."""
    return _times(stress, np.einsum("tiJ,tJ,tK->tiK", F, direction, direction))
