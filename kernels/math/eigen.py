"""Eigenvalues and eigenvectors of symmetric 3x3 matrices: both by Jacobi's method, or near the first in closed form."""

import warp as wp

from .matrices import identity3, reciprocal, square_root

wp.set_module_options({"enable_backward": False})

#: Sweeps after which nothing is left outside the diagonal in float32: convergence is quadratic.
SWEEPS = wp.constant(5)


@wp.func
def plane_rotation(app: float, aqq: float, apq: float, arp: float, arq: float, p: wp.vec3, q: wp.vec3):
    """Turn a_pq of a symmetric matrix to zero: its other entries and the columns of the vectors after that."""
    cosine = float(1.0)
    sine = float(0.0)
    step = float(0.0)
    if apq != 0.0:
        theta = 0.5 * (aqq - app) / apq
        tangent = wp.where(theta < 0.0, -1.0, 1.0) / (wp.abs(theta) + wp.sqrt(theta * theta + 1.0))
        cosine = 1.0 / wp.sqrt(tangent * tangent + 1.0)
        sine = tangent * cosine
        step = tangent * apq
    return (
        app - step,
        aqq + step,
        cosine * arp - sine * arq,
        sine * arp + cosine * arq,
        cosine * p - sine * q,
        sine * p + cosine * q,
    )


@wp.func
def symmetric_eigen(a: wp.mat33):
    """Eigenvalues, in no order, and eigenvectors as the columns of a rotation, to float32's digits of |a|.

    ``wp.eig3`` errs by up to 1e-3 |a| in float32.
    """
    d0 = a[0, 0]
    d1 = a[1, 1]
    d2 = a[2, 2]
    a01 = a[0, 1]
    a02 = a[0, 2]
    a12 = a[1, 2]
    v0 = wp.vec3(1.0, 0.0, 0.0)
    v1 = wp.vec3(0.0, 1.0, 0.0)
    v2 = wp.vec3(0.0, 0.0, 1.0)
    sweep = int(0)
    while sweep < SWEEPS and wp.abs(a01) + wp.abs(a02) + wp.abs(a12) > 0.0:
        d0, d1, a02, a12, v0, v1 = plane_rotation(d0, d1, a01, a02, a12, v0, v1)
        a01 = 0.0
        d0, d2, a01, a12, v0, v2 = plane_rotation(d0, d2, a02, a01, a12, v0, v2)
        a02 = 0.0
        d1, d2, a01, a02, v1, v2 = plane_rotation(d1, d2, a12, a01, a02, v1, v2)
        a12 = 0.0
        sweep += 1
    return wp.vec3(d0, d1, d2), wp.matrix_from_cols(v0, v1, v2)


@wp.func
def third_cosine(x: float):
    """cos(acos(r) / 3) of x = cos(acos(r) / 2), to 1.2e-6."""
    inner = 0.04779688 + x * (-0.01930408 + x * 0.00419271)
    return 0.50000121 + x * (0.5772581 + x * (-0.10994389 + x * inner))


@wp.func
def eigenvalue_nodes(e: wp.mat33):
    """Three numbers, from the largest to the smallest, that stand for a symmetric matrix's eigenvalues in polynomials.

    They are some 1e-3 of the eigenvalues' differences away from these, and never nearer to one another than that. A
    polynomial that has a smooth function's values there has those of the function at the eigenvalues up to the product
    of all three distances. ``native/law_ogden.h`` has the same.
    """
    mean = wp.trace(e) / 3.0
    d = e - mean * identity3()
    squared = wp.ddot(d, d) / 6.0
    least = 1.0e-6 * mean * mean
    r = float(0.0)
    p = square_root(least + 1.0e-30)
    if squared > least and squared > 1.0e-30:
        p = square_root(squared)
        r = wp.clamp(0.5 * wp.determinant(d * reciprocal(p)), -0.9999997, 0.9999997)
    above = 2.0 * p * third_cosine(square_root(0.5 + 0.5 * r))
    below = 2.0 * p * third_cosine(square_root(0.5 - 0.5 * r))
    return wp.vec3(mean + above, mean - (above - below), mean - below)
