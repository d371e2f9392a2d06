"""The anisotropic corotated law where an element's rotation is definite, with as little arithmetic as possible.

Kernels for CUDA share this code. It has the law of ``anisotropic``, in any frame of the columns of F, for elements
whose rotation the unscaled iteration finds and that are far from the transition to the isotropic law (``is_definite``).
"""

import warp as wp

from warp_corot.kernels.math.rotation import ITERATIONS, column, identity3, reciprocal

from .anisotropic import vec9

wp.set_module_options({"enable_backward": False})

#: ``BLENDED`` of ``native/law_anisotropic.h``.
INDEFINITE = wp.constant(0.4)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const float4 a = *reinterpret_cast<const float4*>(&wp::index(axes, t));
    return wp::quat_t<wp::float32>(a.x, a.y, a.z, a.w);
#else
    return wp::index(axes, t);
#endif
""")
def load_axes(axes: wp.array[wp.quat], t: int) -> wp.quat:
    """The axes of element t by one 16-byte load; see ``load_node``."""
    ...


@wp.func
def is_definite(e: wp.mat33):
    """Whether the law is the anisotropic one alone at the strain e: det(tr(S) I - S) / |S|^3 is large enough."""
    s = e + identity3()
    n2 = wp.ddot(s, s)
    return wp.determinant(wp.trace(s) * identity3() - s) >= INDEFINITE * n2 * wp.sqrt(n2)


@wp.func
def definite_strain(
    z0: wp.vec3, z1: wp.vec3, z2: wp.vec3, f0: wp.vec3, f1: wp.vec3, f2: wp.vec3, g: wp.mat33, a: wp.mat33
):
    """e = S - I to all its digits, from Z = 2^ITERATIONS R, the columns of F, of G, and A; see
    ``native/law_anisotropic.h``.

    R^T F is symmetric as far as R is converged, so that one half of it is enough for the rough strain.
    """
    k = wp.static(0.5**ITERATIONS)
    r00 = k * wp.dot(z0, f0) - 1.0
    r11 = k * wp.dot(z1, f1) - 1.0
    r22 = k * wp.dot(z2, f2) - 1.0
    r01 = k * wp.dot(z0, f1)
    r02 = k * wp.dot(z0, f2)
    r12 = k * wp.dot(z1, f2)
    g0 = column(g, 0)
    g1 = column(g, 1)
    g2 = column(g, 2)
    e00 = a[0, 0] + 0.5 * (wp.dot(g0, g0) - (r00 * r00 + r01 * r01 + r02 * r02))
    e11 = a[1, 1] + 0.5 * (wp.dot(g1, g1) - (r01 * r01 + r11 * r11 + r12 * r12))
    e22 = a[2, 2] + 0.5 * (wp.dot(g2, g2) - (r02 * r02 + r12 * r12 + r22 * r22))
    e01 = 0.5 * (a[0, 1] + a[1, 0] + wp.dot(g0, g1) - (r00 * r01 + r01 * r11 + r02 * r12))
    e02 = 0.5 * (a[0, 2] + a[2, 0] + wp.dot(g0, g2) - (r00 * r02 + r01 * r12 + r02 * r22))
    e12 = 0.5 * (a[1, 2] + a[2, 1] + wp.dot(g1, g2) - (r01 * r02 + r11 * r12 + r12 * r22))
    return wp.mat33(e00, e01, e02, e01, e11, e12, e02, e12, e22)


@wp.func
def turned(e: wp.mat33, stress: wp.mat33, axial: wp.vec3):
    """stress + [a]x with (tr(S) I - S) a = axial, where tr(S) I - S is far from singular."""
    trace = 2.0 + wp.trace(e)
    h0 = trace - e[0, 0]
    h1 = trace - e[1, 1]
    h2 = trace - e[2, 2]
    e01 = e[0, 1]
    e02 = e[0, 2]
    e12 = e[1, 2]
    a00 = h1 * h2 - e12 * e12
    a11 = h0 * h2 - e02 * e02
    a22 = h0 * h1 - e01 * e01
    a01 = e02 * e12 + e01 * h2
    a02 = e01 * e12 + e02 * h1
    a12 = e01 * e02 + h0 * e12
    over = reciprocal(h0 * a00 - e01 * a01 - e02 * a02)
    x = over * (a00 * axial[0] + a01 * axial[1] + a02 * axial[2])
    y = over * (a01 * axial[0] + a11 * axial[1] + a12 * axial[2])
    z = over * (a02 * axial[0] + a12 * axial[1] + a22 * axial[2])
    return wp.mat33(
        stress[0, 0], stress[0, 1] - z, stress[0, 2] + y,
        stress[0, 1] + z, stress[1, 1], stress[1, 2] - x,
        stress[0, 2] - y, stress[1, 2] + x, stress[2, 2],
    )  # fmt: skip


@wp.func
def transverse_stress(e: wp.mat33, n: wp.mat33, c: vec9, scale: float):
    """R^T P times ``scale``, for a stiffness that is the same in all directions around the first axis d, by its
    invariants.

    sigma = 2 mu e + (lambda tr e + alpha d.v) I + d w^T + w d^T, with v = e d.
    """
    d = column(n, 0)
    double_mu = scale * (c[1] - c[5])
    lam = scale * c[5]
    alpha = scale * (c[3] - c[5])
    excess = 2.0 * scale * c[6] - double_mu  # 2 (G_12 - G_23)
    beta = scale * c[0] - lam - double_mu - 2.0 * alpha - 2.0 * excess
    v = e * d
    along = wp.dot(d, v)
    trace = wp.trace(e)
    w = (0.5 * (alpha * trace + beta * along)) * d + excess * v
    pressure = lam * trace + alpha * along
    s01 = double_mu * e[0, 1] + d[0] * w[1] + w[0] * d[1]
    s02 = double_mu * e[0, 2] + d[0] * w[2] + w[0] * d[2]
    s12 = double_mu * e[1, 2] + d[1] * w[2] + w[1] * d[2]
    stress = wp.mat33(
        double_mu * e[0, 0] + pressure + 2.0 * d[0] * w[0], s01, s02,
        s01, double_mu * e[1, 1] + pressure + 2.0 * d[1] * w[1], s12,
        s02, s12, double_mu * e[2, 2] + pressure + 2.0 * d[2] * w[2],
    )  # fmt: skip
    # The axial vector of e sigma - sigma e, to which what is isotropic adds nothing.
    return turned(e, stress, wp.cross(w, v) + wp.cross(d, e * w))


@wp.func
def orthotropic_turned_stress(e: wp.mat33, n: wp.mat33, c: vec9, scale: float):
    """R^T P times ``scale``, with the axes n."""
    n0 = column(n, 0)
    n1 = column(n, 1)
    n2 = column(n, 2)
    v0 = e * n0
    v1 = e * n1
    v2 = e * n2
    e0 = scale * wp.dot(n0, v0)
    e1 = scale * wp.dot(n1, v1)
    e2 = scale * wp.dot(n2, v2)
    s01 = 2.0 * scale * c[6] * wp.dot(n0, v1)
    s02 = 2.0 * scale * c[7] * wp.dot(n0, v2)
    s12 = 2.0 * scale * c[8] * wp.dot(n1, v2)
    # sigma = sum n_i w_i^T with w_i = sum sigma_ij n_j; e sigma - sigma e has the axial vector sum w_i x v_i.
    w0 = (c[0] * e0 + c[3] * e1 + c[4] * e2) * n0 + s01 * n1 + s02 * n2
    w1 = s01 * n0 + (c[3] * e0 + c[1] * e1 + c[5] * e2) * n1 + s12 * n2
    w2 = s02 * n0 + s12 * n1 + (c[4] * e0 + c[5] * e1 + c[2] * e2) * n2
    t01 = n0[0] * w0[1] + n1[0] * w1[1] + n2[0] * w2[1]
    t02 = n0[0] * w0[2] + n1[0] * w1[2] + n2[0] * w2[2]
    t12 = n0[1] * w0[2] + n1[1] * w1[2] + n2[1] * w2[2]
    stress = wp.mat33(
        n0[0] * w0[0] + n1[0] * w1[0] + n2[0] * w2[0], t01, t02,
        t01, n0[1] * w0[1] + n1[1] * w1[1] + n2[1] * w2[1], t12,
        t02, t12, n0[2] * w0[2] + n1[2] * w1[2] + n2[2] * w2[2],
    )  # fmt: skip
    return turned(e, stress, wp.cross(w0, v0) + wp.cross(w1, v1) + wp.cross(w2, v2))


def definite_law(transverse: bool) -> wp.Function:
    """R^T P of (strain, axes, stiffness, scale); ``transverse``: the stiffness is the same in all directions around the
    first axis.
    """
    return transverse_stress if transverse else orthotropic_turned_stress


@wp.kernel(enable_backward=False)
def quaternions_of(axes: wp.array[wp.mat33], quaternions: wp.array[wp.quat]):
    """Axes as quaternions, less than half as many bytes."""
    t = wp.tid()
    quaternions[t] = wp.normalize(wp.quat_from_matrix(axes[t]))
