"""Rotations of any F, inverted and singular ones too, as quaternions: the maximiser of tr(R^T F), det R = +1.

``robust_rotation``: tr(R^T F) = q^T K q for the quaternion q of R and a symmetric 4x4 matrix K of F's entries
(Davenport; Horn 1987; Higham and Noferini 2016), so the quaternion sought is K's dominant eigenvector for every F. It
takes a fixed number of operations and no SVD.
``turn_quaternion`` iterates on a quaternion that the caller keeps (Müller et al. 2016), with the exact Hessian where it
is positive definite (Kugelstadt, Koschier and Bender 2018).
"""

import warp as wp

from .matrices import all_finite, cofactor, column, identity3, largest_entry

wp.set_module_options({"enable_backward": False})

MAX_TURNS = wp.constant(40)

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
