"""Device code of the benchmark: single stages of a force kernel, which the library only has fused.

Each stage ends with a result that can be checked. The stiffness products end in one number for each element, the sum of
its squared nodal forces. So neither a scatter nor wide stores hide the cost of the product, and no compiler can leave a
part of it out. The scatters add a constant, so that the exact result is a count.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain, hooke
from warp_corot.kernels.elements.elements import (
    ForestElements,
    add_force,
    edge_length,
    frame,
    local_gradient,
    mirror_sign,
    nodal_forces,
    node_displacements,
    shape_of,
)
from warp_corot.kernels.elements.shapes import STIFFNESS_LAMBDA, STIFFNESS_MU, Coefficients, mat43
from warp_corot.kernels.math.rotation import identity3
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import REST, fingerprint

vec12 = wp.types.vector(length=12, dtype=wp.float32)

wp.set_module_options({"enable_backward": False})


# --- stiffness product: displacements and a rotation in, four nodal forces out ----------------------------------------


@wp.kernel(enable_backward=False)
def square_factored_forces(
    # In
    elements: ForestElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    rotations: wp.array[wp.mat33],
    unit: wp.array[wp.int32],
    # Out
    squares: wp.array[wp.float32],
):
    t = wp.tid()
    q = frame(elements, t)
    r = rotations[unit[t]] * q
    p = r * hooke(corotated_strain(local_gradient(elements, t, u), q, r), mu[0], lam[0])
    f0, f1, f2, f3 = nodal_forces(elements, t, p)
    squares[t] = wp.length_sq(f0) + wp.length_sq(f1) + wp.length_sq(f2) + wp.length_sq(f3)


@wp.func
def rest_shape(shape: int):
    """Node positions of a shape of edge length one in its own frame, a row a node."""
    x0 = wp.static(mat43(*(x for node in REST[0] for x in node)))
    if shape == 1:
        x0 = wp.static(mat43(*(x for node in REST[1] for x in node)))
    elif shape == 2:
        x0 = wp.static(mat43(*(x for node in REST[2] for x in node)))
    return x0


@functools.cache
def stiffness_product(shape: int, skip_zeros: bool = True) -> wp.Function:
    """Generate y = (K_T / h) z for one shape; with ``skip_zeros=False`` all 144 products, the dense baseline."""
    entries = Coefficients(STIFFNESS_LAMBDA[shape], STIFFNESS_MU[shape])
    distinct, table, signs = list(entries.distinct), entries.table, entries.signs
    if not skip_zeros:
        distinct.append((0.0, 0.0))
        table = [[len(distinct) - 1 if k < 0 else k for k in row] for row in table]
    count = len(distinct)
    coefficients_t = wp.types.vector(length=count, dtype=wp.float32)

    @wp.func
    def product(z: vec12, mu: float, lam: float):
        _generated_from = wp.static(fingerprint(distinct, table, signs))
        c = coefficients_t()
        for k in range(wp.static(count)):
            c[k] = wp.static(distinct[k][0]) * lam + wp.static(distinct[k][1]) * mu
        y = vec12()
        for i in range(12):
            for j in range(12):
                if wp.static(table[i][j] >= 0):
                    if wp.static(signs[i][j] > 0.0):
                        y[i] += c[wp.static(table[i][j])] * z[j]
                    else:
                        y[i] -= c[wp.static(table[i][j])] * z[j]
        return y

    return product


@functools.cache
def square_product_forces(skip_zeros: bool) -> wp.Kernel:
    """Nodal forces by the explicit 12x12 K_T of each type, its zeros skipped or not."""
    product0 = stiffness_product(0, skip_zeros)
    product1 = stiffness_product(1, skip_zeros)
    product2 = stiffness_product(2, skip_zeros)

    @unique_kernel()
    def square_product_forces(
        # In
        elements: ForestElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        rotations: wp.array[wp.mat33],
        unit: wp.array[wp.int32],
        # Out
        squares: wp.array[wp.float32],
    ):
        t = wp.tid()
        code = elements.code[t]
        shape = shape_of(code)
        h = edge_length(elements, t)
        q = frame(elements, t) * wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, mirror_sign(code))
        r = rotations[unit[t]] * q
        turned = wp.transpose(r) * q - identity3()
        x0 = rest_shape(shape)
        u0, u1, u2, u3 = node_displacements(elements.nodes[t], u)
        d0 = turned * (x0[0] * h)
        d1 = turned * (x0[1] * h) + wp.transpose(r) * (u1 - u0)
        d2 = turned * (x0[2] * h) + wp.transpose(r) * (u2 - u0)
        d3 = turned * (x0[3] * h) + wp.transpose(r) * (u3 - u0)
        z = vec12(d0[0], d0[1], d0[2], d1[0], d1[1], d1[2], d2[0], d2[1], d2[2], d3[0], d3[1], d3[2])
        y = vec12()
        m = mu[0] * h
        k = lam[0] * h
        if shape == 0:
            y = product0(z, m, k)
        elif shape == 1:
            y = product1(z, m, k)
        else:
            y = product2(z, m, k)
        # The cost of rotating the forces back into world space is included; their lengths do not change.
        total = wp.length_sq(r * wp.vec3(y[0], y[1], y[2]))
        for n in range(1, 4):
            total += wp.length_sq(r * wp.vec3(y[3 * n], y[3 * n + 1], y[3 * n + 2]))
        squares[t] = total

    return square_product_forces


# --- scatter: indices in, a constant added at each --------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def scatter_vec3(nodes: wp.array[wp.vec4i], f: wp.array[wp.vec3]):
    """Three scalar atomics a node on packed vec3, as in Newton."""
    n = nodes[wp.tid()]
    for i in range(4):
        wp.atomic_add(f, n[i], wp.vec3(1.0, 2.0, 3.0))


@wp.kernel(enable_backward=False)
def scatter_flat(nodes: wp.array[wp.vec4i], f: wp.array[wp.vec4]):
    """The library's ``add_force``, four times an element."""
    n = nodes[wp.tid()]
    for i in range(4):
        add_force(f, n[i], wp.vec3(1.0, 2.0, 3.0))


@wp.kernel(enable_backward=False)
def scatter_lists(nodes: wp.array2d[wp.int32], f: wp.array[wp.vec4]):
    """``add_force`` at every node of a list: one subtree of 8 or 64 elements."""
    s = wp.tid()
    for i in range(nodes.shape[1]):
        add_force(f, nodes[s, i], wp.vec3(1.0, 2.0, 3.0))


# --- rotations --------------------------------------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def rotate_by_svd3(matrices: wp.array[wp.mat33], rotations: wp.array[wp.mat33]):
    """U V^T of ``wp.svd3`` in the simplest form, without the library's guards."""
    i = wp.tid()
    u, _s, v = wp.svd3(matrices[i])
    rotations[i] = u * wp.transpose(v)
