"""Tetrahedra of a Newton model: forces, current stiffness, rotations and stresses from nodal positions and inverse rest
matrices.

Newton's state consists of positions, and only its matrix defines an element's rest shape: there need be no consistent
rest positions (a body may have been turned after it was built, or its elements strained against one another). So
F = (x1-x0 x2-x0 x3-x0) B.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import (
    IsotropicMaterial,
    corotated_strain,
    hooke,
    rotated_stress,
    symmetric,
)
from warp_corot.kernels.elements.elements import GeneralElements, scatter_stress
from warp_corot.kernels.elements.forces import von_mises
from warp_corot.kernels.elements.general_cuda import (
    PosedElements,
    add_stress,
    edge_differences,
    load_four,
    rest_inverse_of,
)
from warp_corot.kernels.elements.simd8 import elastic, headers, scatter_simd8
from warp_corot.kernels.math.rotation import byers_xu, cofactor, identity3, quick_rotation
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.stepping.pace import GROWTH, LEAST, SAFE, STABLE, STRAIN, safe_step
from warp_corot.kernels.stepping.stability import TURNS, keep_largest

from .particles import Particles

wp.set_module_options({"enable_backward": False})

#: The place of the largest speed among measurements.
SPEED = wp.constant(2)
#: Number of tetrahedra that a thread checks for activation.
EACH = wp.constant(4)


@wp.func
def difference_gradient(elements: GeneralElements, t: int, a: wp.array[wp.vec3]):
    """The gradient over the rest shape of a nodal field: F of positions, dF/dt of velocities."""
    nodes = elements.nodes[t]
    a0 = a[nodes[0]]
    return wp.matrix_from_cols(a[nodes[1]] - a0, a[nodes[2]] - a0, a[nodes[3]] - a0) * elements.rest_inverse[t]


@wp.func
def corotated_stress(f: wp.mat33, r: wp.mat33, mu: float, lam: float):
    """First Piola-Kirchhoff stress [Pa] of F and its rotation."""
    return rotated_stress(f - identity3(), identity3(), r, mu, lam)


@wp.func
def viscous_product(f: wp.mat33, rate_of_f: wp.mat33):
    """F (dE/dt + tr(dE/dt) I) with Green's strain E."""
    rate = symmetric(wp.transpose(f) * rate_of_f)
    return f * (rate + wp.trace(rate) * identity3())


@wp.func
def viscous_stress(f: wp.mat33, rate_of_f: wp.mat33, k: float):
    """Viscous stress for k_damp [Pa s]: with Green's strain E, P = 3 / tr(F^T F) F (k dE/dt + k tr(dE/dt) I).

    It vanishes for rigid motion, exerts no torque, and never adds energy. For small strains it equals the
    k (dF/dt + tr(dF/dt) I) of Newton's solvers, which also damps rotation (and, in their form, translation). The factor
    keeps it from growing with the stretch.
    """
    return (3.0 * k / wp.max(wp.ddot(f, f), 1.0e-12)) * viscous_product(f, rate_of_f)


@wp.func
def active_stress(f: wp.mat33, k: float):
    """k cof F, the gradient of k J; with k = k_lambda times the activation it is that of Newton's solvers."""
    return k * cofactor(f)


@functools.cache
def scatter_posed(damped: bool) -> wp.Kernel:
    """All forces of tetrahedra, each with the rotation of its own deformation gradient; ``ids`` are their indices in
    ``activation``, or empty if they are all."""

    @unique_kernel()
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
        place = int(t)
        if ids.shape[0] > 0:
            place = ids[t]
        a = activation[place]
        n = load_four(elements.nodes, t)
        gradient = edge_differences(n, x) * rest_inverse_of(elements, t)
        p = corotated_stress(gradient, quick_rotation(gradient), mu[t], lam[t])
        if a != 0.0:
            p += active_stress(gradient, k_lambda[t] * a)
        if wp.static(damped):
            k = k_damp[t]
            if k != 0.0:
                v0 = v[n[0]]
                edge_rates = wp.matrix_from_cols(v[n[1]] - v0, v[n[2]] - v0, v[n[3]] - v0)
                p += viscous_stress(gradient, edge_rates * rest_inverse_of(elements, t), k)
        add_stress(elements, t, n, p, f)

    return scatter_posed


# --- the same on the CPU, eight elements in the lanes of vector registers; see ``elements.simd8`` ---------------------

#: Corotated forces, each element with its own rotation.
scatter_posed_lanes = scatter_simd8(
    f"corot::scatter_posed({elastic('corotated').code}, units, block, count, u, f, missed)",
    GeneralElements,
    IsotropicMaterial,
    wp.int32,
    headers("elements8"),
)


@wp.func
def posed_stress(elements: GeneralElements, t: int, material: IsotropicMaterial, x: wp.array[wp.vec4]):
    """The stress of element t at positions x, right for every F, for ``elements.forces.repair_forces``."""
    f = edge_differences(elements.nodes[t], x) * elements.rest_inverse[t]
    return corotated_stress(f, byers_xu(f), material.mu[t], material.lam[t])


# --- Newton's own stresses, for every elastic model ------------------------------------------------------------------


@functools.cache
def scatter_damping_and_activation(damped: bool) -> wp.Kernel:
    """Forces of damping and activation of ``count`` tetrahedra whose elastic forces come from another kernel.

    A thread checks ``EACH`` of them, so that it waits for memory once if none is active or damped.
    """

    @unique_kernel()
    def scatter_damping_and_activation(
        # In
        elements: GeneralElements,
        k_lambda: wp.array[wp.float32],
        k_damp: wp.array[wp.float32],
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
            t = wp.min(thread + j * threads, count - 1)
            any_of += wp.abs(activation[t])
            if wp.static(damped):
                any_of += k_damp[t]
        if any_of == 0.0:
            return
        for t in range(thread, count, threads):
            gradient = difference_gradient(elements, t, q)
            p = active_stress(gradient, k_lambda[t] * activation[t])
            if wp.static(damped):
                p += viscous_stress(gradient, difference_gradient(elements, t, v), k_damp[t])
            scatter_stress(elements, t, p, f)

    return scatter_damping_and_activation


# --- rotations and stresses in Newton's arrays ------------------------------------------------------------------------


@wp.kernel(enable_backward=False)
def write_attributes(
    # In
    elements: GeneralElements,
    mu: wp.array[wp.float32],
    lam: wp.array[wp.float32],
    fill: wp.array[wp.float32],
    fill_stride: int,
    q: wp.array[wp.vec3],
    # Out
    rotations: wp.array[wp.quat],
    stresses: wp.array[wp.mat33],
    equivalent: wp.array[wp.float32],
):
    """Write rotation and Cauchy stress of every element to the arrays that are not empty."""
    t = wp.tid()
    gradient = difference_gradient(elements, t, q)
    r = byers_xu(gradient)
    if rotations.shape[0] > 0:
        rotations[t] = wp.normalize(wp.quat_from_matrix(r))
    share = 1.0 / fill[t * fill_stride]
    stress = share * hooke(corotated_strain(gradient - identity3(), identity3(), r), mu[t], lam[t])
    if stresses.shape[0] > 0:
        stresses[t] = r * stress * wp.transpose(r)
    if equivalent.shape[0] > 0:
        equivalent[t] = von_mises(stress)


# --- current stiffness, as ``stepping.stability`` --------------------------------------------------------------------


@wp.struct
class SafeSubstep:
    """The substep that is safe in the present state, and what measurements need."""

    stride: float  # the longest way of a particle in a substep [m], which may meet something, or zero
    falls: float  # how much faster it may be at the next measurement, over the substep [m/s^2]
    at_rest: wp.array2d[wp.float64]  # [1, 4], see ``stepping.pace``
    found: wp.array2d[wp.float32]  # [1, 3] curvature, strain and speed
    allowed: wp.array[wp.float64]  # [1] the safe substep [s]
    turn: wp.array[wp.int32]  # [1] number of the measurement
    excess: wp.array[wp.float32]  # [1] largest factor by which a recorded substep was too long
    seen: wp.array[wp.float64]  # [1] the safe substep, in the host's memory


@wp.kernel(enable_backward=False)
def find_posed_strains(elements: GeneralElements, particles: Particles, ahead: float, count: int, safe: SafeSubstep):
    """The largest entry of F^T F - I among one in ``TURNS`` elements, now and after ``ahead`` [s] at the current rate,
    and the largest speed of their first nodes; the next measurement checks others."""
    t = wp.tid() * TURNS + safe.turn[0] % TURNS
    if t >= count:
        return
    f = difference_gradient(elements, t, particles.q)
    strain = wp.transpose(f) * f - identity3()
    rate = wp.transpose(f) * difference_gradient(elements, t, particles.qd)
    later = strain + ahead * (rate + wp.transpose(rate))
    most = float(0.0)
    for i in range(3):
        for j in range(3):
            most = wp.max(most, wp.max(wp.abs(strain[i, j]), wp.abs(later[i, j])))
    keep_largest(most, STRAIN, safe.found[0])
    keep_largest(wp.length(particles.qd[elements.nodes[t][0]]), SPEED, safe.found[0])


@wp.func
def longest_stride(stride: float, falls: float, speed: float):
    """The substep dt [s] with dt (speed + falls dt) = stride [m]."""
    return 2.0 * stride / (speed + wp.sqrt(speed * speed + 4.0 * falls * stride) + 1.0e-30)


@wp.kernel(enable_backward=False)
def take_safe_substep(recorded: wp.float64, safe: SafeSubstep):
    """Find the substep that is safe until the next measurement: it shrinks at once and grows slowly.

    Args:
        recorded: Length of the substep of a recorded step [s]; zero if the host chooses the next one.
    """
    longest = safe.at_rest[0, SAFE] * safe.at_rest[0, STABLE]
    allowed = wp.min(longest, safe_step(safe.at_rest, safe.found, 0))
    if safe.stride > 0.0:
        allowed = wp.min(allowed, wp.float64(longest_stride(safe.stride, safe.falls, safe.found[0, SPEED])))
    allowed = wp.min(wp.max(allowed, LEAST * longest), GROWTH * safe.allowed[0])
    safe.allowed[0] = allowed
    safe.seen[0] = allowed
    safe.excess[0] = wp.max(safe.excess[0], float(recorded / allowed))
    for k in range(safe.found.shape[1]):
        safe.found[0, k] = 0.0
    safe.turn[0] = (safe.turn[0] + 1) % TURNS
