"""Stiffness products of the springs of ``springs``, exact."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.tables.shapes import FIRST_NODE, SECOND_NODE

from .constitutive import IsotropicMaterial
from .elements import add_force, frame, load_node, local_gradient, rest_volume
from .springs import edge_stretch, edge_tensions, rest_nodes, vec6

wp.set_module_options({"enable_backward": False})


@functools.cache
def edge_stvk_differential(biquadratic: bool) -> wp.Function:
    """The differential, for ``stiffness_products``, of the total stress of an element's six coupled springs.

    A spring that pulls its ends together with the force v along the rest edge X adds v X^T / V to the stress.
    """

    @wp.func
    def edge_stvk_differential(elements: Any, t: int, material: IsotropicMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        i = t * material.stride
        q = frame(elements, t)
        g = local_gradient(elements, t, u)
        x = rest_nodes(elements, t)
        d = vec6()
        dd = vec6()
        pull = vec6()
        d_pull = vec6()
        for e in range(6):
            rest = x[SECOND_NODE[e]] - x[FIRST_NODE[e]]
            edge = (q + g) * rest
            measure, factor = edge_stretch(q * rest, g * rest, wp.static(biquadratic))
            along = wp.dot(edge, dg * rest)
            d[e] = measure
            dd[e] = factor * along
            pull[e] = factor
            if wp.static(not biquadratic):
                d_pull[e] = -factor * along / wp.max(wp.length_sq(edge), 1.0e-24 * wp.length_sq(rest))
        tension = edge_tensions(elements, t, d, material.mu[i], material.lam[i])
        d_tension = edge_tensions(elements, t, dd, material.mu[i], material.lam[i])
        p = wp.mat33()
        for e in range(6):
            rest = x[SECOND_NODE[e]] - x[FIRST_NODE[e]]
            force = (d_tension[e] * pull[e] + tension[e] * d_pull[e]) * ((q + g) * rest)
            force += (tension[e] * pull[e]) * (dg * rest)
            p += wp.outer(force, rest)
        return p / rest_volume(elements, t)

    return edge_stvk_differential


@wp.func
def spring_stiffness(edges: wp.array[wp.vec2i], rest: wp.array[wp.vec3], e: int, u: wp.array[wp.vec4]):
    """a and v of a linear spring's stiffness k (a I + v v^T), as the force is k (l - L) / l times the edge."""
    stretch = load_node(u, edges[e][1]) - load_node(u, edges[e][0])
    edge = rest[e] + stretch
    rest_length = wp.length(rest[e])
    # An edge without length has no direction.
    length = wp.max(wp.length(edge), 1.0e-12 * rest_length)
    elongation = (2.0 * wp.dot(rest[e], stretch) + wp.dot(stretch, stretch)) / (length + rest_length)
    return elongation / length, (wp.sqrt(rest_length / length) / length) * edge


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
    i = edges[e][0]
    j = edges[e][1]
    a, v = spring_stiffness(edges, rest, e, u)
    d = load_node(p, j) - load_node(p, i)
    force = stiffness[e] * (a * d + wp.dot(v, d) * v)
    add_force(y, i, -force)
    add_force(y, j, force)


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
