"""Small motions of Newton's other elements: linear forces of springs, triangles and bending edges.

These are the forces of ``newton.solvers.SolverSemiImplicit``, linearised about given positions: f -= K u, or, with a
velocity u, f -= C u of their dampers. An element that is shorter or smaller there than at rest counts as if it were at
rest, since that is its stiffer state; a longer one also has its tension across it.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node

wp.set_module_options({"enable_backward": False})

#: Newton leaves out bending edges below twice this area and this length [m^2, m].
LEAST = wp.constant(1.0e-6)


@wp.kernel(enable_backward=False)
def scatter_springs(
    # In
    x: wp.array[wp.vec3],
    indices: wp.array[wp.int32],
    rest_length: wp.array[wp.float32],
    modulus: wp.array[wp.float32],
    damping: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """f = -k (d (d . u) + (1 - L/l) (u - d (d . u))) for the difference u of a spring's ends and its direction d."""
    s = wp.tid()
    i = indices[2 * s]
    j = indices[2 * s + 1]
    if i < 0 or j < 0:
        return
    arm = x[i] - x[j]
    length = wp.length(arm)
    along = wp.normalize(arm)
    difference = load_node(u, i) - load_node(u, j)
    stretching = along * wp.dot(along, difference)
    across = float(0.0)
    if damping == 0 and length > rest_length[s]:
        across = 1.0 - rest_length[s] / length
    force = modulus[s] * (stretching + across * (difference - stretching))
    add_force(f, i, -force)
    add_force(f, j, force)


@wp.kernel(enable_backward=False)
def scatter_triangles(
    # In
    x: wp.array[wp.vec3],
    indices: wp.array2d[wp.int32],
    pose: wp.array[wp.mat22],
    materials: wp.array2d[wp.float32],
    damping: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of the energy A (k_mu/2 F:F + k_lambda/2 (J - 1 - k_mu/k_lambda)^2), J = |F1 x F2|, and of dampers of F
    and J."""
    t = wp.tid()
    mu = materials[t, 0]
    lam = wp.max(materials[t, 1], 0.0)
    i = indices[t, 0]
    j = indices[t, 1]
    k = indices[t, 2]
    m = pose[t]
    area = 0.5 / wp.determinant(m)
    x1 = x[j] - x[i]
    x2 = x[k] - x[i]
    f1 = x1 * m[0, 0] + x2 * m[1, 0]
    f2 = x1 * m[0, 1] + x2 * m[1, 1]
    u0 = load_node(u, i)
    u1 = load_node(u, j) - u0
    u2 = load_node(u, k) - u0
    d1 = u1 * m[0, 0] + u2 * m[1, 0]
    d2 = u1 * m[0, 1] + u2 * m[1, 1]
    ratio = wp.length(wp.cross(f1, f2))
    p1 = wp.vec3()
    p2 = wp.vec3()
    if ratio < LEAST:
        # There is no normal. At rest no strain is stiffer than this.
        most = 2.0 * wp.max(mu, lam)
        if damping != 0:
            most = 3.0 * materials[t, 2]
        p1 = most * d1
        p2 = most * d2
    else:
        if ratio < 1.0:
            f1 /= wp.sqrt(ratio)
            f2 /= wp.sqrt(ratio)
            ratio = 1.0
        n = wp.normalize(wp.cross(f1, f2))
        g1 = wp.cross(f2, n)
        g2 = wp.cross(n, f1)
        widening = wp.dot(g1, d1) + wp.dot(g2, d2)
        if damping != 0:
            rate = materials[t, 2]
            p1 = rate * d1
            p2 = rate * d2
            if lam > 0.0:
                p1 += (rate * widening) * g1
                p2 += (rate * widening) * g2
        else:
            p1 = mu * d1
            p2 = mu * d2
            if lam > 0.0:
                turning = wp.cross(d1, f2) + wp.cross(f1, d2)
                dn = (turning - n * wp.dot(n, turning)) / ratio
                tension = lam * (ratio - 1.0) - mu
                p1 += (lam * widening) * g1 + tension * (wp.cross(d2, n) + wp.cross(f2, dn))
                p2 += (lam * widening) * g2 + tension * (wp.cross(dn, f1) + wp.cross(n, d1))
    force1 = area * (p1 * m[0, 0] + p2 * m[0, 1])
    force2 = area * (p1 * m[1, 0] + p2 * m[1, 1])
    add_force(f, i, force1 + force2)
    add_force(f, j, -force1)
    add_force(f, k, -force2)


@wp.kernel(enable_backward=False)
def scatter_bending(
    # In
    x: wp.array[wp.vec3],
    indices: wp.array2d[wp.int32],
    properties: wp.array2d[wp.float32],
    damping: int,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of dihedral angles near their rest values.

    Newton's forces are e k (theta - theta_0) d, where d is the angle's gradient g with lengths in place of inverse
    heights: K = e k d g^T. The symmetric part (K + K^T) / 2, used here, has an eigenvalue at least as large as the real
    part of any of K.
    """
    edge = wp.tid()
    i = indices[edge, 0]
    j = indices[edge, 1]
    k = indices[edge, 2]
    o = indices[edge, 3]
    if i < 0 or j < 0 or k < 0 or o < 0:
        return
    n1 = wp.cross(x[k] - x[i], x[o] - x[i])
    n2 = wp.cross(x[o] - x[j], x[k] - x[j])
    e = x[o] - x[k]
    length = wp.length(e)
    double1 = wp.length(n1)
    double2 = wp.length(n2)
    if double1 < LEAST or double2 < LEAST or length < LEAST:
        return
    n1 = n1 / double1
    n2 = n2 / double2
    e = e / length
    i1 = -length * n1
    j2 = -length * n2
    k1 = -wp.dot(x[i] - x[o], e) * n1
    k2 = -wp.dot(x[j] - x[o], e) * n2
    o1 = -wp.dot(x[k] - x[i], e) * n1
    o2 = -wp.dot(x[k] - x[j], e) * n2
    ui = load_node(u, i)
    uj = load_node(u, j)
    uk = load_node(u, k)
    uo = load_node(u, o)
    turn1 = wp.dot(i1, ui) + wp.dot(k1, uk) + wp.dot(o1, uo)
    turn2 = wp.dot(j2, uj) + wp.dot(k2, uk) + wp.dot(o2, uo)
    a1 = turn1 + turn2
    a2 = a1
    if damping == 0:
        along_g = turn1 / double1 + turn2 / double2
        a1 = 0.5 * (along_g + (turn1 + turn2) / double1)
        a2 = 0.5 * (along_g + (turn1 + turn2) / double2)
    a1 *= length * properties[edge, damping]
    a2 *= length * properties[edge, damping]
    add_force(f, i, -a1 * i1)
    add_force(f, j, -a2 * j2)
    add_force(f, k, -a1 * k1 - a2 * k2)
    add_force(f, o, -a1 * o1 - a2 * o2)
