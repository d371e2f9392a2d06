"""Elasticity by edge springs.

``spring_stress`` and its companions: the six edges of a tetrahedron as springs that pull on one another (Delingette
2008; Kikuuwe, Tabuchi and Yamamoto 2009). Green's strain is linear in the squared lengths of the edges, E = -1/2 sum of
D sym(grad N_i (x) grad N_j) with D = l^2 - L^2, which is St. Venant-Kirchhoff's law; quadratic springs put their
small-strain form D = 2 L (l - L). ``scatter_mass_spring``: one independent linear spring for each edge of the mesh.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.math.rotation import column, identity3
from warp_corot.kernels.tables.shapes import FIRST_NODE, SECOND_NODE

from .constitutive import IsotropicMaterial, hooke, hooke_energy, symmetric
from .cpu import rest_inverse_of
from .elements import add_force, frame, load_node, local_gradient
from .shapes import mat43

wp.set_module_options({"enable_backward": False})


# --- quadratic springs on the edges of each element -------------------------------------------------------------------


@wp.func
def hats_and_corners(elements: Any, t: int):
    """Gradients of the hat functions [1/m], and the corners at rest from the first [m], in the local frame; a row a
    node."""
    b = rest_inverse_of(elements, t, identity3())
    x = wp.inverse(b)
    hats = mat43()
    corners = mat43()
    hats[0] = -(b[0] + b[1] + b[2])
    for n in range(3):
        hats[n + 1] = b[n]
        corners[n + 1] = column(x, n)
    return hats, corners


@wp.func
def edge_stretch(rest: wp.vec3, stretch: wp.vec3):
    """D of one edge [m^2], and the factor by which its change is the deformed edge times that edge's change.

    ``rest`` is the edge at rest, ``stretch`` the difference of its ends' displacements: l - L without cancellation.
    """
    length = wp.length(rest + stretch)
    rest_length = wp.length(rest)
    elongation = (2.0 * wp.dot(rest, stretch) + wp.dot(stretch, stretch)) / (length + rest_length)
    return 2.0 * rest_length * elongation, 2.0 * rest_length / wp.max(length, 1.0e-12 * rest_length)


@wp.func
def edge_strain(q: wp.mat33, g: wp.mat33, hats: mat43, corners: mat43):
    """E of the six edges under a local gradient G in the frame Q."""
    strain = wp.mat33()
    for e in range(6):
        rest = corners[SECOND_NODE[e]] - corners[FIRST_NODE[e]]
        d, _pull = edge_stretch(q * rest, g * rest)
        strain -= (0.5 * d) * symmetric(wp.outer(hats[FIRST_NODE[e]], hats[SECOND_NODE[e]]))
    return strain


@wp.func
def tension_of(s: wp.mat33, hats: mat43, e: int):
    """The derivative of the energy density with respect to D of an edge, of the stress S = dW/dE."""
    return -0.5 * wp.dot(hats[FIRST_NODE[e]], s * hats[SECOND_NODE[e]])


@wp.func
def spring_stress(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    i = t * material.stride
    q = frame(elements, t)
    g = local_gradient(elements, t, u)
    hats, corners = hats_and_corners(elements, t)
    s = hooke(edge_strain(q, g, hats, corners), material.mu[i], material.lam[i])
    p = wp.mat33()
    for e in range(6):
        rest = corners[SECOND_NODE[e]] - corners[FIRST_NODE[e]]
        _d, pull = edge_stretch(q * rest, g * rest)
        p += (tension_of(s, hats, e) * pull) * wp.outer((q + g) * rest, rest)
    return p


@wp.func
def spring_differential(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
    i = t * material.stride
    q = frame(elements, t)
    g = local_gradient(elements, t, u)
    hats, corners = hats_and_corners(elements, t)
    s = hooke(edge_strain(q, g, hats, corners), material.mu[i], material.lam[i])
    d_strain = wp.mat33()
    for e in range(6):
        rest = corners[SECOND_NODE[e]] - corners[FIRST_NODE[e]]
        _d, pull = edge_stretch(q * rest, g * rest)
        change = pull * wp.dot((q + g) * rest, dg * rest)
        d_strain -= (0.5 * change) * symmetric(wp.outer(hats[FIRST_NODE[e]], hats[SECOND_NODE[e]]))
    d_s = hooke(d_strain, material.mu[i], material.lam[i])
    dp = wp.mat33()
    for e in range(6):
        rest = corners[SECOND_NODE[e]] - corners[FIRST_NODE[e]]
        _d, pull = edge_stretch(q * rest, g * rest)
        edge = (q + g) * rest
        d_edge = dg * rest
        turning = wp.dot(edge, d_edge) / wp.max(wp.length_sq(edge), 1.0e-24 * wp.length_sq(rest))
        tension = tension_of(s, hats, e)
        dp += pull * wp.outer((tension_of(d_s, hats, e) - tension * turning) * edge + tension * d_edge, rest)
    return dp


@wp.func
def spring_density(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4]):
    i = t * material.stride
    hats, corners = hats_and_corners(elements, t)
    strain = edge_strain(frame(elements, t), local_gradient(elements, t, u), hats, corners)
    return hooke_energy(strain, material.mu[i], material.lam[i])


# --- independent springs on the edges of the mesh ---------------------------------------------------------------------


@wp.func
def spring_state(edges: wp.array[wp.vec2i], rest: wp.array[wp.vec3], e: int, u: wp.array[wp.vec4]):
    """The deformed edge [m], its length, which is never zero, and its elongation without cancellation."""
    stretch = load_node(u, edges[e][1]) - load_node(u, edges[e][0])
    edge = rest[e] + stretch
    rest_length = wp.length(rest[e])
    # An edge without length has no direction.
    length = wp.max(wp.length(edge), 1.0e-12 * rest_length)
    return edge, length, (2.0 * wp.dot(rest[e], stretch) + wp.dot(stretch, stretch)) / (length + rest_length)


@wp.kernel(enable_backward=False)
def scatter_mass_spring(
    # In
    edges: wp.array[wp.vec2i],
    targets: wp.array[wp.vec2i],
    rest: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    e = wp.tid()
    edge, length, elongation = spring_state(edges, rest, e, u)
    force = (stiffness[e] * elongation / length) * edge
    add_force(f, targets[e][0], force)
    add_force(f, targets[e][1], -force)


@wp.kernel(enable_backward=False)
def mass_spring_energies(
    # In
    edges: wp.array[wp.vec2i],
    rest: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    # Out
    energies: wp.array[wp.float64],
):
    e = wp.tid()
    _edge, _length, elongation = spring_state(edges, rest, e, u)
    energies[e] = wp.float64(0.5 * stiffness[e] * elongation * elongation)


@wp.func
def spring_stiffness(edges: wp.array[wp.vec2i], rest: wp.array[wp.vec3], e: int, u: wp.array[wp.vec4]):
    """a and v of the stiffness k (a I + v v^T) of a spring with the force k (l - L) / l times the edge."""
    edge, length, elongation = spring_state(edges, rest, e, u)
    return elongation / length, (wp.sqrt(wp.length(rest[e]) / length) / length) * edge


@wp.kernel(enable_backward=False)
def add_mass_spring_product(
    # In
    edges: wp.array[wp.vec2i],
    rest: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    p: wp.array[wp.vec4],
    # In and out
    y: wp.array[wp.vec4],
):
    e = wp.tid()
    a, v = spring_stiffness(edges, rest, e, u)
    d = load_node(p, edges[e][1]) - load_node(p, edges[e][0])
    force = stiffness[e] * (a * d + wp.dot(v, d) * v)
    add_force(y, edges[e][0], -force)
    add_force(y, edges[e][1], force)


@wp.kernel(enable_backward=False)
def add_mass_spring_diagonal(
    # In
    edges: wp.array[wp.vec2i],
    rest: wp.array[wp.vec3],
    stiffness: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    # In and out
    blocks: wp.array[wp.mat33],
):
    e = wp.tid()
    a, v = spring_stiffness(edges, rest, e, u)
    block = stiffness[e] * (wp.diag(wp.vec3(a, a, a)) + wp.outer(v, v))
    wp.atomic_add(blocks, edges[e][0], block)
    wp.atomic_add(blocks, edges[e][1], block)
