"""Criteria for remeshing besides the elongation: Warp functions of an element's state and an array of numbers."""

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain, hooke
from warp_corot.kernels.elements.forces import von_mises
from warp_corot.kernels.math.rotation import byers_xu, identity3
from warp_corot.kernels.meshing.bisection import refinement_end

from .mark import ElementState


@wp.func
def longest_edge(element: ElementState):
    """Rest length of the longest edge, which is the refinement edge [m]."""
    return wp.length(element.rest[refinement_end(element.level)])


@wp.func
def displacement_gradient(element: ElementState):
    """du/dX, which is F - I."""
    rest = wp.matrix_from_cols(element.rest[1], element.rest[2], element.rest[3])
    u = element.moved[0]
    moved = wp.matrix_from_cols(element.moved[1] - u, element.moved[2] - u, element.moved[3] - u)
    return moved * wp.inverse(rest)


@wp.func
def green_strain(element: ElementState):
    """Green strain E = (F^T F - I) / 2, which does not depend on rotations."""
    gradient = displacement_gradient(element)
    return 0.5 * (gradient + wp.transpose(gradient) + wp.transpose(gradient) * gradient)


@wp.func
def von_mises_stress(element: ElementState, parameters: wp.array[wp.float32]):
    """Von Mises stress of the corotated law [Pa], times the longest edge over ``parameters[0]`` [m] as in ``strain``.

    The material of a parent is known if it has been an element; otherwise the stress counts as zero.
    """
    gradient = displacement_gradient(element)
    r = byers_xu(identity3() + gradient)
    stress = hooke(corotated_strain(gradient, identity3(), r), element.mu, element.lam)
    return von_mises(stress) * longest_edge(element) / parameters[0]


@wp.func
def strain(element: ElementState, parameters: wp.array[wp.float32]):
    """Norm of the Green strain, times the longest edge over ``parameters[0]`` [m].

    Unlike the elongation, it does not depend on the directions of the edges. Small elements are needed
    where strain varies within an element, not where it is large; near a notch or a tool strain decays with the
    distance, so strain times size measures that, and the mesh becomes coarser with the distance.
    """
    e = green_strain(element)
    return wp.sqrt(wp.ddot(e, e)) * longest_edge(element) / parameters[0]


@wp.func
def nearness(element: ElementState, parameters: wp.array[wp.float32]):
    """Longest edge over the distance of the moved centroid from a tool, a box with optional rounding.

    Parameters, all in metres: the box's centre, half its size along each axis, the radius of its rounding
    (for a ball the half sizes are zero), and a length added to the distance, which limits refinement
    at contact. Five more may follow, the box's rotation, (x, y, z, w), and a factor of the distance.
    """
    x = element.corner
    for n in range(4):
        x += 0.25 * (element.rest[n] + element.moved[n])
    centre = wp.vec3(parameters[0], parameters[1], parameters[2])
    half = wp.vec3(parameters[3], parameters[4], parameters[5])
    x -= centre
    share = float(1.0)
    if parameters.shape[0] > 8:
        share = parameters[12]
        x = wp.quat_rotate_inv(wp.quat(parameters[8], parameters[9], parameters[10], parameters[11]), x)
    outside = wp.length(wp.max(wp.abs(x) - half, wp.vec3(0.0))) - parameters[6]
    return longest_edge(element) / (share * wp.max(outside, 0.0) + parameters[7])


#: Least number of parameters of each criterion.
PARAMETER_COUNTS = {von_mises_stress: 1, strain: 1, nearness: 8}
