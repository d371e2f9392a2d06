"""Tetrahedra of a Newton model: forces, rotations and stresses from nodal positions and inverse rest matrices.

Newton's state is positions, and an element's rest shape is its matrix alone: no rest positions need go with it (a body
may have been turned after it was built, or its elements strained against one another). So F = (x1-x0 x2-x0 x3-x0) B.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain, hooke
from warp_corot.kernels.elements.elements import GeneralElements, load_node, scatter_stress
from warp_corot.kernels.elements.general_cuda import (
    PosedElements,
    add_stress,
    edge_differences,
    load_four,
    rest_inverse_of,
)
from warp_corot.kernels.elements.lanes import COMPILER_FLAGS, native, on_cpu
from warp_corot.kernels.elements.law_lanes import LAWS
from warp_corot.kernels.math.rotation import byers_xu, cofactor, identity3, warm_rotation

wp.set_module_options({"enable_backward": False})

#: Tetrahedra that a thread looks at whether they are active.
EACH = wp.constant(4)


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
def rotated_stress(f: wp.mat33, r: wp.mat33, mu: float, lam: float):
    """Stress [Pa] of F in the axes that its rotation turns."""
    return hooke(corotated_strain(f - identity3(), identity3(), r), mu, lam)


@wp.func
def corotated_stress(f: wp.mat33, r: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress [Pa] of F and its rotation."""
    return r * rotated_stress(f, r, mu, lam)


@wp.func
def viscous_stress(f: wp.mat33, rate_of_f: wp.mat33, k: float):
    """Of k_damp [Pa s]: with Green's strain E, P = 3 / tr(F^T F) F (k dE/dt + k tr(dE/dt) I).

    Nothing for a rigid motion, no torque, never any work put in. For small strains it is the k (dF/dt + tr(dF/dt) I) of
    Newton's solvers, which also damps turning (and translation, as they have it). The factor keeps it from growing
    with the stretch.
    """
    product = wp.transpose(f) * rate_of_f
    rate = 0.5 * (product + wp.transpose(product))
    scale = 3.0 * k / wp.max(wp.ddot(f, f), 1.0e-12)
    return scale * (f * (rate + wp.trace(rate) * identity3()))


@wp.func
def active_stress(f: wp.mat33, k: float):
    """k cof F, the gradient of k J: with k = k_lambda times the activation what Newton's solvers have."""
    return k * cofactor(f)


@wp.func
def place_in_model(ids: wp.array[wp.int32], first: int, t: int):
    """Which of the model's tetrahedra the t-th of a part is: of a list, or of a range where the list is empty."""
    place = first + t
    if ids.shape[0] > 0:
        place = ids[t]
    return place


@functools.cache
def scatter_posed(rotation: wp.Function, damped: bool, rounds: int = 1) -> wp.Kernel:
    """All forces of tetrahedra, each with the rotation of its own deformation gradient; ``ids`` are their places in
    ``stepping.activation``; ``rounds``: see ``add_four_forces``."""
    add = add_stress(rounds)

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_posed(
        # In
        elements: PosedElements,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        k_lambda: wp.array[wp.float32],
        k_damp: wp.array[wp.float32],
        ids: wp.array[wp.int32],
        activation: wp.array[wp.float32],
        x: wp.array[wp.vec4],
        v: wp.array[wp.vec3],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        a = activation[place_in_model(ids, 0, t)]
        n = load_four(elements.nodes, t)
        gradient = edge_differences(n, x) * rest_inverse_of(elements, t)
        p = corotated_stress(gradient, rotation(gradient), mu[t], lam[t])
        if a != 0.0:
            p += active_stress(gradient, k_lambda[t] * a)
        if wp.static(damped):
            k = k_damp[t]
            if k != 0.0:
                v0 = v[n[0]]
                edge_rates = wp.matrix_from_cols(v[n[1]] - v0, v[n[2]] - v0, v[n[3]] - v0)
                p += viscous_stress(gradient, edge_rates * rest_inverse_of(elements, t), k)
        add(elements, t, n, p, f)

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
    """Elastic forces from the rotations that the state came with; ``ids`` are the elements' places there."""
    t = wp.tid()
    gradient = deformation_gradient(elements, t, x)
    r = wp.quat_to_matrix(warm_rotation(gradient, guesses[place_in_model(ids, 0, t)]))
    scatter_stress(elements, t, corotated_stress(gradient, r, mu[t], lam[t]), f)


# --- the same on the CPU, eight elements in the lanes of vector registers; see ``elements.lanes`` ---------------------

_FORCES = on_cpu(LAWS["corotated"], native("elements", "posed_elements", "element_forces", "left_out_elements"))


@wp.func_native(_FORCES)
def eight_posed(
    elements: GeneralElements,
    block: int,
    count: int,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    f: wp.array[wp.vec4],
    left_out: wp.array[wp.int32],
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
    left_out: wp.array[wp.int32],
):
    """Corotated forces, each element with its own rotation; a thread is eight elements."""
    eight_posed(elements, wp.tid(), count, mu, lam, x, f, left_out)


@wp.kernel(enable_backward=False)
def repair_posed(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    x: wp.array[wp.vec4],
    # In and out
    left_out: wp.array[wp.int32],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of the elements on the list, with the rotation that is right for every F, by one thread; empties it."""
    for i in range(left_out[0]):
        t = left_out[i + 1]
        gradient = deformation_gradient(elements, t, x)
        scatter_stress(elements, t, corotated_stress(gradient, byers_xu(gradient), mu[t], lam[t]), f)
    left_out[0] = 0


# --- what is Newton's own, whatever the elastic model ----------------------------------------------------------------


@functools.cache
def scatter_damping_and_activation(damped: bool) -> wp.Kernel:
    """What is not elastic in the forces of ``count`` tetrahedra of a model, for those whose elastic part is another
    kernel's.

    A thread looks at ``EACH`` of them, so that where none is active or damped it waits for memory once.
    """

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_damping_and_activation(
        # In
        elements: GeneralElements,
        k_lambda: wp.array[wp.float32],
        k_damp: wp.array[wp.float32],
        ids: wp.array[wp.int32],
        first: int,
        count: int,
        activation: wp.array[wp.float32],
        q: wp.array[wp.vec3],
        v: wp.array[wp.vec3],
        # Out
        f: wp.array[wp.vec4],
    ):
        thread = wp.tid()
        threads = (count + EACH - 1) // EACH
        any_of = float(0.0)
        for j in range(EACH):
            t = place_in_model(ids, first, wp.min(thread + j * threads, count - 1))
            any_of += wp.abs(activation[t])
            if wp.static(damped):
                any_of += k_damp[t]
        if any_of == 0.0:
            return
        for k in range(thread, count, threads):
            t = place_in_model(ids, first, k)
            a = activation[t]
            gradient = difference_gradient(elements, t, q)
            p = active_stress(gradient, k_lambda[t] * a)
            if wp.static(damped):
                p += viscous_stress(gradient, difference_gradient(elements, t, v), k_damp[t])
            scatter_stress(elements, t, p, f)

    return scatter_damping_and_activation
