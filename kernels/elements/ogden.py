"""Ogden's law: powers of the principal stretches, as neo-Hookean plus a function of C = F^T F that vanishes at rest.

With shares w_p of the shear modulus and exponents alpha_p, m_p = 2 w_p / alpha_p, L_i = ln c_i and c_i the squared
principal stretches,
    W / mu = sum_p m_p / alpha_p (sum_i exp(alpha_p L_i / 2) - 3) - sum_p m_p ln J + lambda / (2 mu) (ln J)^2.
A part v_p of the logarithm of a term and of its stretches goes to neo-Hookean's energy, whose shear modulus is
mu sum_p v_p then. What is left is mu sum_i G(c_i) with
    G = sum_p m_p / alpha_p (c^(alpha_p / 2) - 1) - v_p / 2 (c - 1) - (m_p - v_p) / 2 ln c,  G(1) = G'(1) = 0.
All resistance to turned-over elements is neo-Hookean's: G depends only on C, and has a bounded second derivative,
because it goes on as a parabola where stretches are outside limits that follow from alpha_p. v_p is m_p where alpha_p
is positive, w_p where it is negative, so that what is left never pulls a crushed element together.
"""

import functools

import warp as wp

from warp_corot.kernels.math.eigen import eigenvalue_nodes, symmetric_eigen
from warp_corot.kernels.math.matrices import identity3, reciprocal

from .constitutive import (
    green_strain,
    log_of_dilation,
    neo_hookean_differential,
    neo_hookean_energy,
    neo_hookean_stress,
    symmetric,
)

wp.set_module_options({"enable_backward": False})

#: A term continues as a parabola where it would be this many times as stiff as at rest.
STIFFENING = 1000.0
#: For eigenvalues nearer to each other than this, relative to their size, the derivative at their mean replaces the
#: quotient of differences.
NEAR = wp.constant(3.0e-3)


def stretch_limits(alpha: float) -> tuple[float, float]:
    """Smallest and largest principal stretch at which a term with this exponent is the plain law."""
    low = STIFFENING ** (-1.0 / (2.0 - alpha)) if alpha < 0.0 else 0.5 if alpha < 2.0 else 0.01
    high = STIFFENING ** (1.0 / max(alpha - 2.0, 1.0))
    return low, high


def part_of_volume(share: float, alpha: float) -> float:
    """v_p of a term."""
    return 2.0 * share / alpha if alpha > 0.0 else share


@wp.func
def log_of_square(e: float):
    """ln(1 + 2 e) to all its digits, for e > -1/2."""
    log, _excess = log_of_dilation(wp.max(2.0 * e, -0.5))
    if e < -0.25:
        log = wp.log(1.0 + 2.0 * e)
    return log


@wp.func
def power_excess(x: float):
    """exp(x) - 1 and exp(x) - 1 - x, both to all their digits."""
    first = float(0.0)
    second = float(0.0)
    if wp.abs(x) < 0.5:
        second = 0.5 * x * x * (1.0 + x / 3.0 * (1.0 + x / 4.0 * (1.0 + x / 5.0 * (1.0 + x / 6.0 * (1.0 + x / 7.0)))))
        first = x + second
    else:
        first = wp.exp(x) - 1.0
        second = first - x
    return first, second


@functools.cache
def whole_power(power: int) -> wp.Function:
    """(1 + x)^|power| - 1 of x and ln(1 + x), without the logarithm."""

    @wp.func
    def whole_power(x: float, log: float):
        excess = float(0.0)
        for _ in range(wp.static(abs(power))):
            excess += x + excess * x
        return excess

    return whole_power


@functools.cache
def any_power(power: float) -> wp.Function:
    """The same for c^power - 1, of x and ln c."""

    @wp.func
    def any_power(x: float, log: float):
        excess, _second = power_excess(power * log)
        return excess

    return any_power


@functools.cache
def ogden_term(share: float, alpha: float) -> wp.Function:
    """2 G', 2 G'' and G of one term at an eigenvalue e of Green's strain."""
    m, v = 2.0 * share / alpha, part_of_volume(share, alpha)
    rest, half = m - v, 0.5 * alpha
    power_of = whole_power(int(half - 1.0)) if half == int(half) and abs(half - 1.0) < 6.0 else any_power(half - 1.0)
    over = m / alpha
    low, high = ((stretch**2 - 1.0) / 2.0 for stretch in stretch_limits(alpha))

    @wp.func
    def term(e: float):
        inside = wp.clamp(e, low, high)
        log = log_of_square(inside)
        inverse = reciprocal(1.0 + 2.0 * inside)
        of_inverse = -2.0 * inside * inverse
        of_power = power_of(wp.where(half >= 1.0, 2.0 * inside, of_inverse), log)
        slope = m * of_power - rest * of_inverse
        curvature = (m * (half - 1.0) * (1.0 + of_power) + rest * inverse) * inverse
        _first, whole = power_excess(half * log)
        _first_square, square = power_excess(log)
        value = over * whole - 0.5 * v * square
        # c = 1 + 2 e.
        beyond = 2.0 * (e - inside)
        value += 0.5 * beyond * (slope + 0.5 * curvature * beyond)
        return slope + curvature * beyond, curvature, value

    return term


@functools.cache
def ogden_function(terms: tuple[tuple[float, float], ...]) -> wp.Function:
    """The sum of terms (share, alpha)."""
    if len(terms) == 1:
        return ogden_term(*terms[0])
    head, tail = ogden_function(terms[:-1]), ogden_term(*terms[-1])

    @wp.func
    def both(e: float):
        slope, curvature, value = head(e)
        more_slope, more_curvature, more_value = tail(e)
        return slope + more_slope, curvature + more_curvature, value + more_value

    return both


@functools.cache
def ogden(terms: tuple[tuple[float, float], ...]) -> dict[str, wp.Function]:
    """Stress, differential and energy density of the law, as ``constitutive`` has them.

    Args:
        terms: Share of the shear modulus and exponent alpha of each; shares add up to one.
    """
    of_square, v = ogden_function(terms), sum(part_of_volume(*term) for term in terms)

    @wp.func
    def stress(a: wp.mat33, mu: float, lam: float):
        e = green_strain(a)
        n = eigenvalue_nodes(e)
        s0, _c0, _w0 = of_square(n[0])
        s1, _c1, _w1 = of_square(n[1])
        s2, _c2, _w2 = of_square(n[2])
        # Newton's polynomial: s0 + first (E - n0) + curvature (E - n0) (E - n1).
        first = (s0 - s1) * reciprocal(n[0] - n[1])
        curvature = (first - (s1 - s2) * reciprocal(n[1] - n[2])) * reciprocal(n[0] - n[2])
        linear = first - curvature * (n[0] + n[1])
        constant = s0 - first * n[0] + curvature * n[0] * n[1]
        own = constant * identity3() + linear * e + curvature * (e * e)
        return neo_hookean_stress(a, v * mu, lam) + mu * ((identity3() + a) * own)

    @wp.func
    def quotient(e0: float, e1: float, s0: float, s1: float):
        """(s1 - s0) / (c1 - c0)."""
        gap = 2.0 * (e1 - e0)
        result = float(0.0)
        if wp.abs(gap) > NEAR * (1.0 + wp.abs(e0 + e1)):
            result = (s1 - s0) / gap
        else:
            _slope, curvature, _value = of_square(0.5 * (e0 + e1))
            result = curvature
        return result

    @wp.func
    def differential(a: wp.mat33, da: wp.mat33, mu: float, lam: float):
        e, n = symmetric_eigen(green_strain(a))
        s0, c0, _w0 = of_square(e[0])
        s1, c1, _w1 = of_square(e[1])
        s2, c2, _w2 = of_square(e[2])
        turned = wp.transpose(n) * symmetric(da + wp.transpose(a) * da) * n
        q01 = 2.0 * quotient(e[0], e[1], s0, s1) * turned[0, 1]
        q02 = 2.0 * quotient(e[0], e[2], s0, s2) * turned[0, 2]
        q12 = 2.0 * quotient(e[1], e[2], s1, s2) * turned[1, 2]
        d_own = wp.mat33(
            2.0 * c0 * turned[0, 0], q01, q02,
            q01, 2.0 * c1 * turned[1, 1], q12,
            q02, q12, 2.0 * c2 * turned[2, 2],
        )  # fmt: skip
        own = n * wp.diag(wp.vec3(s0, s1, s2)) * wp.transpose(n)
        d_own = n * d_own * wp.transpose(n)
        return neo_hookean_differential(a, da, v * mu, lam) + mu * (da * own + (identity3() + a) * d_own)

    @wp.func
    def energy(a: wp.mat33, mu: float, lam: float):
        e, _n = symmetric_eigen(green_strain(a))
        _s0, _c0, w0 = of_square(e[0])
        _s1, _c1, w1 = of_square(e[1])
        _s2, _c2, w2 = of_square(e[2])
        return neo_hookean_energy(a, v * mu, lam) + mu * (w0 + w1 + w2)

    return {"stress": stress, "differential": differential, "energy": energy}
