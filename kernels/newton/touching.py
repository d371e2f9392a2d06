"""Points of soft surfaces that touch: on a vertex, an edge, or a triangle, as Newton's records give them.

A point x = sum of b_j x_j has weights b_j >= 0 of at most three particles, and a force F there acts on each as b_j F.

Newton's records of an edge or a triangle are at the point that is deepest in a shape. If that is one of its corners, it
only repeats the particle's own record; on flat ground, all do, and rounding decides which corner is deepest. So such a
record has a measure from 0 at the corners, and at a triangle's sides, to 1 in the middle, and its force is multiplied
by that.

Many records may share a particle: its load is the sum of its weights in all that touch, times their measures. Two
bounds follow, by Jensen's inequality. Stiffness k in every record adds at most k times the load at a particle, so
records with a particle whose load is above ``crowd`` get only their share of crowd k; and dampers of
1 / (dt max w_j load_j), with inverse masses w, stop nothing more than once within a step.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node

from .particles import ACTIVE
from .worlds import place_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class Point:
    """A point of a soft surface."""

    nodes: wp.vec3i  # particles, -1 where there is none
    weights: wp.vec3
    measure: float


@wp.func
def point_of(
    c: int,
    particle: wp.array[wp.int32],
    nodes: wp.array[wp.vec3i],
    weights: wp.array[wp.vec3],
):
    """The point of record c. A record of a particle needs no weights."""
    p = Point()
    p.measure = 1.0
    i = particle[c]
    if i >= 0:
        p.nodes = wp.vec3i(i, -1, -1)
        p.weights = wp.vec3(1.0, 0.0, 0.0)
        return p
    p.nodes = nodes[c]
    b = weights[c]
    p.weights = b
    if p.nodes[2] >= 0:
        p.measure = 27.0 * b[0] * b[1] * b[2]
    elif p.nodes[1] >= 0:
        p.measure = 4.0 * b[0] * b[1]
    return p


@wp.func
def is_active(p: Point, flags: wp.array[wp.int32]):
    """Whether a particle of the point can be pushed."""
    active = bool(False)
    for k in range(3):
        if p.nodes[k] >= 0:  # noqa: SIM102 - the next value exists only then
            if (flags[p.nodes[k]] & ACTIVE) != 0:
                active = True
    return active


@wp.func
def mean_of(p: Point, values: wp.array[wp.vec3]):
    """A position or a velocity of the point."""
    mean = p.weights[0] * values[p.nodes[0]]
    for k in range(1, 3):
        if p.nodes[k] >= 0:
            mean += p.weights[k] * values[p.nodes[k]]
    return mean


@wp.func
def largest_of(p: Point, values: wp.array[wp.float32]):
    """The largest value of the point's particles."""
    most = values[p.nodes[0]]
    for k in range(1, 3):
        if p.nodes[k] >= 0:
            most = wp.max(most, values[p.nodes[k]])
    return most


@wp.func
def load_of(i: int, load: wp.array[wp.float32]):
    """The load of a particle; 1 where loads are not counted, because every record has a particle of its own."""
    if load.shape[0] == 0:
        return 1.0
    return load[i]


@wp.func
def share_of(p: Point, load: wp.array[wp.float32], crowd: float):
    """The share of its stiffness that a record has."""
    most = float(1.0)
    for k in range(3):
        if p.nodes[k] >= 0 and p.weights[k] > 0.0:
            most = wp.max(most, load_of(p.nodes[k], load))
    return wp.min(1.0, crowd / most)


@wp.func
def mobility_of_point(
    p: Point, load: wp.array[wp.float32], inverse_mass: wp.array[wp.float32], flags: wp.array[wp.int32]
):
    """Inverse mass of the point for one of the records that share its particles [1/kg]."""
    most = float(0.0)
    for k in range(3):
        i = p.nodes[k]
        if i >= 0 and p.weights[k] > 0.0:  # noqa: SIM102 - the next value exists only then
            if (flags[i] & ACTIVE) != 0:
                most = wp.max(most, inverse_mass[i] * load_of(i, load))
    return most


@wp.func
def pull_of(
    p: Point,
    dt: float,
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    world: wp.array[wp.int32],
    gravity: wp.array[wp.vec3],
    before: wp.array[wp.vec4],
):
    """Change of the point's velocity in this step by forces before those of contacts [m/s]."""
    pull = wp.vec3()
    for k in range(3):
        i = p.nodes[k]
        if i >= 0:  # noqa: SIM102 - the next values exist only then
            if inverse_mass[i] > 0.0 and (flags[i] & ACTIVE) != 0:
                g = gravity[place_of(world[i], gravity.shape[0])]
                pull += p.weights[k] * dt * (inverse_mass[i] * load_node(before, i) + g)
    return pull


@wp.func
def add_to_point(p: Point, force: wp.vec3, f: wp.array[wp.vec4]):
    """Add a force at the point to its particles' forces."""
    for k in range(3):
        if p.nodes[k] >= 0:
            add_force(f, p.nodes[k], p.weights[k] * force)


@wp.func
def add_load(p: Point, load: wp.array[wp.float32]):
    for k in range(3):
        if p.nodes[k] >= 0 and p.weights[k] > 0.0:
            wp.atomic_add(load, p.nodes[k], p.measure * p.weights[k])


@wp.kernel(enable_backward=False)
def count_loads(
    # In
    count: wp.array[wp.int32],
    contact_particle: wp.array[wp.int32],
    contact_nodes: wp.array[wp.vec3i],
    contact_weights: wp.array[wp.vec3],
    contact_shape: wp.array[wp.int32],
    contact_point: wp.array[wp.vec3],
    contact_normal: wp.array[wp.vec3],
    shape_body: wp.array[wp.int32],
    shape_margin: wp.array[wp.float32],
    adhesion: float,
    radius: wp.array[wp.float32],
    q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    # In and out
    load: wp.array[wp.float32],
):
    """Add the weights of all records that touch at the bodies' current positions."""
    c = wp.tid()
    if c >= wp.min(count[0], contact_particle.shape[0]):
        return
    p = point_of(c, contact_particle, contact_nodes, contact_weights)
    shape = contact_shape[c]
    point = contact_point[c]
    body = shape_body[shape]
    if body >= 0:
        point = wp.transform_point(body_q[body], point)
    gap = contact_gap(contact_normal[c], mean_of(p, q), largest_of(p, radius), point, shape, shape_margin)
    if gap <= adhesion:
        add_load(p, load)


@wp.func
def contact_gap(
    normal: wp.vec3, x: wp.vec3, radius: float, point: wp.vec3, shape: int, shape_margin: wp.array[wp.float32]
):
    gap = wp.dot(normal, x - point) - radius
    if shape_margin.shape[0] > 0:
        gap -= shape_margin[shape]
    return gap
