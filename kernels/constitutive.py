"""Constitutive laws, one pair of functions each: first Piola-Kirchhoff stress and energy density.

All take the local-frame displacement gradient G and frame Q of ``elements`` (F Q = Q + G) and return P Q; frames are
rotations and the materials isotropic, so no law needs to leave the frame. ``cauchy`` functions return a tensor with
the invariants of the Cauchy stress, for von Mises stress and the like. Stresses in Pa, energy densities in J/m^3.
"""

import warp as wp

from .rotation import cofactor, identity3

wp.set_module_options({"enable_backward": False})

#: Where neo-Hookean leaves ln J for its second-order Taylor expansion.
LOG_CONTINUED_BELOW = 0.1

J0 = wp.constant(LOG_CONTINUED_BELOW)


@wp.func
def hooke(strain: wp.mat33, mu: float, lam: float):
    return (2.0 * mu) * strain + (lam * wp.trace(strain)) * identity3()


@wp.func
def hooke_energy(strain: wp.mat33, mu: float, lam: float):
    trace = wp.trace(strain)
    return mu * wp.ddot(strain, strain) + 0.5 * lam * trace * trace


@wp.func
def symmetric(a: wp.mat33):
    return 0.5 * (a + wp.transpose(a))


# --- linear elasticity ---------------------------------------------------------------------------------------------


@wp.func
def linear_stress(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    return q * hooke(symmetric(wp.transpose(q) * g), mu, lam)


@wp.func
def linear_energy(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    return hooke_energy(symmetric(wp.transpose(q) * g), mu, lam)


@wp.func
def linear_cauchy(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    return hooke(symmetric(wp.transpose(q) * g), mu, lam)


# --- corotated: R is the rotation of F Q ---------------------------------------------------------------------------


@wp.func
def corotated_strain(g: wp.mat33, q: wp.mat33, r: wp.mat33):
    """sym(R^T F) - I without cancellation where G is small, also for a shared rotation.

    With D = R Q - Q, sym((R Q)^T Q) - I = -D^T D / 2: that holds for rotations alone, and drops what rounding adds.
    """
    d = r - q
    return symmetric(wp.transpose(r) * g) - 0.5 * (wp.transpose(d) * d)


# --- St. Venant-Kirchhoff (with explicit central differences: TLED) ------------------------------------------------


@wp.func
def green_strain(g: wp.mat33, q: wp.mat33):
    """E = (F^T F - I) / 2 without cancellation at small strains."""
    return symmetric(wp.transpose(q) * g) + 0.5 * (wp.transpose(g) * g)


@wp.func
def stvk_stress(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    return (q + g) * hooke(green_strain(g, q), mu, lam)


@wp.func
def stvk_energy(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    return hooke_energy(green_strain(g, q), mu, lam)


@wp.func
def push_forward(f: wp.mat33, second_piola: wp.mat33):
    """F S F^T / J, with |J| kept away from zero."""
    j = wp.max(wp.abs(wp.determinant(f)), 1.0e-3)
    return (f * second_piola * wp.transpose(f)) / j


@wp.func
def stvk_cauchy(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    return push_forward(q + g, hooke(green_strain(g, q), mu, lam))


# --- neo-Hookean, ln J continued smoothly below J0 -----------------------------------------------------------------


@wp.func
def continued_log(j: float):
    """L(J) and L'(J): ln J and 1/J, below J0 the Taylor expansion of second order about J0."""
    value = float(0.0)
    slope = float(0.0)
    if j >= J0:
        value = wp.log(j)
        slope = 1.0 / j
    else:
        d = (j - J0) / J0
        value = wp.log(J0) + d - 0.5 * d * d
        slope = (1.0 - d) / J0
    return value, slope


@wp.func
def neo_hookean_stress(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    f = q + g
    value, slope = continued_log(wp.determinant(f))
    return mu * f + ((lam * value - mu) * slope) * cofactor(f)


@wp.func
def neo_hookean_energy(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    f = q + g
    value, _slope = continued_log(wp.determinant(f))
    # tr F^T F - 3 = 2 tr E, without cancellation.
    return mu * wp.trace(green_strain(g, q)) - mu * value + 0.5 * lam * value * value


@wp.func
def neo_hookean_cauchy(g: wp.mat33, q: wp.mat33, mu: float, lam: float):
    f = q + g
    j = wp.max(wp.abs(wp.determinant(f)), 1.0e-3)
    return (neo_hookean_stress(g, q, mu, lam) * wp.transpose(f)) / j
