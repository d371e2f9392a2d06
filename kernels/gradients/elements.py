"""Derivatives of the work of elements' forces in an adjoint motion.

A quantity J of displacements u at which forces f(u, q) balance changes by dJ = a . (df/dq) dq with the adjoint motion
a, K a = dJ/du. Elastic forces of an element do the work -V P : L in it, with the first Piola-Kirchhoff stress P and
L = grad a. Kernels here add up its derivatives with respect to the quantities that P and V depend on.

Where nodes of the rest shape move by X' and deformed positions stay, F changes by -F grad X', V by V tr(grad X') and L
by -L grad X'. So the work changes by -V E : grad X', with
    E = (P : L) I - F^T dP - L^T P,  dP the differential of P in the direction L.
"""

import functools

import warp as wp

from warp_corot.kernels.corotated.anisotropic import FibreMaterial, axes_of, filled, material_gradient
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import frame, local_gradient, rest_volume, scatter_stress
from warp_corot.kernels.elements.forces import in_local_frame, own_gradient
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.rotation import column, identity3

wp.set_module_options({"enable_backward": False})


@functools.cache
def add_stress_work(Elements: type, Material: type, stress: wp.Function) -> wp.Kernel:
    """Add each element's work, times a scale [J]."""

    @law_kernel()
    def add_stress_work(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        adjoint: wp.array[wp.vec4],
        scale: float,
        # In and out
        work: wp.array[wp.float64],
    ):
        t = wp.tid()
        density = wp.ddot(stress(elements, t, material, u), local_gradient(elements, t, adjoint))
        work[t] = work[t] - wp.float64(scale * density) * wp.float64(rest_volume(elements, t))

    return add_stress_work


@functools.cache
def add_rest_work(Elements: type, Material: type, stress: wp.Function, differential: wp.Function) -> wp.Kernel:
    """Add the derivative of the work with respect to the nodes' rest positions [N]."""

    @law_kernel()
    def add_rest_work(
        # In
        elements: Elements,
        material: Material,
        u: wp.array[wp.vec4],
        adjoint: wp.array[wp.vec4],
        # In and out
        rest: wp.array[wp.vec4],
    ):
        t = wp.tid()
        q = frame(elements, t)
        p = stress(elements, t, material, u)
        grad = local_gradient(elements, t, adjoint)
        dp = differential(elements, t, material, u, grad)
        f = q + local_gradient(elements, t, u)
        e = wp.ddot(p, grad) * identity3() - wp.transpose(f) * dp - wp.transpose(grad) * p
        scatter_stress(elements, t, q * e, rest)

    return add_rest_work


@functools.cache
def add_rest_weight(Elements: type) -> wp.Kernel:
    """Add the derivative, with respect to rest positions, of the work of weights [N]: each element's density of work
    times its volume.
    """

    @law_kernel()
    def add_rest_weight(
        # In
        elements: Elements,
        densities: wp.array[wp.float32],
        # In and out
        rest: wp.array[wp.vec4],
    ):
        t = wp.tid()
        scatter_stress(elements, t, -densities[t] * frame(elements, t), rest)

    return add_rest_weight


# --- a dilatation that elements share ---------------------------------------------------------------------------------
#
# The work of a group is -(sum of q_e w'(theta) c + sum of q_e h'(theta_e) c_e), with q_e = lambda_e V_e, c_e the change
# of theta_e in the direction L, and c the mean of these. Its derivative with respect to q_e is
#     -(w'(theta) c_e + w''(theta) c (theta_e - theta) + h'(theta_e) c_e).
# ``shared`` has w'' c theta, w' and w'' c, or the means of these over an element's nodes.


@functools.cache
def add_dilatation_work(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add the derivative with respect to each element's lambda, times a scale."""
    measure, holding = of.measure, of.holding

    @law_kernel()
    def add_dilatation_work(
        # In
        elements: Elements,
        shared: wp.array[wp.vec4],
        u: wp.array[wp.vec4],
        adjoint: wp.array[wp.vec4],
        scale: float,
        # In and out
        work: wp.array[wp.float64],
    ):
        t = wp.tid()
        theta, slope = measure(own_gradient(elements, t, u))
        change = wp.ddot(slope, own_gradient(elements, t, adjoint))
        density = (shared[t][1] + holding(theta)[1]) * change + shared[t][2] * theta - shared[t][0]
        work[t] = work[t] - wp.float64(scale * density) * wp.float64(rest_volume(elements, t))

    return add_dilatation_work


@functools.cache
def add_dilatation_rest_work(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add the derivative with respect to the nodes' rest positions [N]."""
    measure, turning, holding = of.measure, of.turning, of.holding

    @law_kernel()
    def add_dilatation_rest_work(
        # In
        elements: Elements,
        material: IsotropicMaterial,
        shared: wp.array[wp.vec4],
        u: wp.array[wp.vec4],
        adjoint: wp.array[wp.vec4],
        # In and out
        rest: wp.array[wp.vec4],
    ):
        t = wp.tid()
        a = own_gradient(elements, t, u)
        grad = own_gradient(elements, t, adjoint)
        theta, slope = measure(a)
        held = holding(theta)
        change = wp.ddot(slope, grad)
        f = identity3() + a
        first = shared[t][1] + held[1]
        density = first * change + shared[t][2] * theta - shared[t][0]
        e = density * identity3() - (shared[t][2] + held[2] * change) * (wp.transpose(f) * slope)
        e -= first * (wp.transpose(f) * turning(a, grad) + wp.transpose(grad) * slope)
        stress = material.lam[t * material.stride] * e
        scatter_stress(elements, t, in_local_frame(elements, t, stress), rest)

    return add_dilatation_rest_work


# --- fibres -----------------------------------------------------------------------------------------------------------


@functools.cache
def add_fibre_work(Elements: type) -> wp.Kernel:
    """Add the derivative with respect to each element's active stress, times a scale: of P = s (F d) d^T."""

    @law_kernel()
    def add_fibre_work(
        # In
        elements: Elements,
        material: FibreMaterial,
        u: wp.array[wp.vec4],
        adjoint: wp.array[wp.vec4],
        scale: float,
        # In and out
        work: wp.array[wp.float64],
    ):
        t = wp.tid()
        m = axes_of(material.passive, t)
        g, _turn = material_gradient(elements, t, m, u)
        grad, _turn = material_gradient(elements, t, m, adjoint)
        density = filled(material.passive, t) * wp.dot(column(m + g, 0), column(grad, 0))
        work[t] = work[t] - wp.float64(scale * density) * wp.float64(rest_volume(elements, t))

    return add_fibre_work
