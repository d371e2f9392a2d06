"""Constitutive laws, one set of functions each: first Piola-Kirchhoff stress, its differential, and energy density.

A law takes the displacement gradient A of an element in an orthonormal frame of its own, so that F = I + A there, and
returns P in the same frame. Materials are isotropic, so any frame is right, also a left-handed one. ``elements`` gives
G = (du/dX) Q, and A = Q^T G. ``differential`` functions return dP, the exact directional derivative of P at A in the
direction dA, which has the digits of dA. Stresses in Pa, energy densities in J/m^3.

No law subtracts numbers near one: each is written in A, so that its stress has float32's digits at any strain.
"""

import math

import warp as wp

from warp_corot.kernels.math.matrices import cofactor_differential
from warp_corot.kernels.math.rotation import cofactor, column, identity3, reciprocal

wp.set_module_options({"enable_backward": False})

#: J below which neo-Hookean's volumetric energy is its own Taylor polynomial of second order about this J.
CONTINUED_BELOW = 0.5
_LOG = math.log(CONTINUED_BELOW)

J0 = wp.constant(CONTINUED_BELOW)
LOG_J0 = wp.constant(_LOG)


@wp.struct
class IsotropicMaterial:
    """Lamé's parameters, arrays of one entry (stride 0) or one per element (stride 1)."""

    mu: wp.array[wp.float32]
    lam: wp.array[wp.float32]
    stride: int


@wp.struct
class RotatedMaterial:
    """Lamé's parameters, and rotations with the one that each element uses."""

    isotropic: IsotropicMaterial
    rotations: wp.array[wp.mat33]  # [units] from rest space to world space
    unit: wp.array[wp.int32]  # [T]


@wp.func
def hooke(strain: wp.mat33, mu: float, lam: float):
    pressure = lam * wp.trace(strain)
    stress = (2.0 * mu) * strain
    stress[0, 0] += pressure
    stress[1, 1] += pressure
    stress[2, 2] += pressure
    return stress


@wp.func
def hooke_energy(strain: wp.mat33, mu: float, lam: float):
    trace = wp.trace(strain)
    return mu * wp.ddot(strain, strain) + 0.5 * lam * trace * trace


@wp.func
def symmetric(a: wp.mat33):
    return 0.5 * (a + wp.transpose(a))


@wp.func
def push_forward(a: wp.mat33, piola: wp.mat33):
    """The Cauchy stress P F^T / J, with |J| kept away from zero."""
    f = identity3() + a
    return (piola * wp.transpose(f)) / wp.max(wp.abs(wp.determinant(f)), 1.0e-3)


# --- linear elasticity ---------------------------------------------------------------------------------------------


@wp.func
def linear_stress(a: wp.mat33, mu: float, lam: float):
    return hooke(symmetric(a), mu, lam)


@wp.func
def linear_differential(a: wp.mat33, da: wp.mat33, mu: float, lam: float):
    return hooke(symmetric(da), mu, lam)


@wp.func
def linear_energy(a: wp.mat33, mu: float, lam: float):
    return hooke_energy(symmetric(a), mu, lam)


# --- St. Venant-Kirchhoff (with explicit central differences: TLED) ------------------------------------------------


@wp.func
def green_strain(a: wp.mat33):
    """E = (F^T F - I) / 2 without cancellation at small strains."""
    return symmetric(a) + 0.5 * (wp.transpose(a) * a)


@wp.func
def stvk_stress(a: wp.mat33, mu: float, lam: float):
    return (identity3() + a) * hooke(green_strain(a), mu, lam)


@wp.func
def stvk_differential(a: wp.mat33, da: wp.mat33, mu: float, lam: float):
    """dP = dF S + F dS of P = F S; dS is Hooke's of dE = sym(F^T dF)."""
    d_strain = symmetric(da + wp.transpose(a) * da)
    return da * hooke(green_strain(a), mu, lam) + (identity3() + a) * hooke(d_strain, mu, lam)


@wp.func
def stvk_energy(a: wp.mat33, mu: float, lam: float):
    return hooke_energy(green_strain(a), mu, lam)


# --- corotated: R is the rotation of F Q ---------------------------------------------------------------------------


@wp.func
def corotated_strain(g: wp.mat33, q: wp.mat33, r: wp.mat33):
    """sym(R^T F) - I without cancellation where G is small, also for a shared rotation.

    With D = R Q - Q, sym((R Q)^T Q) - I = -D^T D / 2: that holds for rotations alone, and drops what rounding adds.
    """
    d = r - q
    return symmetric(wp.transpose(r) * g) - 0.5 * (wp.transpose(d) * d)


@wp.func
def rotated_stress(g: wp.mat33, q: wp.mat33, r: wp.mat33, mu: float, lam: float):
    """The corotated stress times Q, of G, the frame Q and the rotation of F Q."""
    return r * hooke(corotated_strain(g, q, r), mu, lam)


@wp.func
def stretch_strain(rough: wp.mat33, a: wp.mat33):
    """e = S - I of F = I + A to all its digits, from a ``rough`` one; S is the stretch in F = R S.

    The rough one is a difference of numbers near one. But S^2 = F^T F, so e = E - e^2 / 2 with Green's strain E, and
    where e is small, the error of the rough one hardly changes this.
    """
    strain = rough
    if wp.ddot(rough, rough) < 0.25:
        strain = green_strain(a) - 0.5 * (rough * rough)
    return strain


# --- neo-Hookean ---------------------------------------------------------------------------------------------------
#
# W = mu/2 (tr F^T F - 3) + U(J), U = -mu ln J + lambda/2 (ln J)^2. Both parts have a slope at rest, and what is left
# of small strains is their difference. So the slope is moved: with V(J) = U(J) + mu (J - 1) and d = J - 1
#     P = mu (F - cof F) + V'(J) cof F,  F - cof F = A + A^T - tr(A) I - cof A,
#     W = mu (|sym A|^2 - (tr A)^2 / 2 - det A) + V(J),  d = tr A + tr cof A + det A,
# where nothing of order one cancels, whichever way V goes on below J0.


@wp.func
def log_of_dilation(d: float):
    """ln(1 + d) and d - ln(1 + d), both to all their digits, for d >= -1/2.

    ln(1 + d) = 2 artanh(s) with s = d / (2 + d), a series to s^11 where |s| <= 1/3: it leaves out 1.4e-7 at most.
    """
    s = d * reciprocal(2.0 + d)
    z = s * s
    series = z * (1.0 / 3.0 + z * (1.0 / 5.0 + z * (1.0 / 7.0 + z * (1.0 / 9.0 + z * (1.0 / 11.0)))))
    log = 2.0 * s * (1.0 + series)
    excess = s * (d - 2.0 * series)
    if d > 1.0:
        log = wp.log(1.0 + d)
        excess = d - log
    return log, excess


@wp.func
def volumetric_slope(d: float, mu: float, lam: float):
    """V'(J), J = 1 + d; a straight line below J0."""
    slope = float(0.0)
    if d >= J0 - 1.0:
        log, _excess = log_of_dilation(d)
        slope = (lam * log + mu * d) * reciprocal(1.0 + d)
    else:
        at_j0 = (lam * LOG_J0 + mu * (J0 - 1.0)) / J0
        curvature = (mu + lam * (1.0 - LOG_J0)) / (J0 * J0)
        slope = at_j0 + curvature * (d - (J0 - 1.0))
    return slope


@wp.func
def volumetric_curvature(d: float, mu: float, lam: float):
    """V''(J), J = 1 + d; constant below J0."""
    log, _excess = log_of_dilation(wp.max(d, J0 - 1.0))
    j = 1.0 + wp.max(d, J0 - 1.0)
    return (mu + lam * (1.0 - log)) / (j * j)


@wp.func
def volumetric_energy(d: float, mu: float, lam: float):
    """V(J), J = 1 + d; a parabola below J0."""
    energy = float(0.0)
    if d >= J0 - 1.0:
        log, excess = log_of_dilation(d)
        energy = mu * excess + 0.5 * lam * log * log
    else:
        step = d - (J0 - 1.0)
        at_j0 = mu * (J0 - 1.0 - LOG_J0) + 0.5 * lam * LOG_J0 * LOG_J0
        slope = (lam * LOG_J0 + mu * (J0 - 1.0)) / J0
        curvature = (mu + lam * (1.0 - LOG_J0)) / (J0 * J0)
        energy = at_j0 + step * (slope + 0.5 * curvature * step)
    return energy


@wp.func
def dilation(a: wp.mat33, cof: wp.mat33):
    """J - 1 = tr A + tr cof A + det A."""
    return wp.trace(a) + (wp.trace(cof) + wp.dot(column(a, 0), column(cof, 0)))


@wp.func
def neo_hookean_stress(a: wp.mat33, mu: float, lam: float):
    cof = cofactor(a)
    slope = volumetric_slope(dilation(a, cof), mu, lam)
    # mu (A + A^T - tr(A) I - cof A) + V' (I + tr(A) I - A^T + cof A).
    rest = mu - slope
    diagonal = slope - rest * wp.trace(a)
    return mu * a + rest * (wp.transpose(a) - cof) + diagonal * identity3()


@wp.func
def neo_hookean_differential(a: wp.mat33, da: wp.mat33, mu: float, lam: float):
    """dP = mu (dF - dcof F) + V' dcof F + V'' (cof F : dF) cof F, with cof F = I + tr(A) I - A^T + cof A."""
    cof_a = cofactor(a)
    d = dilation(a, cof_a)
    cof = cof_a - wp.transpose(a) + (1.0 + wp.trace(a)) * identity3()
    d_cof = cofactor_differential(a, da) - wp.transpose(da) + wp.trace(da) * identity3()
    volumetric = (volumetric_curvature(d, mu, lam) * wp.ddot(cof, da)) * cof
    return mu * da + (volumetric_slope(d, mu, lam) - mu) * d_cof + volumetric


@wp.func
def neo_hookean_energy(a: wp.mat33, mu: float, lam: float):
    cof = cofactor(a)
    e = symmetric(a)
    trace = wp.trace(a)
    det = wp.dot(column(a, 0), column(cof, 0))
    isochoric = wp.ddot(e, e) - 0.5 * trace * trace - det
    return mu * isochoric + volumetric_energy(dilation(a, cof), mu, lam)
