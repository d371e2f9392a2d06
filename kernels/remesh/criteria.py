"""Marking of leaves for refinement or simplification: a criterion of the element's state against two thresholds.

A criterion is a Warp function of an element's state and an array of numbers."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import corotated_strain, hooke
from warp_corot.kernels.elements.elements import load_node
from warp_corot.kernels.elements.forces import von_mises
from warp_corot.kernels.math.rotation import byers_xu, identity3
from warp_corot.kernels.meshing.bisection import lattice_place, refinement_end, single
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.remesh.pools import LEAVES, REFINE, SIMPLIFY, Pools

#: Fraction of its volume inside the body below which an element is refined only for conformity: most of what is
#: stretched there is not tissue, and its halves would hold almost no mass.
LEAST_FILL = 0.5

mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.struct
class ElementState:
    """The state of an element for a criterion, with its nodes in Maubach order."""

    level: int
    corner: wp.vec3  # rest position of node 0 [m]
    rest: mat43  # rest positions relative to node 0, a row for each node [m]
    moved: mat43  # displacements, a row for each node [m]
    mu: float  # Lamé's parameters [Pa] of the nearest isotropic material
    lam: float


@wp.struct
class Contents:
    """Material data of tetrahedra for marking; columns of ``Carried.values``, or -1."""

    values: wp.array2d[wp.float32]
    mu: float  # Lamé's parameters of all elements if they are equal and have no columns
    lam: float
    mu_column: int
    lam_column: int
    fill_column: int


@wp.func
def elongation(element: ElementState, parameters: wp.array[wp.float32]):
    """Deformed over rest length of the longest edge, which is the refinement edge (Tagawa et al. 2013)."""
    k = refinement_end(element.level)
    edge = element.rest[k]
    change = element.moved[k] - element.moved[0]
    return wp.length(edge + change) / wp.length(edge)


@wp.func
def load_state(
    e: int,
    origin: wp.vec3d,
    spacing: wp.float64,
    pools: Pools,
    contents: Contents,
    u: wp.array[wp.vec4],
):
    """The state of a tetrahedron, a leaf or an ancestor, for a criterion."""
    state = ElementState()
    tet = pools.tets[e]
    p = pools.lattice[tet[0]]
    state.level = pools.level[e]
    state.corner = single(lattice_place(p, origin, spacing))
    size = float(spacing)
    rest = mat43()
    moved = mat43()
    for n in range(4):
        q = pools.lattice[tet[n]] - p
        rest[n] = size * wp.vec3(float(q[0]), float(q[1]), float(q[2]))
        moved[n] = load_node(u, tet[n])
    state.rest = rest
    state.moved = moved
    state.mu = contents.mu
    state.lam = contents.lam
    if contents.mu_column >= 0:
        state.mu = contents.values[e, contents.mu_column]
        state.lam = contents.values[e, contents.lam_column]
    return state


@wp.func
def holds_enough(e: int, contents: Contents):
    """Whether an element may be refined if conformity does not require it."""
    if contents.fill_column < 0:
        return True
    return contents.values[e, contents.fill_column] >= wp.static(LEAST_FILL)


@functools.cache
def marking_kernel(criterion: Any) -> wp.Kernel:
    """The kernel that marks leaves by a criterion: a Warp function of an ``ElementState`` and an array of numbers.

    A leaf is not merged if its parent would be refined at once: edges of an element and of its halves have different
    directions, so that one may be stretched and the other not.
    """

    @unique_kernel()
    def mark_leaves(
        # In
        threads: int,
        refine_above: float,
        simplify_below: float,
        origin: wp.vec3d,
        spacing: wp.float64,
        u: wp.array[wp.vec4],
        parameters: wp.array[wp.float32],
        contents: Contents,
        # In and out
        pools: Pools,
    ):
        for i in range(wp.tid(), pools.counts[LEAVES], threads):
            e = pools.leaves[i]
            value = criterion(load_state(e, origin, spacing, pools, contents, u), parameters)
            mark = wp.int8(0)
            if value > refine_above:
                if holds_enough(e, contents):
                    mark = REFINE
            elif value < simplify_below and pools.parent[e] >= 0:
                above = criterion(load_state(pools.parent[e], origin, spacing, pools, contents, u), parameters)
                if above <= refine_above:
                    mark = SIMPLIFY
            pools.marks[i] = mark

    return mark_leaves


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
