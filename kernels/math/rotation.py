"""Rotations from deformation gradients: the proper rotation R that maximises tr(R^T F), det R = +1 for every F.

``byers_xu`` is the paper's method: Newton's iteration with the scaling of Byers and Xu (2008),
    X <- (zeta X + X^-T / zeta) / 2.
Its stopping test as printed (eq. 6) measures ||X - X*||, which does not vanish at a rotation; the step tends to zero,
and is tested here against the paper's 3.85e-5.
``mcadams_svd`` is the baseline, U V^T of Warp's 3x3 SVD (McAdams et al. 2011).

Newton's iteration has no result for a singular F and gives a reflection for an inverted one. For both,
``quaternion.robust_rotation`` is used.
"""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .matrices import all_finite, cofactor, column, frobenius, identity3, largest_entry, reciprocal
from .quaternion import robust_rotation

wp.set_module_options({"enable_backward": False})

#: The paper's sigma.
DEFAULT_TOLERANCE = 3.85e-5

# det F / |F|^3 below which an element counts as flattened or inverted. For singular values (1, 1, s): s < 3e-3.
FLATNESS = wp.constant(1.0e-3)
MAX_NEWTON = wp.constant(16)


ITERATIONS = 4

# The unscaled iteration: its number of steps, det F below which it is not tried, and det X - 1 before the last step
# above which it has not converged (the rotation's error is at most half the square of that).
FLAT = wp.constant(0.03)
UNCONVERGED = wp.constant(1.0e-3)
# Further iterations: enough for principal stretches of 1e4 or 1e-4, each halves values far from one.
MORE_ITERATIONS = wp.constant(12)


@wp.func
def is_well_shaped(f: wp.mat33):
    """Whether Newton's iteration may be used: det F well above zero, and no power of F out of range."""
    n2 = wp.ddot(f, f)
    return n2 > 1.0e-8 and n2 < 1.0e8 and wp.determinant(f) > FLATNESS * n2 * wp.sqrt(n2)


@wp.func
def mcadams_svd(f: wp.mat33):
    """U V^T of Warp's SVD, of F scaled to order one; the identity for a zero or non-finite F."""
    r = identity3()
    m = largest_entry(f)
    if all_finite(f) and m > 0.0:
        u, _s, v = wp.svd3(f / m)
        r = u * wp.transpose(v)
    return r


@wp.func
def newton_step(x: wp.mat33, zeta: float):
    c = cofactor(x)
    det = wp.dot(column(x, 0), column(c, 0))
    return (0.5 * zeta) * x + (0.5 / (zeta * det)) * c


@wp.func
def next_zeta(zeta: float):
    return wp.sqrt(2.0 / (zeta + 1.0 / zeta))


@wp.func
def first_zetas(f: wp.mat33):
    """zeta_0 and zeta_1 of Byers and Xu from the bounds a = 1/||F^-1||_F <= sigma_min and b = ||F||_F >= sigma_max."""
    b = frobenius(f)
    a = wp.determinant(f) / frobenius(cofactor(f))
    root = wp.sqrt(b / a)
    return 1.0 / wp.sqrt(a * b), wp.sqrt(2.0 / (root + 1.0 / root))


@wp.func
def byers_xu_newton(f: wp.mat33, tolerance: float):
    zeta0, zeta = first_zetas(f)
    x = newton_step(f, zeta0)
    step = float(1.0)
    iteration = int(1)
    while step > tolerance and iteration < MAX_NEWTON:
        y = newton_step(x, zeta)
        step = frobenius(y - x)
        x = y
        zeta = next_zeta(zeta)
        iteration += 1
    return x


@wp.func
def byers_xu(f: wp.mat33):
    """Byers-Xu to the paper's tolerance."""
    r = wp.mat33()
    if is_well_shaped(f):
        r = byers_xu_newton(f, wp.static(DEFAULT_TOLERANCE))
    elif all_finite(f) and is_well_shaped(f / wp.max(largest_entry(f), 1.0e-38)):
        r = byers_xu_newton(f / largest_entry(f), wp.static(DEFAULT_TOLERANCE))
    else:
        r = robust_rotation(f)
    return r


@wp.func
def newton_rotation(c0: wp.vec3, c1: wp.vec3, c2: wp.vec3, handedness: float):
    """Z = 2^ITERATIONS R of the columns of F, and whether it is reliable: F neither flat, inverted nor far from one.

    Newton's iteration unscaled, X <- (X + X^-T)/2, for F of order one: four steps are enough for principal stretches
    between 0.45 and 2.2. It runs on Z = s X with s doubling in every step, Z <- Z + (s^2 / det Z) cof Z, one
    multiply-add a component. If four are not enough, it continues with constant s.
    """
    z0 = c0
    z1 = c1
    z2 = c2
    det = float(0.0)
    sound = bool(True)
    # Not a static power of the iteration: Warp names a kernel with such a number differently before and after its code
    # is generated, and would compile it twice.
    factor = float(1.0)
    for iteration in range(wp.static(ITERATIONS)):
        a0 = wp.cross(z1, z2)
        a1 = wp.cross(z2, z0)
        a2 = wp.cross(z0, z1)
        det = wp.dot(z0, a0)
        if iteration == 0:
            sound = handedness * det > FLAT
        r = factor * reciprocal(det)
        factor = 4.0 * factor
        z0 = z0 + r * a0
        z1 = z1 + r * a1
        z2 = z2 + r * a2
    # det X before the last iteration.
    volume = wp.static(0.125 ** (ITERATIONS - 1)) * handedness * det
    more = int(0)
    while sound and volume >= 1.0 + UNCONVERGED and more < MORE_ITERATIONS:
        a0 = wp.cross(z1, z2)
        a1 = wp.cross(z2, z0)
        a2 = wp.cross(z0, z1)
        det = wp.dot(z0, a0)
        volume = wp.static(0.125**ITERATIONS) * handedness * det
        r = wp.static(0.5 * 4.0**ITERATIONS) * reciprocal(det)
        z0 = 0.5 * z0 + r * a0
        z1 = 0.5 * z1 + r * a1
        z2 = 0.5 * z2 + r * a2
        more += 1
    return z0, z1, z2, sound and volume < 1.0 + UNCONVERGED


@wp.func(inline=False)
def rotation_out_of_line(f: wp.mat33):
    return robust_rotation(f)


@wp.func
def quick_rotation(f: wp.mat33):
    """The same as ``byers_xu`` and at least as accurate: unscaled if that converges, as for nearly all elements."""
    z0, z1, z2, trusted = newton_rotation(column(f, 0), column(f, 1), column(f, 2), 1.0)
    r = wp.static(0.5**ITERATIONS) * wp.matrix_from_cols(z0, z1, z2)
    if not trusted:
        r = rotation_out_of_line(f)
    return r


def byers_xu_fixed(iterations: int) -> wp.Function:
    """Byers-Xu with a fixed number of iterations, unrolled: no test, no divergence."""

    @wp.func
    def byers_xu_unrolled(f: wp.mat33):
        r = wp.mat33()
        a = f
        well_shaped = is_well_shaped(f)
        if not well_shaped and all_finite(f):
            a = f / wp.max(largest_entry(f), 1.0e-38)
            well_shaped = is_well_shaped(a)
        if well_shaped:
            zeta0, zeta = first_zetas(a)
            r = newton_step(a, zeta0)
            for _ in range(wp.static(iterations - 1)):
                r = newton_step(r, zeta)
                zeta = next_zeta(zeta)
        else:
            r = robust_rotation(f)
        return r

    return byers_xu_unrolled


@functools.cache
def rotate_all(rotation: wp.Function) -> wp.Kernel:
    """Rotations of arrays of matrices."""

    @unique_kernel()
    def rotate_all(matrices: wp.array[wp.mat33], rotations: wp.array[wp.mat33]):
        i = wp.tid()
        rotations[i] = rotation(matrices[i])

    return rotate_all
