"""Tetrahedra of a Newton model: forces, rotations and stresses from nodal positions and inverse rest matrices.

Newton's state is positions, and an element's rest shape is its matrix alone: no rest positions need go with it (a body
may have been turned after it was built, or its elements strained against one another). So F = (x1-x0 x2-x0 x3-x0) B.
"""

import functools

import warp as wp

from .constitutive import corotated_strain, hooke
from .elements import GeneralElements, load_node, scatter_stress
from .forces import von_mises
from .general_cpu import ADD_FORCES, gather_elements
from .lanes import COMPILER_FLAGS, NEWTON, PRELUDE, on_cpu
from .rotation import ITERATIONS, byers_xu, cofactor, identity3, warm_rotation

wp.set_module_options({"enable_backward": False})


@wp.func
def deformation_gradient(elements: GeneralElements, t: int, x: wp.array[wp.vec4]):
    nodes = elements.nodes[t]
    x0 = load_node(x, nodes[0])
    edges = wp.matrix_from_cols(load_node(x, nodes[1]) - x0, load_node(x, nodes[2]) - x0, load_node(x, nodes[3]) - x0)
    return edges * elements.rest_inverse[t]


@wp.func
def difference_gradient(elements: GeneralElements, t: int, a: wp.array[wp.vec3]):
    """The gradient over the rest shape of a nodal field: F of positions, dF/dt of velocities."""
    nodes = elements.nodes[t]
    a0 = a[nodes[0]]
    return wp.matrix_from_cols(a[nodes[1]] - a0, a[nodes[2]] - a0, a[nodes[3]] - a0) * elements.rest_inverse[t]


@wp.func
def corotated_stress(f: wp.mat33, r: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress [Pa] of F and its rotation."""
    return r * hooke(corotated_strain(f, wp.mat33(), r), mu, lam)


@functools.cache
def scatter_posed(rotation: wp.Function) -> wp.Kernel:
    """Corotated forces, each element with the rotation of its own deformation gradient."""

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_posed(
        # In
        elements: GeneralElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        x: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        gradient = deformation_gradient(elements, t, x)
        scatter_stress(elements, t, corotated_stress(gradient, rotation(gradient), mu[t], lam[t]), f)

    return scatter_posed


@wp.kernel(enable_backward=False)
def scatter_posed_warm(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    ids: wp.array[wp.int32],
    x: wp.array[wp.vec4],
    guesses: wp.array[wp.quat],
    # Out
    f: wp.array[wp.vec4],
):
    """As ``scatter_posed``, from the rotations that the state came with; ``ids`` are the elements' places there."""
    t = wp.tid()
    gradient = deformation_gradient(elements, t, x)
    r = wp.quat_to_matrix(warm_rotation(gradient, guesses[ids[t]]))
    scatter_stress(elements, t, corotated_stress(gradient, r, mu[t], lam[t]), f)


# --- the same on the CPU, eight elements in the lanes of vector registers; see ``lanes`` -----------------------------

_GATHER = gather_elements("m[lane] = mu.data[t]; k[lane] = lam.data[t];")

_FORCES = f"""{PRELUDE}{NEWTON}
    lanes8 m, k;
{_GATHER}
    // Columns of F = (x1-x0 x2-x0 x3-x0) B.
    triple c[3], z[3];
    for (int j = 0; j < 3; ++j) c[j] = plus(scaled(b[j], d1), plus(scaled(b[3 + j], d2), scaled(b[6 + j], d3)));
    const masks8 trusted = newton(c[0], c[1], c[2], spread(1.0f), z);
    // With a rotation, R sym(R^T F) = F: P = 2 mu (F - R) + lambda tr(R^T F - I) R.
    const lanes8 trace = {0.5**ITERATIONS!r}f * (dot(z[0], c[0]) + dot(z[1], c[1]) + dot(z[2], c[2]));
    const lanes8 from_f = -2.0f * m * volume;
    const lanes8 from_z = (k * (trace - 3.0f) - 2.0f * m) * (-{0.5**ITERATIONS!r}f * volume);
    triple p[3];
    for (int j = 0; j < 3; ++j) p[j] = plus(scaled(from_f, c[j]), scaled(from_z, z[j]));
{ADD_FORCES}"""


@wp.func_native(on_cpu(_FORCES))
def eight_posed(
    elements: GeneralElements,
    block: int,
    count: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    flagged: wp.array[wp.uint8],
): ...


@wp.kernel(module="unique", enable_backward=False, module_options={"cpu_compiler_flags": COMPILER_FLAGS})
def scatter_posed_lanes(
    # In
    elements: GeneralElements,
    count: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    x: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
    flagged: wp.array[wp.uint8],
):
    """Corotated forces, each element with its own rotation; a thread is eight elements."""
    eight_posed(elements, wp.tid(), count, mu, lam, x, f, flagged)


@wp.kernel(enable_backward=False)
def repair_posed(
    # In
    flagged: wp.array[wp.uint8],
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    x: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of flagged elements with the rotation that is right for every F."""
    t = wp.tid()
    if flagged[t] == wp.uint8(0):
        return
    gradient = deformation_gradient(elements, t, x)
    scatter_stress(elements, t, corotated_stress(gradient, byers_xu(gradient), mu[t], lam[t]), f)


# --- what is Newton's own, whatever the elastic model ----------------------------------------------------------------


@wp.kernel(enable_backward=False)
def scatter_damping_and_activation(
    # In
    elements: GeneralElements,
    materials: wp.array2d[wp.float32],
    activation: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    # Out
    f: wp.array[wp.vec4],
):
    """Viscous stress of k_damp [Pa s], and k_lambda times the activation on the volume, as Newton's solvers have it.

    With Green's strain E, P = 3 / tr(F^T F) F (k dE/dt + k tr(dE/dt) I): nothing for a rigid motion, no torque, never
    any work put in. For small strains it is the k (dF/dt + tr(dF/dt) I) of Newton's solvers, which also damps turning
    (and translation, as they have it). The factor keeps it from growing with the stretch. The activation's
    P = k_lambda a cof F is the gradient of k_lambda a J.
    """
    t = wp.tid()
    damping = materials[t, 2]
    a = activation[t]
    if damping == 0.0 and a == 0.0:
        return
    gradient = difference_gradient(elements, t, q)
    p = (materials[t, 1] * a) * cofactor(gradient)
    if damping != 0.0:
        product = wp.transpose(gradient) * difference_gradient(elements, t, qd)
        rate = 0.5 * (product + wp.transpose(product))
        scale = 3.0 * damping / wp.max(wp.ddot(gradient, gradient), 1.0e-12)
        p += scale * (gradient * (rate + wp.trace(rate) * identity3()))
    scatter_stress(elements, t, p, f)


@wp.kernel(enable_backward=False)
def lame_parameters(
    # In
    materials: wp.array2d[wp.float32],
    ids: wp.array[wp.int32],
    mu_from_mu: float,
    lam_from_mu: float,
    # Out
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
):
    """Lamé's parameters of chosen elements: mu = a k_mu, lambda = k_lambda + b k_mu."""
    t = wp.tid()
    k_mu = materials[ids[t], 0]
    mu[t] = mu_from_mu * k_mu
    lam[t] = materials[ids[t], 1] + lam_from_mu * k_mu


@functools.cache
def write_attributes(has_rotation: bool, has_stress: bool, has_von_mises: bool, is_warm: bool) -> wp.Kernel:
    """Rotation and Cauchy stress of every element, those of them that the state has room for."""

    @wp.kernel(module="unique", enable_backward=False)
    def write_attributes(
        # In
        elements: GeneralElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        fill: wp.array[wp.float32],
        fill_stride: int,
        q: wp.array[wp.vec3],
        guesses: wp.array[wp.quat],
        # Out
        rotations: wp.array[wp.quat],
        stresses: wp.array[wp.mat33],
        equivalent: wp.array[wp.float32],
    ):
        t = wp.tid()
        gradient = difference_gradient(elements, t, q)
        r = wp.mat33()
        if wp.static(is_warm):
            turned = warm_rotation(gradient, guesses[t])
            r = wp.quat_to_matrix(turned)
            if wp.static(has_rotation):
                rotations[t] = turned
        else:
            r = byers_xu(gradient)
            if wp.static(has_rotation):
                rotations[t] = wp.normalize(wp.quat_from_matrix(r))
        share = 1.0 / fill[t * fill_stride]
        stress = share * hooke(corotated_strain(gradient, wp.mat33(), r), mu[t], lam[t])
        if wp.static(has_stress):
            stresses[t] = r * stress * wp.transpose(r)
        if wp.static(has_von_mises):
            equivalent[t] = von_mises(stress)

    return write_attributes
