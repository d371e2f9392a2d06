"""Rotations of any F, inverted and singular ones too, as quaternions: the maximiser of tr(R^T F), det R = +1.

``robust_rotation``: tr(R^T F) = q^T K q for the quaternion q of R and a symmetric 4x4 matrix K of F's entries
(Davenport; Horn 1987; Higham and Noferini 2016), so this quaternion is K's dominant eigenvector for every F. It
takes some four hundred operations without a branch, the same for every F, and no SVD.
"""

import warp as wp

from .matrices import cofactor, column, identity3, largest_entry, reciprocal, reciprocal_root, square_root

wp.set_module_options({"enable_backward": False})

# The largest eigenvalue of K for |F| = 1: number of steps of Laguerre's method, and the smallest denominator of a step.
# The value that replaces the eigenvalue lies above it where the characteristic polynomial has the minimum slope, but at
# most this far above.
ROOT_STEPS = wp.constant(3)
LEAST_DENOMINATOR = wp.constant(0.01)
LEAST_SLOPE = wp.constant(3.0e-3)
MOST_SHIFT = wp.constant(0.02)
# Range of |F|^2 in which its square and inverse root are representable.
SMALL = wp.constant(1.0e-20)
LARGE = wp.constant(1.0e20)
POWER_OF_TWO = wp.constant(2.0**100)


@wp.func
def sum_of_squares(a: wp.mat33):
    a0 = column(a, 0)
    a1 = column(a, 1)
    a2 = column(a, 2)
    return wp.dot(a0, a0) + (wp.dot(a1, a1) + wp.dot(a2, a2))


@wp.func
def largest_root(n2: float, c2: float, det: float):
    """The largest eigenvalue of K, sigma_1 + sigma_2 + sign(det F) sigma_3, of |F|^2 = n2 = 1, |cof F|^2 and det F.

    It is the largest root of x^4 - 2 n2 x^2 - 8 det x + n2^2 - 4 c2, whose roots are all real: Laguerre's method
    descends to it from the bound above it. At a multiple root the slope vanishes, and the result is slightly too
    large.
    """
    # x^2 = n2 + 2 y, y^2 = c2 + 2 det x, with x from 1 / sqrt(3) to sqrt(3).
    x = square_root(n2 + 2.0 * square_root(wp.max(c2 + wp.where(det > 0.0, 3.4641016, 1.1547005) * det, 0.0)))
    last = n2 * n2 - 4.0 * c2
    for _ in range(ROOT_STEPS):
        square = x * x
        value = ((square - 2.0 * n2) * x - 8.0 * det) * x + last
        slope = 4.0 * (square - n2) * x - 8.0 * det
        under = 9.0 * slope * slope - 48.0 * value * (3.0 * square - n2)
        x -= 4.0 * value * reciprocal(wp.max(slope + square_root(wp.max(under, 0.0)), LEAST_DENOMINATOR))
    missing = LEAST_SLOPE - (4.0 * (x * x - n2) * x - 8.0 * det)
    if missing > 0.0:
        curvature = wp.max(12.0 * x * x - 4.0 * n2, 1.0e-3)
        x += wp.min(missing * reciprocal(curvature), MOST_SHIFT)
    return x


@wp.func
def dominant_quaternion(f: wp.mat33):
    """Approximate quaternion of the rotation of F, for |F| = 1.

    The adjugate of (root I - K) is its inverse up to a factor, and exists for multiple eigenvalues. In its powers the
    dominant eigenvector outgrows the others: this is the largest column of the sixth power.
    """
    c = cofactor(f)
    root = largest_root(sum_of_squares(f), sum_of_squares(c), wp.dot(column(f, 0), column(c, 0)))
    # root I - K, of q = (w, x, y, z).
    m01 = f[1, 2] - f[2, 1]
    m02 = f[2, 0] - f[0, 2]
    m03 = f[0, 1] - f[1, 0]
    m12 = -f[0, 1] - f[1, 0]
    m13 = -f[0, 2] - f[2, 0]
    m23 = -f[1, 2] - f[2, 1]
    m00 = root - f[0, 0] - f[1, 1] - f[2, 2]
    m11 = root - f[0, 0] + f[1, 1] + f[2, 2]
    m22 = root + f[0, 0] - f[1, 1] + f[2, 2]
    m33 = root + f[0, 0] + f[1, 1] - f[2, 2]
    s0 = m00 * m11 - m01 * m01
    s1 = m00 * m12 - m01 * m02
    s2 = m00 * m13 - m01 * m03
    s3 = m01 * m12 - m11 * m02
    s4 = m01 * m13 - m11 * m03
    s5 = m02 * m13 - m12 * m03
    c1 = m02 * m23 - m03 * m22
    c2 = m02 * m33 - m03 * m23
    c3 = m12 * m23 - m13 * m22
    c4 = m12 * m33 - m13 * m23
    c5 = m22 * m33 - m23 * m23
    a00 = m11 * c5 - m12 * c4 + m13 * c3
    a01 = m02 * c4 - m01 * c5 - m03 * c3
    a02 = m13 * s5 - m23 * s4 + m33 * s3
    a03 = m22 * s4 - m12 * s5 - m23 * s3
    a11 = m00 * c5 - m02 * c2 + m03 * c1
    a12 = m23 * s2 - m03 * s5 - m33 * s1
    a13 = m02 * s5 - m22 * s2 + m23 * s1
    a22 = m03 * s4 - m13 * s2 + m33 * s0
    a23 = m12 * s2 - m02 * s4 - m23 * s0
    a33 = m02 * s3 - m12 * s1 + m22 * s0
    b00 = a00 * a00 + a01 * a01 + a02 * a02 + a03 * a03
    b01 = a00 * a01 + a01 * a11 + a02 * a12 + a03 * a13
    b02 = a00 * a02 + a01 * a12 + a02 * a22 + a03 * a23
    b03 = a00 * a03 + a01 * a13 + a02 * a23 + a03 * a33
    b11 = a01 * a01 + a11 * a11 + a12 * a12 + a13 * a13
    b12 = a01 * a02 + a11 * a12 + a12 * a22 + a13 * a23
    b13 = a01 * a03 + a11 * a13 + a12 * a23 + a13 * a33
    b22 = a02 * a02 + a12 * a12 + a22 * a22 + a23 * a23
    b23 = a02 * a03 + a12 * a13 + a22 * a23 + a23 * a33
    b33 = a03 * a03 + a13 * a13 + a23 * a23 + a33 * a33
    # Selections, because a variable index would put the matrix into memory.
    q = wp.where(b11 > b00, wp.vec4(b01, b11, b12, b13), wp.vec4(b00, b01, b02, b03))
    other = wp.where(b33 > b22, wp.vec4(b03, b13, b23, b33), wp.vec4(b02, b12, b22, b23))
    q = wp.where(wp.max(b22, b33) > wp.max(b00, b11), other, q)
    for _ in range(2):
        q = wp.vec4(
            b00 * q[0] + b01 * q[1] + b02 * q[2] + b03 * q[3],
            b01 * q[0] + b11 * q[1] + b12 * q[2] + b13 * q[3],
            b02 * q[0] + b12 * q[1] + b22 * q[2] + b23 * q[3],
            b03 * q[0] + b13 * q[1] + b23 * q[2] + b33 * q[3],
        )
    q = reciprocal_root(wp.max(wp.dot(q, q), 1.0e-36)) * q
    return wp.quat(q[1], q[2], q[3], q[0])


@wp.func
def matrix_of(q: wp.quat):
    """The rotation of a quaternion of length one."""
    x2 = q[0] + q[0]
    y2 = q[1] + q[1]
    z2 = q[2] + q[2]
    xx = q[0] * x2
    yy = q[1] * y2
    zz = q[2] * z2
    xy = q[0] * y2
    xz = q[0] * z2
    yz = q[1] * z2
    wx = q[3] * x2
    wy = q[3] * y2
    wz = q[3] * z2
    return wp.mat33(
        1.0 - (yy + zz), xy - wz, xz + wy,
        xy + wz, 1.0 - (xx + zz), yz - wx,
        xz - wy, yz + wx, 1.0 - (xx + yy),
    )  # fmt: skip


@wp.func
def polished(f: wp.mat33, q: wp.quat):
    """q after one Newton step towards the maximum of tr(R^T F), |F| = 1; it cubes the error.

    The Hessian is tr(B) I - (B + B^T) / 2 of B = R^T F, negated. If it is not well above singular, q does not change.
    """
    b = wp.transpose(matrix_of(q)) * f
    h00 = b[1, 1] + b[2, 2]
    h11 = b[0, 0] + b[2, 2]
    h22 = b[0, 0] + b[1, 1]
    h01 = -0.5 * (b[0, 1] + b[1, 0])
    h02 = -0.5 * (b[0, 2] + b[2, 0])
    h12 = -0.5 * (b[1, 2] + b[2, 1])
    x = b[2, 1] - b[1, 2]
    y = b[0, 2] - b[2, 0]
    z = b[1, 0] - b[0, 1]
    c00 = h11 * h22 - h12 * h12
    c01 = h02 * h12 - h01 * h22
    c02 = h01 * h12 - h02 * h11
    c11 = h00 * h22 - h02 * h02
    c12 = h01 * h02 - h00 * h12
    c22 = h00 * h11 - h01 * h01
    det = h00 * c00 + h01 * c01 + h02 * c02
    sound = h00 > 1.0e-3 and c22 > 1.0e-4 and det > 1.0e-6
    s = wp.where(sound, 0.5 * reciprocal(det), 0.0)
    # Half of the rotation vector, in the rotated frame.
    t0 = s * (c00 * x + c01 * y + c02 * z)
    t1 = s * (c01 * x + c11 * y + c12 * z)
    t2 = s * (c02 * x + c12 * y + c22 * z)
    q0 = q[0] + q[3] * t0 + q[1] * t2 - q[2] * t1
    q1 = q[1] + q[3] * t1 + q[2] * t0 - q[0] * t2
    q2 = q[2] + q[3] * t2 + q[0] * t1 - q[1] * t0
    q3 = q[3] - q[0] * t0 - q[1] * t1 - q[2] * t2
    over = reciprocal_root(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
    return wp.quat(over * q0, over * q1, over * q2, over * q3)


@wp.func
def robust_rotation(f: wp.mat33):
    """The rotation of an F of any rank, sign and size; the identity for a zero or non-finite F."""
    g = f
    n2 = sum_of_squares(f)
    # A comparison with NaN is false.
    if not (n2 > SMALL and n2 < LARGE):
        m = largest_entry(f)
        s = wp.where(m < 1.0, POWER_OF_TWO, 1.0 / POWER_OF_TWO)
        g = reciprocal(wp.max(m * s, 1.0e-30)) * (s * f)
        n2 = sum_of_squares(g)
    r = identity3()
    if n2 > 0.5 * SMALL and n2 < LARGE:
        g = reciprocal_root(n2) * g
        r = matrix_of(polished(g, dominant_quaternion(g)))
    return r
