"""Rows: contacts of soft surfaces with shapes and with one another, and attachments of particles to bodies.

A row has up to four particles with weights b_j: what opens it is the vector of sum b_j x_j from a point of a body, or
from the origin. A force F on it acts on each particle as b_j F, and on the body with the opposite sign.

Newton's records of an edge or a triangle are at the point that is deepest in a shape. If that is one of its corners, it
only repeats the particle's own record; on flat ground, all do, and rounding decides which corner is deepest. So such a
row has a measure from 0 at the corners, and at a triangle's sides, to 1 in the middle, and its force is multiplied by
that.

Many rows may share a particle: its load is the sum of its weights in all that may act in the step, times their
measures. By Jensen's inequality, springs and dampers that are bounded by the inverse mass max w_j load_j, with inverse
masses w, are bounded in all rows together.

Newton finds contacts where things are when it is asked. A particle that had no row in the last step, and is deep in a
shape now, has been found late: its whole spring would throw it out. So it begins to push where it is, and is let out at
the speed ``recovery``.

For a triangle mesh, Newton records every pair of a particle and a triangle, of a soft triangle and a vertex, and of two
edges within the gap. Many of these repeat each other, and some are across the shape: a particle just below one face is
deep below the others. So a particle counts for the nearest triangle only, and a vertex for the nearest soft triangle
only. A soft edge that is inside counts for the edge that is nearest to it and for those up to ``DEEPER`` times as far
away.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node

from .particles import (
    ACTIVE,
    NO_ROW,
    TOO_MANY_CONTACTS,
    Bodies,
    Memory,
    Particles,
    in_world,
    is_moved,
)

wp.set_module_options({"enable_backward": False})

#: See above.
DEEPER = wp.constant(2.0)
#: Distances are compared with this relative tolerance, and this absolute one [m].
NEARLY, TINY = wp.constant(1.0e-4), wp.constant(1.0e-7)
#: Families of Newton's records, its bits for the family, and its flags for a place inside and for a side that is not
#: known; see Newton's ``soft_contacts_mesh``.
OF_PARTICLE, OF_VERTEX, FAMILY, INSIDE, UNKNOWN = (wp.constant(k) for k in (0, 1, 7, 8, 32))
#: Unit of distances as whole numbers [m], and how many times it a number of a feature counts.
GRAIN, NUMBERS = wp.constant(1.0e-9), wp.constant(wp.int64(4294967296))
FAR = wp.constant(wp.int64(9223372036854775807))


@wp.struct
class ContactLaw:
    """Parameters of particles; contacts with shapes have the mean of these and the shape's."""

    stiffness: float  # [N/m]
    damping: float  # [N s/m]
    slope: float  # of friction [N s/m]
    friction: float
    adhesion: float  # distance up to which a particle adheres [m]
    recovery: float  # speed at which what was found too late is pushed out [m/s]


@wp.struct
class Row:
    """A contact or an attachment."""

    nodes: wp.vec4i  # particles, -1 where there is none; there is no row if the first is -1
    weights: wp.vec4
    measure: float
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


@wp.func
def no_row():
    row = Row()
    row.nodes = wp.vec4i(-1, -1, -1, -1)
    return row


@wp.func
def is_attachment(row: Row):
    return row.normal == wp.vec3()


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
def inverse_mass_of(row: Row, load: wp.array[wp.float32], particles: Particles):
    """Inverse mass of a contact's point, for one of the contacts that share its particles [1/kg]."""
    largest = float(0.0)
    for k in range(4):
        i = row.nodes[k]
        if i >= 0 and row.weights[k] != 0.0:  # noqa: SIM102 - the next value exists only then
            if is_moved(i, particles):
                largest = wp.max(largest, particles.inv_mass[i] * load[i])
    return largest


@wp.func
def pull_of(row: Row, dt: float, particles: Particles, before: wp.array[wp.vec4]):
    """Change of a contact's velocity in this step by forces before those of contacts [m/s]."""
    pull = wp.vec3()
    for k in range(4):
        i = row.nodes[k]
        if i >= 0:  # noqa: SIM102 - the next values exist only then
            if is_moved(i, particles):
                push = particles.inv_mass[i] * load_node(before, i)
                pull += row.weights[k] * dt * (push + in_world(particles, i, particles.gravity))
    return pull


@wp.func
def add_to_particles(row: Row, force: wp.vec3, f: wp.array[wp.vec4]):
    for k in range(4):
        if row.nodes[k] >= 0:
            add_force(f, row.nodes[k], row.weights[k] * force)


@wp.func
def add_load(row: Row, times: float, load: wp.array[wp.float32]):
    for k in range(4):
        weight = times * row.measure * wp.abs(row.weights[k])
        if row.nodes[k] >= 0 and weight > 0.0:
            wp.atomic_add(load, row.nodes[k], weight)


# --- records of Newton's collision pipeline, and attachments ----------------------------------------------------------


@wp.struct
class Shapes:
    """Shapes of a Newton model, with its names."""

    body: wp.array[wp.int32]
    margin: wp.array[wp.float32]
    material_ke: wp.array[wp.float32]
    material_kd: wp.array[wp.float32]
    material_kf: wp.array[wp.float32]
    material_mu: wp.array[wp.float32]
    transform: wp.array[wp.transform]  # in its body's frame
    scale: wp.array[wp.vec3]
    source_ptr: wp.array[wp.uint64]  # meshes


@wp.struct
class Records:
    """Newton's records of contacts, with its names."""

    count: wp.array[wp.int32]
    particle: wp.array[wp.int32]
    indices: wp.array[wp.vec3i]
    barycentric: wp.array[wp.vec3]
    shape: wp.array[wp.int32]
    body_pos: wp.array[wp.vec3]  # on the shape, in its body's frame
    body_vel: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    # Of meshes: kind, soft feature and mesh feature, kind -1 of other shapes; empty if there are no meshes.
    features: wp.array[wp.vec3i]
    nearest: wp.array[wp.int64]  # of each vertex of a mesh, and then of each soft edge, its nearest rival
    vertices: int  # number of vertices of all meshes


@wp.struct
class Attachments:
    """Attachments of particles to bodies, as a Newton model has them."""

    particle: wp.array[wp.int32]
    body: wp.array[wp.int32]
    body_point: wp.array[wp.vec3]
    stiffness: wp.array[wp.float32]
    damping: wp.array[wp.float32]
    enabled: wp.array[wp.bool]


@wp.func
def place_of_record(c: int, records: Records):
    """A row with the particles of record c. A record of a particle needs no weights."""
    row = no_row()
    row.measure = 1.0
    i = records.particle[c]
    if i >= 0:
        row.nodes[0] = i
        row.weights = wp.vec4(1.0, 0.0, 0.0, 0.0)
        return row
    n = records.indices[c]
    b = records.barycentric[c]
    row.nodes = wp.vec4i(n[0], n[1], n[2], -1)
    row.weights = wp.vec4(b[0], b[1], b[2], 0.0)
    if n[2] >= 0:
        row.measure = 27.0 * b[0] * b[1] * b[2]
    elif n[1] >= 0:
        row.measure = 4.0 * b[0] * b[1]
    return row


@wp.func
def has_active(row: Row, flags: wp.array[wp.int32]):
    """Whether a particle of the row is active."""
    found = int(0)
    for k in range(4):
        if row.nodes[k] >= 0:
            found = found | flags[row.nodes[k]]
    return (found & ACTIVE) != 0


# --- records of meshes -----------------------------------------------------------------------------------------------


@wp.func
def is_of_nearest_triangle(c: int, x: wp.vec3, records: Records, shapes: Shapes):
    """Whether no triangle is nearer to the soft point x, in the frame of its shape's body, than that of record c."""
    shape = records.shape[c]
    scale = shapes.scale[shape]
    y = wp.cw_div(wp.transform_point(wp.transform_inverse(shapes.transform[shape]), x), scale)
    least = wp.min(wp.min(wp.abs(scale[0]), wp.abs(scale[1])), wp.abs(scale[2]))
    reach = (wp.length(x - records.body_pos[c]) * (1.0 + NEARLY) + TINY) / least
    found = wp.mesh_query_point_no_sign(shapes.source_ptr[shape], y, reach)
    return not found.result or found.face == records.features[c][2]


@wp.func
def code_of(away: float, soft: int):
    """A number that is smaller for a shorter distance, and then for a smaller number of the soft feature."""
    return wp.int64(away / GRAIN) * NUMBERS + wp.int64(soft)


@wp.func
def rival_of(feature: wp.vec3i, vertices: int):
    """The number of the vertex or the soft edge for which a record competes with others; -1: for none."""
    family = feature[0] & FAMILY
    if feature[0] < 0 or family == OF_PARTICLE:
        return -1
    if family == OF_VERTEX:
        return feature[2]
    if (feature[0] & INSIDE) == 0:
        return -1
    return vertices + feature[1]


@wp.func
def counts(c: int, x: wp.vec3, records: Records, shapes: Shapes):
    """Whether record c counts, with the soft point x in the frame of its shape's body."""
    feature = records.features[c]
    if feature[0] < 0:
        return True
    if (feature[0] & UNKNOWN) != 0:
        return False
    if (feature[0] & FAMILY) == OF_PARTICLE:
        return is_of_nearest_triangle(c, x, records, shapes)
    rival = rival_of(feature, records.vertices)
    if rival < 0:
        return True
    away = wp.length(x - records.body_pos[c])
    if (feature[0] & FAMILY) == OF_VERTEX:
        return records.nearest[rival] == code_of(away, feature[1])
    return away <= DEEPER * GRAIN * float(records.nearest[rival] / NUMBERS) + TINY


@wp.func
def soft_point(row: Row, body: int, q: wp.array[wp.vec3], bodies: Bodies):
    """The soft point of a record, in the frame of its shape's body."""
    x = sum_of(row, q)
    if body >= 0:
        x = wp.transform_point(wp.transform_inverse(bodies.q[body]), x)
    return x


@wp.kernel(enable_backward=False)
def find_nearest(shapes: Shapes, q: wp.array[wp.vec3], bodies: Bodies, records: Records):
    """Find the nearest soft triangle of each vertex of a mesh, and how far the nearest edge of each soft edge is."""
    c = wp.tid()
    if c >= wp.min(records.count[0], records.features.shape[0]):
        return
    feature = records.features[c]
    rival = rival_of(feature, records.vertices)
    if rival >= 0:
        x = soft_point(place_of_record(c, records), shapes.body[records.shape[c]], q, bodies)
        wp.atomic_min(records.nearest, rival, code_of(wp.length(x - records.body_pos[c]), feature[1]))


# --- rows ------------------------------------------------------------------------------------------------------------


@wp.func
def attachment_row(a: int, attachments: Attachments):
    row = no_row()
    row.nodes[0] = attachments.particle[a]
    row.weights = wp.vec4(1.0, 0.0, 0.0, 0.0)
    row.measure = 1.0
    row.body = attachments.body[a]
    row.point = attachments.body_point[a]
    row.stiffness = attachments.stiffness[a]
    row.damping = attachments.damping[a]
    return row


@wp.kernel(enable_backward=False)
def fill_rows(
    # In
    contacts: int,
    law: ContactLaw,
    records: Records,
    shapes: Shapes,
    attachments: Attachments,
    particles: Particles,
    bodies: Bodies,
    # In and out
    memory: Memory,
    load: wp.array[wp.float32],
    # Out
    rows: wp.array[Row],
):
    """Rows of so many records, and then of attachments. If there are more contacts than records, the worlds of the
    missing ones are unknown, so none is stepped.

    Args:
        load: In how many rows particles are, as ``bodies.places``, zero before.
    """
    c = wp.tid()
    row = no_row()
    if c >= contacts:
        if attachments.enabled[c - contacts]:
            row = attachment_row(c - contacts, attachments)
            add_load(row, 1.0, load)
            wp.atomic_add(bodies.places, row.body, 1.0)
        rows[c] = row
        return
    if c == 0 and records.count[0] > contacts:
        for w in range(particles.trouble.shape[0]):
            wp.atomic_max(particles.trouble, w, TOO_MANY_CONTACTS)
    if c < records.count[0]:
        found = place_of_record(c, records)
        shape = records.shape[c]
        body = shapes.body[shape]
        is_one = found.measure > 0.0 and has_active(found, particles.flags)
        if is_one and records.features.shape[0] > 0:
            is_one = counts(c, soft_point(found, body, particles.q, bodies), records, shapes)
        if is_one:
            row = found
            row.body = body
            add_load(row, 1.0, load)
            if body >= 0:
                wp.atomic_add(bodies.places, body, row.measure)
            row.point = records.body_pos[c]
            row.velocity = records.body_vel[c]
            row.normal = records.normal[c]
            for k in range(3):
                if row.nodes[k] >= 0:
                    row.offset = wp.max(row.offset, particles.radius[row.nodes[k]])
            if shapes.margin.shape[0] > 0:
                row.offset += shapes.margin[shape]
            row.stiffness = 0.5 * (law.stiffness + shapes.material_ke[shape])
            row.damping = 0.5 * (law.damping + shapes.material_kd[shape])
            row.slope = 0.5 * (law.slope + shapes.material_kf[shape])
            row.friction = 0.5 * (law.friction + shapes.material_mu[shape])
            i = records.particle[c]
            if i >= 0:
                point, _arm = point_and_arm(row, bodies)
                depth = wp.max(-gap_of(row, particles.q[i] - point), 0.0)
                if memory.before[i] == NO_ROW:
                    row.ease = depth
                elif memory.before[i] > 0.0:
                    row.ease = wp.clamp(memory.before[i] - memory.eased, 0.0, depth)
                wp.atomic_max(memory.after, i, row.ease)
    rows[c] = row


@wp.kernel(enable_backward=False)
def sum_by_shape(
    # In
    count: wp.array[wp.int32],
    contact_shape: wp.array[wp.int32],
    first: int,
    wrenches: wp.array[wp.spatial_vector],
    # Out
    of_shapes: wp.array[wp.spatial_vector],
):
    """Add the wrenches of contacts, which begin at ``first``, to those of their shapes [N, N m]."""
    c = wp.tid()
    if c < wp.min(count[0], contact_shape.shape[0]):
        wp.atomic_add(of_shapes, contact_shape[c], wrenches[first + c])
