"""The records of contacts with triangle meshes that count.

For a mesh, Newton records every pair of a particle and a triangle, of a soft triangle and a vertex, and of two edges
within the gap. Many of these repeat each other, and some are across the shape: a particle just below one face is deep
below the others. So a particle counts for the nearest triangle only, and a vertex for the nearest soft triangle only. A
soft edge that is inside counts for the edge that is nearest to it and for those up to ``DEEPER`` times as far away.
"""

import warp as wp

from .touching import point_of

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
class Shapes:
    """Shapes of a Newton model."""

    body: wp.array[wp.int32]
    pose: wp.array[wp.transform]  # in its body's frame
    scale: wp.array[wp.vec3]
    mesh: wp.array[wp.uint64]


@wp.struct
class Records:
    """Newton's records of contacts, and its features of meshes: kind, soft feature and mesh feature; -1 for others."""

    count: wp.array[wp.int32]
    particle: wp.array[wp.int32]
    nodes: wp.array[wp.vec3i]
    weights: wp.array[wp.vec3]
    features: wp.array[wp.vec3i]
    shape: wp.array[wp.int32]
    place: wp.array[wp.vec3]  # on the shape, in its body's frame


@wp.func
def soft_point(c: int, records: Records, shapes: Shapes, q: wp.array[wp.vec3], body_q: wp.array[wp.transform]):
    """The point of the soft surface of record c, in its shape's body's frame."""
    p = point_of(c, records.particle, records.nodes, records.weights)
    x = p.weights[0] * q[p.nodes[0]]
    for k in range(1, 3):
        if p.nodes[k] >= 0:
            x += p.weights[k] * q[p.nodes[k]]
    body = shapes.body[records.shape[c]]
    if body >= 0:
        x = wp.transform_point(wp.transform_inverse(body_q[body]), x)
    return x


@wp.func
def is_of_nearest_triangle(c: int, x: wp.vec3, records: Records, shapes: Shapes):
    """Whether no triangle is nearer to the soft point x, in the frame of its shape's body, than that of record c."""
    shape = records.shape[c]
    scale = shapes.scale[shape]
    y = wp.cw_div(wp.transform_point(wp.transform_inverse(shapes.pose[shape]), x), scale)
    least = wp.min(wp.min(wp.abs(scale[0]), wp.abs(scale[1])), wp.abs(scale[2]))
    reach = (wp.length(x - records.place[c]) * (1.0 + NEARLY) + TINY) / least
    found = wp.mesh_query_point_no_sign(shapes.mesh[shape], y, reach)
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
def counts(c: int, x: wp.vec3, vertices: int, records: Records, shapes: Shapes, nearest: wp.array[wp.int64]):
    """Whether record c counts, with the soft point x in the frame of its shape's body."""
    feature = records.features[c]
    if (feature[0] & UNKNOWN) != 0:
        return False
    if (feature[0] & FAMILY) == OF_PARTICLE:
        return is_of_nearest_triangle(c, x, records, shapes)
    rival = rival_of(feature, vertices)
    if rival < 0:
        return True
    away = wp.length(x - records.place[c])
    if (feature[0] & FAMILY) == OF_VERTEX:
        return nearest[rival] == code_of(away, feature[1])
    return away <= DEEPER * GRAIN * float(nearest[rival] / NUMBERS) + TINY


@wp.kernel(enable_backward=False)
def clear_nearest(nearest: wp.array[wp.int64]):
    nearest[wp.tid()] = FAR


@wp.kernel(enable_backward=False)
def find_nearest(
    # In
    vertices: int,
    records: Records,
    shapes: Shapes,
    q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    # In and out
    nearest: wp.array[wp.int64],
):
    """Find the nearest soft triangle of each vertex of a mesh, and how far the nearest edge of each soft edge is."""
    c = wp.tid()
    if c >= wp.min(records.count[0], records.features.shape[0]):
        return
    feature = records.features[c]
    rival = rival_of(feature, vertices)
    if rival >= 0:
        away = wp.length(soft_point(c, records, shapes, q, body_q) - records.place[c])
        wp.atomic_min(nearest, rival, code_of(away, feature[1]))


@wp.kernel(enable_backward=False)
def choose_records(
    # In
    vertices: int,
    records: Records,
    shapes: Shapes,
    q: wp.array[wp.vec3],
    body_q: wp.array[wp.transform],
    nearest: wp.array[wp.int64],
    # Out
    particle: wp.array[wp.int32],
    nodes: wp.array[wp.vec3i],
    weights: wp.array[wp.vec3],
):
    """Copy the records. Those that do not count become records at the end of an edge, which have no force."""
    c = wp.tid()
    if c >= wp.min(records.count[0], records.features.shape[0]):
        return
    particle[c] = records.particle[c]
    nodes[c] = records.nodes[c]
    weights[c] = records.weights[c]
    if records.features[c][0] < 0:
        return
    x = soft_point(c, records, shapes, q, body_q)
    if not counts(c, x, vertices, records, shapes, nearest):
        i = records.particle[c]
        if i < 0:
            i = records.nodes[c][0]
        particle[c] = -1
        nodes[c] = wp.vec3i(i, i, -1)
        weights[c] = wp.vec3(1.0, 0.0, 0.0)
