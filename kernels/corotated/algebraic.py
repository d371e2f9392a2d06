"""The corotated stress without an iteration on matrices: the stretch S of F = R S by a root of its trace.

With E = F^T F - I, its invariants a = tr E, b = tr adj E, c = det E, and j = J - 1, t = tr S - 3 is the largest root of
    t^4 + 12 t^3 + (48 - 2a) t^2 + (64 - 12a - 8j) t + a^2 - 20a - 24j - 4b = 0
(Cayley-Hamilton for S), whose slope is 4q, q = 2 (s1 + s2)(s1 + s3)(s2 + s3) of the principal stretches. From t follow
    I - S^-1 = (n0 I + (8 + y) E - (6 + y) adj E) / q,  y = (2t - 6j) / J,
    n0 = t (18 + t (8 + t)) - a (10 + t) - 2j - y (1 + a),  and  P = F (2 mu (I - S^-1) + lambda t S^-1),
with the digits of E however small it is, for J > 0. Flat and turned over elements have their rotations from
``robust_rotation``. ``elements.simd8`` does the same for eight elements at once.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial, corotated_strain, hooke, hooke_energy, symmetric
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.elements.forces import element_energies, element_von_mises, own_gradient
from warp_corot.kernels.math.matrices import identity3, reciprocal, square_root
from warp_corot.kernels.math.quaternion import robust_rotation
from warp_corot.kernels.math.rotation import quick_rotation, rotation_out_of_line
from warp_corot.kernels.modules import Family

wp.set_module_options({"enable_backward": False})

# Up to this J an element counts as flat or turned over; up to this trace of E, F counts as of order one.
FLAT = wp.constant(0.03)
FAR = wp.constant(50.0)
# |E|^2 below which the series for t is the start.
NEAR = wp.constant(0.4)
# A step from which Newton's iteration leaves at most some 1e-7, over x.
LAST_STEP = wp.constant(1.0e-4)


@wp.func
def newton_step_of(t: float, c0: float, c1: float, c2: float):
    value = (((t + 12.0) * t + c2) * t + c1) * t + c0
    slope = ((4.0 * t + 36.0) * t + 2.0 * c2) * t + c1
    return value * reciprocal(slope)


@wp.func
def stretch_trace(a: float, b: float, c: float, j: float):
    """t = tr S - 3 of the invariants of E and j = J - 1, where J > 0."""
    # The series of tr sqrt(I + E).
    p2 = a * a - 2.0 * b
    p3 = a * (p2 - b) + 3.0 * c
    p4 = a * (p3 + c) - b * p2
    t = 0.5 * a + 0.0625 * p3 - 0.125 * p2 - 0.0390625 * p4
    if p2 >= NEAR:
        # Where it ends too early: x = tr S from x^2 = tr C + 2 y, y^2 = tr adj C + 2 J x, from x <= sqrt(3 tr C) on. In
        # each round the error shrinks to a ninth or less.
        first = a + 3.0
        second = b + 2.0 * a + 3.0
        twice = 2.0 + 2.0 * j
        x = square_root(3.0 * first)
        for _ in range(2):
            x = square_root(first + 2.0 * square_root(second + twice * x))
        t = x - 3.0
    c0 = a * (a - 20.0) - 24.0 * j - 4.0 * b
    c1 = 64.0 - 12.0 * a - 8.0 * j
    c2 = 48.0 - 2.0 * a
    step = newton_step_of(t, c0, c1, c2)
    t -= step
    if wp.abs(step) > LAST_STEP * (t + 3.0):
        t -= newton_step_of(t, c0, c1, c2)
    return t


@wp.func
def stretch_stress(w: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of the corotated law from the displacement gradient W in an orthonormal frame, and
    whether it may be trusted: where F = I + W is neither flat, turned over nor far from order one."""
    e00 = 2.0 * w[0, 0] + (w[0, 0] * w[0, 0] + w[1, 0] * w[1, 0] + w[2, 0] * w[2, 0])
    e11 = 2.0 * w[1, 1] + (w[0, 1] * w[0, 1] + w[1, 1] * w[1, 1] + w[2, 1] * w[2, 1])
    e22 = 2.0 * w[2, 2] + (w[0, 2] * w[0, 2] + w[1, 2] * w[1, 2] + w[2, 2] * w[2, 2])
    e01 = (w[0, 1] + w[1, 0]) + (w[0, 0] * w[0, 1] + w[1, 0] * w[1, 1] + w[2, 0] * w[2, 1])
    e02 = (w[0, 2] + w[2, 0]) + (w[0, 0] * w[0, 2] + w[1, 0] * w[1, 2] + w[2, 0] * w[2, 2])
    e12 = (w[1, 2] + w[2, 1]) + (w[0, 1] * w[0, 2] + w[1, 1] * w[1, 2] + w[2, 1] * w[2, 2])
    d00 = e11 * e22 - e12 * e12
    d11 = e00 * e22 - e02 * e02
    d22 = e00 * e11 - e01 * e01
    d01 = e02 * e12 - e01 * e22
    d02 = e01 * e12 - e02 * e11
    d12 = e01 * e02 - e00 * e12
    a = e00 + e11 + e22
    b = d00 + d11 + d22
    c = e00 * d00 + e01 * d01 + e02 * d02
    f00 = 1.0 + w[0, 0]
    f11 = 1.0 + w[1, 1]
    f22 = 1.0 + w[2, 2]
    volume = (
        f00 * (f11 * f22 - w[1, 2] * w[2, 1])
        - w[0, 1] * (w[1, 0] * f22 - w[1, 2] * w[2, 0])
        + w[0, 2] * (w[1, 0] * w[2, 1] - f11 * w[2, 0])
    )
    p = wp.mat33()
    # A comparison with NaN is false.
    trusted = volume > FLAT and a < FAR
    if trusted:
        # J^2 - 1 = a + b + c.
        j = (a + b + c) * reciprocal(1.0 + volume)
        t = stretch_trace(a, b, c, j)
        q = 16.0 + t * (24.0 + t * (9.0 + t)) - a * (3.0 + t) - 2.0 * j
        kt = lam * t
        weight = (2.0 * mu - kt) * reciprocal(q)
        y = (2.0 * t - 6.0 * j) * reciprocal(volume)
        n0 = t * (18.0 + t * (8.0 + t)) - a * (10.0 + t) - 2.0 * j - y * (1.0 + a)
        s0 = kt + weight * n0
        s1 = weight * (8.0 + y)
        s2 = -weight * (6.0 + y)
        s00 = s0 + s1 * e00 + s2 * d00
        s11 = s0 + s1 * e11 + s2 * d11
        s22 = s0 + s1 * e22 + s2 * d22
        s01 = s1 * e01 + s2 * d01
        s02 = s1 * e02 + s2 * d02
        s12 = s1 * e12 + s2 * d12
        p = wp.mat33(
            f00 * s00 + w[0, 1] * s01 + w[0, 2] * s02,
            f00 * s01 + w[0, 1] * s11 + w[0, 2] * s12,
            f00 * s02 + w[0, 1] * s12 + w[0, 2] * s22,
            w[1, 0] * s00 + f11 * s01 + w[1, 2] * s02,
            w[1, 0] * s01 + f11 * s11 + w[1, 2] * s12,
            w[1, 0] * s02 + f11 * s12 + w[1, 2] * s22,
            w[2, 0] * s00 + w[2, 1] * s01 + f22 * s02,
            w[2, 0] * s01 + w[2, 1] * s11 + f22 * s12,
            w[2, 0] * s02 + w[2, 1] * s12 + f22 * s22,
        )
    return p, trusted


@wp.func
def turned_stress(f: wp.mat33, mu: float, lam: float):
    """As ``stretch_stress``, but from F and for every F. Where E is small the result loses digits."""
    r = robust_rotation(f)
    return (2.0 * mu) * f + (lam * (wp.ddot(r, f) - 3.0) - 2.0 * mu) * r


@wp.func(inline=False)
def turned_stress_out_of_line(f: wp.mat33, mu: float, lam: float):
    return turned_stress(f, mu, lam)


@wp.func
def corotated_stress(a: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress of the corotated law from any displacement gradient A."""
    p, trusted = stretch_stress(a, mu, lam)
    if not trusted:
        p = turned_stress_out_of_line(identity3() + a, mu, lam)
    return p


# --- the energy ------------------------------------------------------------------------------------------------------
#
# The corotated energy without rotations, in closed form; see ``algebraic`` for the invariants and the trace of S.
#
# With D = S - I, of invariants t, i2, i3, the density is mu |D|^2 + lambda/2 t^2, |D|^2 = t^2 - 2 i2. From
# 2 i2 = t^2 + 2t - tr E come few digits where the strain is small. There E = D^2 + 2D gives
#     tr adj E = i2 (4 + 2t + i2) - i3 (6 + 2t),  det E = i3 (8 + 4t + 2 i2 + i3),
# in which the sums need no more digits than that i2 has.

OF_OWN_ROTATIONS = Family(__name__)


@wp.func
def stretch_energy(w: wp.mat33, mu: float, lam: float):
    """The density from the displacement gradient W in an orthonormal frame, and whether it may be trusted; as
    ``stretch_stress``."""
    e = w + wp.transpose(w) + wp.transpose(w) * w
    d00 = e[1, 1] * e[2, 2] - e[1, 2] * e[1, 2]
    d11 = e[0, 0] * e[2, 2] - e[0, 2] * e[0, 2]
    d22 = e[0, 0] * e[1, 1] - e[0, 1] * e[0, 1]
    d01 = e[0, 2] * e[1, 2] - e[0, 1] * e[2, 2]
    d02 = e[0, 1] * e[1, 2] - e[0, 2] * e[1, 1]
    a = wp.trace(e)
    b = d00 + d11 + d22
    c = e[0, 0] * d00 + e[0, 1] * d01 + e[0, 2] * d02
    volume = wp.determinant(identity3() + w)
    # A comparison with NaN is false.
    trusted = volume > FLAT and a < FAR
    density = float(0.0)
    if trusted:
        j = (a + b + c) * reciprocal(1.0 + volume)
        t = stretch_trace(a, b, c, j)
        i2 = 0.5 * (t * (2.0 + t) - a)
        if a * a - 2.0 * b < NEAR:
            i3 = c * reciprocal(8.0 + 4.0 * t + 2.0 * i2 + (j - t - i2))
            i2 = (b + i3 * (6.0 + 2.0 * t)) * reciprocal(4.0 + 2.0 * t + i2)
        density = mu * (t * t - 2.0 * i2) + 0.5 * lam * t * t
    return density, trusted


@wp.func(inline=False)
def turned_energy(f: wp.mat33, mu: float, lam: float):
    """The density of F, for every F."""
    strain = symmetric(wp.transpose(rotation_out_of_line(f)) * f) - identity3()
    return hooke_energy(strain, mu, lam)


@wp.func
def corotated_energy(a: wp.mat33, mu: float, lam: float):
    """The density of any displacement gradient A."""
    density, trusted = stretch_energy(a, mu, lam)
    if not trusted:
        density = turned_energy(identity3() + a, mu, lam)
    return density


@wp.func
def own_density(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    """The density of an element with its own rotation."""
    i = t * material.stride
    return corotated_energy(own_gradient(elements, t, u), material.mu[i], material.lam[i])


@wp.func
def own_cauchy(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    """Cauchy stress of an element for display, with its own rotation."""
    i = t * material.stride
    g = local_gradient(elements, t, u)
    q = frame(elements, t)
    return hooke(corotated_strain(g, q, quick_rotation(q + g)), material.mu[i], material.lam[i])


@OF_OWN_ROTATIONS.member
def own_energies(Elements: type) -> wp.Kernel:
    return element_energies(Elements, IsotropicMaterial, own_density, OF_OWN_ROTATIONS.kernel)


@OF_OWN_ROTATIONS.member
def own_von_mises(Elements: type) -> wp.Kernel:
    return element_von_mises(Elements, IsotropicMaterial, own_cauchy, OF_OWN_ROTATIONS.kernel)
