"""Rows: contacts of soft surfaces with shapes and with one another, and attachments of particles to bodies.

A row has up to four particles with weights b_j: what opens it is the vector of sum b_j x_j from a point of a body, or
from the origin. A force F on it acts on each particle as b_j F, and on the body with the opposite sign.

Newton's records of an edge or a triangle are at the point that is deepest in a shape. If that is one of its corners, it
only repeats the particle's own record; on flat ground, all do, and rounding decides which corner is deepest. So such a
row has a measure from 0 at the corners, and at a triangle's sides, to 1 in the middle, and its force is multiplied by
that.

Many rows may share a particle: its load is the sum of its weights in all that touch, times their measures. Two
bounds follow, by Jensen's inequality. Stiffness k in every row adds at most k times the load at a particle, so
rows with a particle whose load is above ``crowd`` get only their share of crowd k; and dampers of
1 / (dt max w_j load_j), with inverse masses w, stop nothing more than once within a step.

Newton finds contacts where things are when it is asked. A particle that had no row in the last step, and is deep in a
shape now, has been found late: its whole spring would throw it out. So it begins to push where it is, and is let out at
the speed ``recovery``.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node

from .particles import ACTIVE
from .worlds import place_of

wp.set_module_options({"enable_backward": False})


@wp.struct
class ContactLaw:
    """Parameters of particles; contacts with shapes have the mean of these and the shape's."""

    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    slope: float  # of friction [N s/m]
    friction: float
    adhesion: float  # distance up to which a particle adheres [m]
    crowd: float  # maximum stiffness of all contacts at a particle over that of one
    recovery: float  # speed at which what was found too late is pushed out [m/s]


@wp.struct
class Row:
    """A contact or an attachment."""

    nodes: wp.vec4i  # particles, -1 where there is none; there is no row if the first is -1
    weights: wp.vec4
    measure: float
    counted: float  # how often it counts in loads
    body: int  # -1: there is none
    point: wp.vec3  # in the body's frame [m]
    velocity: wp.vec3  # of the surface of the body's shape there, in its frame [m/s]
    normal: wp.vec3  # to the particles; zero: an attachment
    offset: float  # the distance from which on a contact pushes [m]
    ease: float  # how much deeper a contact begins to push, because it was found late [m]
    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    slope: float  # of friction [N s/m]
    friction: float


@wp.struct
class Particles:
    """Particles of a model."""

    flags: wp.array[wp.int32]
    world: wp.array[wp.int32]
    inverse_mass: wp.array[wp.float32]
    gravity: wp.array[wp.vec3]  # of each world


@wp.struct
class Bodies:
    """Rigid bodies of a model, and their state."""

    fixed_flag: int  # of bodies with prescribed motion
    flags: wp.array[wp.int32]
    inverse_mass: wp.array[wp.float32]
    inverse_inertia: wp.array[wp.mat33]
    com: wp.array[wp.vec3]
    places: wp.array[wp.int32]  # at how many places each is touched or held
    yielding: wp.array[wp.spatial_vector]  # see ``explicit_rows``
    q: wp.array[wp.transform]
    qd: wp.array[wp.spatial_vector]


@wp.func
def no_row():
    row = Row()
    row.nodes = wp.vec4i(-1, -1, -1, -1)
    return row


@wp.func
def is_attachment(row: Row):
    return row.normal == wp.vec3()


@wp.func
def is_moved(i: int, particles: Particles):
    """Whether forces move a particle."""
    return (particles.flags[i] & ACTIVE) != 0 and particles.inverse_mass[i] > 0.0


@wp.func
def is_active(row: Row, flags: wp.array[wp.int32]):
    """Whether a particle of the row is active."""
    active = bool(False)
    for k in range(4):
        if row.nodes[k] >= 0:  # noqa: SIM102 - the next value exists only then
            if (flags[row.nodes[k]] & ACTIVE) != 0:
                active = True
    return active


@wp.func
def sum_of(row: Row, values: wp.array[wp.vec3]):
    """The weighted sum of positions or velocities."""
    total = row.weights[0] * values[row.nodes[0]]
    for k in range(1, 4):
        if row.nodes[k] >= 0:
            total += row.weights[k] * values[row.nodes[k]]
    return total


@wp.func
def point_and_arm(row: Row, bodies: Bodies):
    """The body's point, and its arm from the centre of mass; without a body, from the origin."""
    point = row.point
    arm = row.point
    if row.body >= 0:
        pose = bodies.q[row.body]
        point = wp.transform_point(pose, point)
        arm = point - wp.transform_point(pose, bodies.com[row.body])
    return point, arm


@wp.func
def gap_of(row: Row, apart: wp.vec3):
    return wp.dot(row.normal, apart) - row.offset + row.ease


@wp.func
def ease_off(c: int, dt: float, law: ContactLaw, rows: wp.array[Row]):
    """End a substep of a contact that was found late."""
    ease = rows[c].ease
    if ease > 0.0:
        rows[c].ease = wp.max(ease - law.recovery * dt, 0.0)


@wp.func
def load_of(i: int, load: wp.array[wp.float32]):
    """The load of a particle; 1 where loads are not counted, because every row has a particle of its own."""
    if load.shape[0] == 0:
        return 1.0
    return load[i]


@wp.func
def share_of(row: Row, load: wp.array[wp.float32], crowd: float):
    """The share of its stiffness that a contact has."""
    largest = float(1.0)
    for k in range(4):
        if row.nodes[k] >= 0 and row.weights[k] != 0.0:
            largest = wp.max(largest, load_of(row.nodes[k], load))
    return wp.min(1.0, crowd / largest)


@wp.func
def inverse_mass_of(row: Row, load: wp.array[wp.float32], particles: Particles):
    """Inverse mass of a contact's point, for one of the contacts that share its particles [1/kg]."""
    largest = float(0.0)
    for k in range(4):
        i = row.nodes[k]
        if i >= 0 and row.weights[k] != 0.0:  # noqa: SIM102 - the next value exists only then
            if is_moved(i, particles):
                largest = wp.max(largest, particles.inverse_mass[i] * load_of(i, load))
    return largest


@wp.func
def pull_of(row: Row, dt: float, particles: Particles, before: wp.array[wp.vec4]):
    """Change of a contact's velocity in this step by forces before those of contacts [m/s]."""
    pull = wp.vec3()
    for k in range(4):
        i = row.nodes[k]
        if i >= 0:  # noqa: SIM102 - the next values exist only then
            if is_moved(i, particles):
                g = particles.gravity[place_of(particles.world[i], particles.gravity.shape[0])]
                pull += row.weights[k] * dt * (particles.inverse_mass[i] * load_node(before, i) + g)
    return pull


@wp.func
def add_to_particles(row: Row, force: wp.vec3, f: wp.array[wp.vec4]):
    for k in range(4):
        if row.nodes[k] >= 0:
            add_force(f, row.nodes[k], row.weights[k] * force)


@wp.func
def add_load(row: Row, load: wp.array[wp.float32]):
    for k in range(4):
        weight = row.counted * wp.abs(row.weights[k])
        if row.nodes[k] >= 0 and weight > 0.0:
            wp.atomic_add(load, row.nodes[k], weight)


@wp.kernel(enable_backward=False)
def count_loads(
    # In
    adhesion: float,
    rows: wp.array[Row],
    bodies: Bodies,
    q: wp.array[wp.vec3],
    # In and out
    load: wp.array[wp.float32],
):
    """Add the weights of all contacts that touch at the bodies' current positions."""
    row = rows[wp.tid()]
    if row.nodes[0] >= 0 and row.counted > 0.0:
        point, _arm = point_and_arm(row, bodies)
        if gap_of(row, sum_of(row, q) - point) <= adhesion:
            add_load(row, load)
