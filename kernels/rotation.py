"""Rotations from deformation gradients: the proper rotation R that maximises tr(R^T F), det R = +1 for every F.

``byers_xu`` is the paper's method: Newton's iteration with the scaling of Byers and Xu (2008),
    X <- (zeta X + X^-T / zeta) / 2.
Its stopping test as printed (eq. 6) measures ||X - X*||, which does not vanish at a rotation; what tends to zero is the
step, and that is what is tested here against the paper's 3.85e-5.
``mcadams_svd`` is the baseline, U V^T of Warp's 3x3 SVD (McAdams et al. 2011).
``turn_quaternion`` iterates on a quaternion that the caller keeps (Müller et al. 2016), with the exact Hessian where it
is positive definite (Kugelstadt, Koschier and Bender 2018).

Newton's iteration has no answer for a singular F and gives a reflection for an inverted one. Both are left to
``robust_rotation``: tr(R^T F) = q^T K q for the quaternion q of R and a symmetric 4x4 matrix K of F's entries
(Davenport; Horn 1987; Higham and Noferini 2016), so the quaternion sought is K's dominant eigenvector for every F. It
takes a fixed number of operations and no SVD.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: The paper's sigma.
DEFAULT_TOLERANCE = 3.85e-5

# det F / |F|^3 below which an element counts as flattened or inverted. For singular values (1, 1, s): s < 3e-3.
FLATNESS = wp.constant(1.0e-3)
MAX_NEWTON = wp.constant(16)
MAX_TURNS = wp.constant(40)
MAX_FLOAT = wp.constant(3.4028234e38)


ITERATIONS = 4

# Of the unscaled iteration: how many, det F below which it is not tried, and det X - 1 before the last iteration beyond
# which it has not converged (the rotation's error is at most half the square of that).
FLAT = wp.constant(0.03)
UNCONVERGED = wp.constant(1.0e-3)
# Iterations that may follow them: enough for principal stretches of 1e4 or 1e-4, each halves what is far from one.
MORE_ITERATIONS = wp.constant(12)

# Of the dominant eigenvector of K: Newton steps on the quartic, the least slope over |F|^3 for one, what is added to
# the root over |F|, squarings of the resolvent, and quaternion steps. Chosen on 1e5 matrices, a tenth mirrored: where
# (sigma_2 + sign(det F) sigma_3) / sigma_1 > 0.1 the largest error was 3e-6, and tr(R^T F) was never 0.5 % below its
# maximum.
ROOT_STEPS = wp.constant(6)
LEAST_SLOPE = wp.constant(0.01)
ROOT_MARGIN = wp.constant(2.0e-3)
SQUARINGS = wp.constant(3)
POLISHING_TURNS = wp.constant(2)


@wp.func
def identity3():
    return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


@wp.func
def column(a: wp.mat33, j: int):
    return wp.vec3(a[0, j], a[1, j], a[2, j])


@wp.func
def cofactor(a: wp.mat33):
    """det(A) A^-T, which exists for every A."""
    a0 = column(a, 0)
    a1 = column(a, 1)
    a2 = column(a, 2)
    return wp.matrix_from_cols(wp.cross(a1, a2), wp.cross(a2, a0), wp.cross(a0, a1))


@wp.func
def frobenius(a: wp.mat33):
    return wp.sqrt(wp.ddot(a, a))


@wp.func
def largest_entry(a: wp.mat33):
    m = float(0.0)
    for i in range(3):
        for j in range(3):
            m = wp.max(m, wp.abs(a[i, j]))
    return m


@wp.func
def all_finite(a: wp.mat33):
    ok = bool(True)
    for i in range(3):
        for j in range(3):
            # A comparison with NaN is false, and so is one with an infinity beyond the largest float.
            ok = ok and (wp.abs(a[i, j]) <= MAX_FLOAT)
    return ok


@wp.func
def is_well_shaped(f: wp.mat33):
    """Whether Newton's iteration may be used: det F well above zero, and no power of F out of range."""
    n2 = wp.ddot(f, f)
    return n2 > 1.0e-8 and n2 < 1.0e8 and wp.determinant(f) > FLATNESS * n2 * wp.sqrt(n2)


@wp.func
def leading_eigenvector(s: wp.mat33, scale: float):
    """About the eigenvector of the largest eigenvalue of a symmetric matrix of entries up to ``scale``."""
    m = s / scale + 3.0 * identity3()
    for _ in range(5):
        m = m * m
        m = m / largest_entry(m)
    v = column(m, 0)
    for j in range(1, 3):
        if wp.length_sq(column(m, j)) > wp.length_sq(v):
            v = column(m, j)
    return wp.normalize(v)


@wp.func
def slope_and_hessian(f: wp.mat33, q: wp.quat):
    """b = R^T F, the slope of tr(R^T F) against a rotation vector in the rotated frame, and minus its Hessian."""
    b = wp.transpose(wp.quat_to_matrix(q)) * f
    axial = wp.vec3(b[2, 1] - b[1, 2], b[0, 2] - b[2, 0], b[1, 0] - b[0, 1])
    return b, axial, wp.trace(b) * identity3() - 0.5 * (b + wp.transpose(b))


@wp.func
def newton_turn(axial: wp.vec3, h: wp.mat33, scale: float):
    """Newton's step towards the maximum, and whether it is one: h well above singular."""
    minor = h[0, 0] * h[1, 1] - h[0, 1] * h[0, 1]
    det = wp.determinant(h)
    sound = h[0, 0] > 1.0e-3 * scale and minor > 1.0e-4 * scale * scale and det > 1.0e-6 * scale * scale * scale
    w = wp.vec3()
    if sound:
        w = wp.transpose(cofactor(h)) * axial / det
    return w, sound


@wp.func
def turned_by(q: wp.quat, w: wp.vec3):
    return wp.normalize(q * wp.quat(0.5 * w[0], 0.5 * w[1], 0.5 * w[2], 1.0))


@wp.func
def turn(f: wp.mat33, q: wp.quat):
    """The rotation vector, in the rotated frame, that carries q towards the maximum of tr(R^T F)."""
    b, axial, h = slope_and_hessian(f, q)
    scale = wp.max(largest_entry(b), 1.0e-30)
    w, sound = newton_turn(axial, h, scale)
    if not sound:
        # Past the reach of Newton's step: where the slope is small it would creep along a saddle, so leave about the
        # axis of upward curvature.
        trace = wp.trace(b)
        w = axial / (wp.abs(trace) + scale)
        axis = leading_eigenvector(trace * identity3() - h, scale)
        if wp.dot(axis, h * axis) < -1.0e-3 * scale:
            w += wp.where(wp.dot(axis, axial) < 0.0, -0.7, 0.7) * axis
    return w


@wp.func
def turn_quaternion(f: wp.mat33, guess: wp.quat, iterations: int, tolerance: float):
    """The rotation of F as a quaternion, by at most ``iterations`` steps from ``guess``; F of order one."""
    q = guess
    for _ in range(iterations):
        w = turn(f, q)
        q = turned_by(q, w)
        if wp.length_sq(w) < tolerance * tolerance:
            break
    return q


@wp.func
def warm_rotation(f: wp.mat33, guess: wp.quat):
    """The rotation of any F as a quaternion, started from ``guess``; a non-finite or zero F returns the guess."""
    m = largest_entry(f)
    q = guess
    if all_finite(f) and m > 0.0:
        # The step after one of 1e-4 would be of order 1e-8: quadratic convergence has done the rest already.
        q = turn_quaternion(f / m, guess, MAX_TURNS, 1.0e-4)
    return q


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
def davenport(f: wp.mat33):
    """K: tr(R^T F) = q^T K q, q = (w, x, y, z)."""
    a = f[2, 1] - f[1, 2]
    b = f[0, 2] - f[2, 0]
    c = f[1, 0] - f[0, 1]
    xy = f[0, 1] + f[1, 0]
    xz = f[0, 2] + f[2, 0]
    yz = f[1, 2] + f[2, 1]
    x = f[0, 0]
    y = f[1, 1]
    z = f[2, 2]
    return wp.mat44(x + y + z, a, b, c, a, x - y - z, xy, xz, b, xy, y - x - z, yz, c, xz, yz, z - x - y)


@wp.func
def largest_root(f: wp.mat33):
    """The largest eigenvalue of K, sigma_1 + sigma_2 + sign(det F) sigma_3, a little too large, for F of order one.

    Newton's iteration on the characteristic polynomial, whose roots are all real, descends from above. Where roots
    nearly meet it ends that far above them, and where the slope vanishes it stops.
    """
    c = cofactor(f)
    n2 = wp.ddot(f, f)
    c2 = wp.ddot(c, c)
    det = wp.dot(column(f, 0), column(c, 0))
    n = wp.sqrt(n2)
    # sigma_2 sigma_3 + ... of positive terms is at most sqrt(3) |cof F|; of an inverted F one term alone is positive.
    root = wp.sqrt(n2 + wp.where(det > 0.0, 3.4641016, 2.0) * wp.sqrt(c2))
    for _ in range(ROOT_STEPS):
        square = root * root
        value = ((square - 2.0 * n2) * root - 8.0 * det) * root + (n2 * n2 - 4.0 * c2)
        slope = 4.0 * (square - n2) * root - 8.0 * det
        if slope > LEAST_SLOPE * n2 * n:
            root -= value / slope
    return root + ROOT_MARGIN * n


@wp.func
def symmetric_adjugate(m: wp.mat44):
    s0 = m[0, 0] * m[1, 1] - m[0, 1] * m[0, 1]
    s1 = m[0, 0] * m[1, 2] - m[0, 1] * m[0, 2]
    s2 = m[0, 0] * m[1, 3] - m[0, 1] * m[0, 3]
    s3 = m[0, 1] * m[1, 2] - m[1, 1] * m[0, 2]
    s4 = m[0, 1] * m[1, 3] - m[1, 1] * m[0, 3]
    s5 = m[0, 2] * m[1, 3] - m[1, 2] * m[0, 3]
    c1 = m[0, 2] * m[2, 3] - m[0, 3] * m[2, 2]
    c2 = m[0, 2] * m[3, 3] - m[0, 3] * m[2, 3]
    c3 = m[1, 2] * m[2, 3] - m[1, 3] * m[2, 2]
    c4 = m[1, 2] * m[3, 3] - m[1, 3] * m[2, 3]
    c5 = m[2, 2] * m[3, 3] - m[2, 3] * m[2, 3]
    a00 = m[1, 1] * c5 - m[1, 2] * c4 + m[1, 3] * c3
    a01 = m[0, 2] * c4 - m[0, 1] * c5 - m[0, 3] * c3
    a02 = m[1, 3] * s5 - m[2, 3] * s4 + m[3, 3] * s3
    a03 = m[2, 2] * s4 - m[1, 2] * s5 - m[2, 3] * s3
    a11 = m[0, 0] * c5 - m[0, 2] * c2 + m[0, 3] * c1
    a12 = m[2, 3] * s2 - m[0, 3] * s5 - m[3, 3] * s1
    a13 = m[0, 2] * s5 - m[2, 2] * s2 + m[2, 3] * s1
    a22 = m[0, 3] * s4 - m[1, 3] * s2 + m[3, 3] * s0
    a23 = m[1, 2] * s2 - m[0, 2] * s4 - m[2, 3] * s0
    a33 = m[0, 2] * s3 - m[1, 2] * s1 + m[2, 2] * s0
    return wp.mat44(a00, a01, a02, a03, a01, a11, a12, a13, a02, a12, a22, a23, a03, a13, a23, a33)


@wp.func
def dominant_quaternion(f: wp.mat33):
    """The quaternion of the rotation of F, for F of order one.

    The adjugate of (root I - K) is its inverse but for a factor, and exists where eigenvalues meet. In its powers the
    dominant eigenvector outgrows the others.
    """
    k = davenport(f)
    root = largest_root(f)
    p = symmetric_adjugate(wp.diag(wp.vec4(root, root, root, root)) - k)
    for _ in range(SQUARINGS):
        p = p / wp.max(wp.abs(wp.trace(p)), 1.0e-30)
        p = p * p
    best = int(0)
    for j in range(1, 4):
        if p[j, j] > p[best, best]:
            best = j
    q = wp.quat(p[1, best], p[2, best], p[3, best], p[0, best])
    return wp.normalize(q)


@wp.func
def robust_rotation(f: wp.mat33):
    """The rotation of an F of any rank, sign and size; the identity for a zero or non-finite F."""
    r = identity3()
    m = largest_entry(f)
    if all_finite(f) and m > 0.0:
        a = f / m
        q = dominant_quaternion(a)
        for _ in range(POLISHING_TURNS):
            _b, axial, h = slope_and_hessian(a, q)
            w, _sound = newton_turn(axial, h, 1.0)
            q = turned_by(q, w)
        r = wp.quat_to_matrix(q)
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


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float r;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(r) : "f"(x));
    return r;
#else
    return 1.0f / x;
#endif
""")
def reciprocal(x: float) -> float: ...


@wp.func
def newton_rotation(c0: wp.vec3, c1: wp.vec3, c2: wp.vec3, handedness: float):
    """Z = 2^ITERATIONS R of the columns of F, and whether it may be trusted: F neither flat, inverted nor far from one.

    Newton's iteration unscaled, X <- (X + X^-T)/2, for F of order one: four steps are enough for principal stretches
    between 0.45 and 2.2. It runs on Z = s X with s doubling in every step, Z <- Z + (s^2 / det Z) cof Z, one
    multiply-add a component. Where four are not enough it goes on with s kept.
    """
    z0 = c0
    z1 = c1
    z2 = c2
    det = float(0.0)
    sound = bool(True)
    for iteration in range(wp.static(ITERATIONS)):
        a0 = wp.cross(z1, z2)
        a1 = wp.cross(z2, z0)
        a2 = wp.cross(z0, z1)
        det = wp.dot(z0, a0)
        if wp.static(iteration == 0):
            sound = handedness * det > FLAT
        r = wp.static(4.0**iteration) * reciprocal(det)
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
def robust_rotation_outlined(f: wp.mat33):
    return robust_rotation(f)


@wp.func
def quick_rotation(f: wp.mat33):
    """As ``byers_xu`` and at least as near: unscaled where that converges, which nearly all elements let it."""
    z0, z1, z2, trusted = newton_rotation(column(f, 0), column(f, 1), column(f, 2), 1.0)
    r = wp.static(0.5**ITERATIONS) * wp.matrix_from_cols(z0, z1, z2)
    if not trusted:
        r = robust_rotation_outlined(f)
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
