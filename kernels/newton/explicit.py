"""Forces of rows in explicit steps, and rows of soft surfaces with one another, which only explicit steps have.

Forces on particles and bodies are opposite, so momentum is exchanged exactly. Damping and friction do not reverse a
relative velocity within a step, however light particle and body are: the part of the law that would do so is left out.
A body that is touched in n places counts in each as a piece of 1/n of its mass and inertia, which bounds their total
effect; particles in many contacts likewise, see ``rows``.

Springs may be far too stiff for explicit steps of light particles and bodies. So a spring k acts where its ends would
yield to it: its energy V becomes its Moreau envelope in the metric of their masses,

    V'(x) = min over d of V(x + d) + d . M d / (2 a dt^2),

with these pieces' masses M and a = ``YIELDS``. The spring only becomes softer, 1/k' = 1/k + a dt^2 w with the inverse
mass w of its ends. V' is an energy, so contact adds none; M^-1 times the curvature of all springs together is at most
1/(a dt^2), whatever their number and stiffness. At rest a spring carries the same force, deeper by a dt^2 w times it.

Contact of soft surfaces with one another: vertices with triangles and edges with edges, as Newton's detector lists
them.

A vertex at the distance d from a triangle has the energy k (margin - d)^2 / 2 while d < margin. It is a function of
positions only, and so adds no energy. Edges that are closest at their ends repeat this: their force is multiplied by a
measure from 0 there to 1 in the middle. Surfaces of tetrahedra have an inside: there d becomes negative if the vertex
or edge belongs to another body, so that what has sunk in is pushed out. Cloth has two sides. In loads, see ``rows``, a
pair that touches counts twice, because its two sides may move against one another. What is closer at
first than the margin has this distance as its margin, so that nothing starts with a push: between bodies no less than
a fraction of the margin, to keep cloth apart.
"""

import warp as wp

from warp_corot.kernels.contact.law import across, held_back
from warp_corot.kernels.contact.shapes import on_triangle

from .particles import TOO_MANY_PAIRS, Bodies, Particles, is_fixed, mark
from .rows import (
    ContactLaw,
    Row,
    add_load,
    add_to_particles,
    ease_off,
    gap_of,
    inverse_mass_of,
    is_attachment,
    no_row,
    point_and_arm,
    pull_of,
    sum_of,
)

wp.set_module_options({"enable_backward": False})

#: See above. Elasticity at its largest stable step with its margin leaves room for this curvature.
YIELDS = wp.constant(1.5)
#: If only a body yields to a spring, this fraction of the strongest damper acts, too: explicit steps return up to a
#: quarter more energy than they took from a contact that lasts only a few of them.
LOSS = wp.constant(0.5)
#: More than any damping.
NO_LIMIT = wp.constant(1.0e30)


@wp.struct
class Mobility:
    """Response of a particle, and of a body's piece at a contact."""

    particle: float  # 1/m [1/kg]
    linear: float  # 1/m of the body's piece [1/kg]
    angular: wp.mat33  # inverse inertia of the piece in world axes [1/(kg m^2)]
    arm: wp.vec3  # from the body's centre of mass [m]


@wp.func
def body_point_velocity(twist: wp.spatial_vector, arm: wp.vec3):
    """Velocity of a point of a body, at ``arm`` from its centre of mass."""
    return wp.spatial_top(twist) + wp.cross(wp.spatial_bottom(twist), arm)


@wp.func
def body_mobility(m: Mobility, direction: wp.vec3):
    """Inverse mass of the body's piece at the contact along a unit vector [1/kg]."""
    a = wp.cross(m.arm, direction)
    return m.linear + wp.dot(a, m.angular * a)


@wp.func
def largest_damping(w: float, dt: float):
    """The damping that stops a relative velocity within a step, for an inverse mass [kg/s]."""
    if w > 0.0:
        return 1.0 / (w * dt)
    return NO_LIMIT


@wp.func
def contact_force(row: Row, gap: float, v: wp.vec3, pull: wp.vec3, m: Mobility, dt: float):
    """Force on the particles [N]: spring and damper along the normal, regularised Coulomb friction across it.

    Args:
        v: Velocity of the particles relative to the body's point.
        pull: Change of this velocity by all other forces in this step [m/s].
    """
    n = row.normal
    towards = wp.dot(n, v)
    w = m.particle + body_mobility(m, n)
    soft = YIELDS * row.stiffness * dt * dt
    push = -row.stiffness * gap / (1.0 + soft * w)
    if gap < 0.0 and towards < 0.0:
        largest = largest_damping(w, dt)
        yielded = soft * (w - m.particle) / (1.0 + soft * w)
        push -= wp.min(row.damping + LOSS * yielded * largest, largest) * towards
    # Implicit in the velocity that there would be without friction. With the current velocity, a force on a light
    # particle would move it by one step's change of velocity in every step, however strong the friction.
    sliding = across(v + pull, n)
    speed = wp.length(sliding)
    force = push * n
    if speed > 0.0 and row.slope > 0.0:
        # The larger inverse mass is at least half of the sum, so that no velocity turns round with more speed.
        w = wp.max(m.particle, body_mobility(m, sliding / speed))
        drag = sliding / (1.0 / row.slope + w * dt)
        force -= held_back(drag, wp.max(push, 0.0), row.friction)
    return row.measure * force


@wp.func
def attachment_force(row: Row, apart: wp.vec3, v: wp.vec3, m: Mobility, dt: float):
    """Force on the particle [N]: a spring and a damper."""
    arm = wp.skew(m.arm)
    w = (m.particle + m.linear) * wp.identity(3, dtype=wp.float32) + arm * m.angular * wp.transpose(arm)
    # The sum over three directions exceeds any single one.
    damping = wp.min(row.damping, largest_damping(wp.trace(w), dt))
    soft = wp.identity(3, dtype=wp.float32) + (YIELDS * row.stiffness * dt * dt) * w
    return -row.stiffness * (wp.inverse(soft) * apart) - damping * v


@wp.kernel(enable_backward=False)
def scatter_rows(
    # In
    dt: float,
    share: float,
    law: ContactLaw,
    contacts: int,
    first: int,
    rows: wp.array[Row],
    load: wp.array[wp.float32],
    particles: Particles,
    bodies: Bodies,
    before: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
    body_f: wp.array[wp.spatial_vector],
    reported: wp.array[wp.spatial_vector],
):
    """Forces on particles, and wrenches on bodies about their centres of mass.

    Args:
        share: The substep's share of the step, for the mean wrench of each contact on its shape's body [N, N m], about
            the body's centre of mass or, for a fixed shape, the origin.
        contacts: Number of contacts; attachments follow.
        first: The entry of ``reported`` for the first contact; ``reported`` may be empty.
    """
    c = wp.tid()
    row = rows[c]
    if row.nodes[0] < 0:
        return
    ease_off(c, dt, law, rows)
    body = row.body
    point, arm = point_and_arm(row, bodies)
    velocity = row.velocity
    m = Mobility()
    m.arm = arm
    m.particle = inverse_mass_of(row, load, particles)
    if body >= 0:
        pose = bodies.q[body]
        velocity = wp.transform_vector(pose, velocity) + body_point_velocity(bodies.qd[body], arm)
        if not is_fixed(body, bodies):
            n = bodies.places[body]
            turn = wp.quat_to_matrix(wp.transform_get_rotation(pose))
            m.linear = n * bodies.inv_mass[body]
            m.angular = n * (turn * bodies.inv_inertia[body] * wp.transpose(turn))
    apart = sum_of(row, particles.q) - point
    v = sum_of(row, particles.qd) - velocity
    force = wp.vec3()
    if is_attachment(row):
        force = attachment_force(row, apart, v, m, dt)
    else:
        gap = gap_of(row, apart)
        if gap > law.adhesion:
            return
        force = contact_force(row, gap, v, pull_of(row, dt, particles, before), m, dt)
    add_to_particles(row, force, f)
    wrench = -wp.spatial_vector(force, wp.cross(arm, force))
    if body >= 0:
        wp.atomic_add(body_f, body, wrench)
    if c < contacts and reported.shape[0] > 0:
        reported[first + c] += share * wrench


# --- soft surfaces with one another ----------------------------------------------------------------------------------

#: A distance below which a direction is rounding [m].
COINCIDENT = wp.constant(1.0e-9)
#: Least margin between bodies, over the margin.
LEAST = wp.constant(0.25)
#: Weights of closest points inside a triangle are above this.
INSIDE = wp.constant(1.0e-6)


@wp.struct
class Surfaces:
    """Triangles and edges of a model."""

    triangles: wp.array2d[wp.int32]
    edges: wp.array2d[wp.int32]  # opposite vertices, then the edge's
    facing: wp.array[wp.float32]  # of each triangle: 1 if its normal points out of tetrahedra, -1 into them, 0 of cloth
    outward: wp.array[wp.vec2i]  # of each edge: its triangles on tetrahedra, or -1
    part: wp.array[wp.int32]  # of each particle: its connected body, or -1 if it is on no triangle
    rest: wp.array[wp.vec3]  # positions at first [m]


@wp.struct
class PairLists:
    """Newton's lists of pairs, with its names: a row for each vertex and for each edge."""

    margin: float  # distance at which surfaces begin to push one another [m]
    parallel: float  # sine of an angle below which two edges are parallel
    # Of each pair the vertex and the triangle, or both edges.
    vertex_colliding_triangles: wp.array[wp.int32]
    vertex_colliding_triangles_offsets: wp.array[wp.int32]
    vertex_colliding_triangles_count: wp.array[wp.int32]
    edge_colliding_edges: wp.array[wp.int32]
    edge_colliding_edges_offsets: wp.array[wp.int32]
    edge_colliding_edges_count: wp.array[wp.int32]


@wp.func
def outward_normal(surfaces: Surfaces, t: int, q: wp.array[wp.vec3]):
    """Normal of a triangle of tetrahedra, times twice its area."""
    a = q[surfaces.triangles[t, 0]]
    n = wp.cross(q[surfaces.triangles[t, 1]] - a, q[surfaces.triangles[t, 2]] - a)
    return surfaces.facing[t] * n


@wp.func
def margin_of(surfaces: Surfaces, i: int, j: int, margin: float, first: float):
    """The margin of a pair, with one particle of each side and the distance at first [m]."""
    least = wp.where(surfaces.part[i] != surfaces.part[j], LEAST * margin, 0.0)
    return wp.min(margin, wp.max(first, least))


@wp.func
def apart_from(v: int, n: wp.vec3i, x: wp.array[wp.vec3]):
    """The closest point of a triangle to a vertex, as weights, and the vertex from there."""
    w = on_triangle(x[v], x[n[0]], x[n[1]], x[n[2]])
    return w, x[v] - w[0] * x[n[0]] - w[1] * x[n[1]] - w[2] * x[n[2]]


@wp.func
def vertex_row(surfaces: Surfaces, v: int, t: int, margin: float, q: wp.array[wp.vec3]):
    """A vertex and a triangle."""
    row = no_row()
    n = wp.vec3i(surfaces.triangles[t, 0], surfaces.triangles[t, 1], surfaces.triangles[t, 2])
    if surfaces.part[v] < 0:
        return row
    w, apart = apart_from(v, n, q)
    distance = wp.length(apart)
    out = outward_normal(surfaces, t, q)
    sunk = bool(False)
    if surfaces.facing[t] != 0.0 and surfaces.part[v] != surfaces.part[n[0]]:
        sunk = wp.dot(apart, out) < 0.0
        if sunk and wp.min(w) < INSIDE:
            # Beside the triangle: another one faces the vertex.
            return row
    row.measure = 1.0
    row.nodes = wp.vec4i(v, n[0], n[1], n[2])
    row.weights = wp.vec4(1.0, -w[0], -w[1], -w[2])
    _w, first = apart_from(v, n, surfaces.rest)
    row.offset = margin_of(surfaces, v, n[0], margin, wp.length(first))
    row.normal = wp.normalize(out)
    if distance > COINCIDENT:
        row.normal = apart / distance
    if sunk:
        row.normal = -row.normal
    return row


@wp.func
def points_out(surfaces: Surfaces, e: int, direction: wp.vec3, q: wp.array[wp.vec3]):
    """1 or -1 if a direction points out of or into the tetrahedra at an edge; 0 if there are none."""
    sum = wp.vec3()
    for side in range(2):
        t = surfaces.outward[e][side]
        if t >= 0:
            sum += wp.normalize(outward_normal(surfaces, t, q))
    return wp.sign(wp.dot(sum, direction)) * wp.where(wp.length_sq(sum) > 0.0, 1.0, 0.0)


@wp.func
def edge_row(surfaces: Surfaces, e: int, other: int, margin: float, parallel: float, q: wp.array[wp.vec3]):
    """Two edges."""
    row = no_row()
    n = wp.vec4i(surfaces.edges[e, 2], surfaces.edges[e, 3], surfaces.edges[other, 2], surfaces.edges[other, 3])
    found = wp.closest_point_edge_edge(q[n[0]], q[n[1]], q[n[2]], q[n[3]], parallel)
    s = found[0]
    t = found[1]
    apart = q[n[0]] + s * (q[n[1]] - q[n[0]]) - q[n[2]] - t * (q[n[3]] - q[n[2]])
    distance = wp.length(apart)
    if distance < COINCIDENT:
        return row
    row.measure = 16.0 * s * (1.0 - s) * t * (1.0 - t)
    row.nodes = n
    row.weights = wp.vec4(1.0 - s, s, t - 1.0, -t)
    row.normal = apart / distance
    if surfaces.part[n[0]] != surfaces.part[n[2]]:
        one = points_out(surfaces, e, -row.normal, q)
        two = points_out(surfaces, other, row.normal, q)
        if one + two < 0.0 and one <= 0.0 and two <= 0.0:
            row.normal = -row.normal
    x = surfaces.rest
    first = wp.closest_point_edge_edge(x[n[0]], x[n[1]], x[n[2]], x[n[3]], parallel)[2]
    row.offset = margin_of(surfaces, n[0], n[2], margin, first)
    return row


@wp.func
def pair_count(starts: wp.array[wp.int32], counts: wp.array[wp.int32], n: int):
    """Number of pairs in row n of a list, and whether more were found than it has room for."""
    if n >= counts.shape[0]:
        return 0, False
    room = starts[n + 1] - starts[n]
    return wp.min(counts[n], room), counts[n] > room


@wp.func
def pair_counts(lists: PairLists, n: int):
    """The same of vertex n and of edge n."""
    of_vertex, lacks = pair_count(lists.vertex_colliding_triangles_offsets, lists.vertex_colliding_triangles_count, n)
    of_edge, lacks_edges = pair_count(lists.edge_colliding_edges_offsets, lists.edge_colliding_edges_count, n)
    return of_vertex, of_edge, lacks, lacks_edges


@wp.func
def listed_row(
    surfaces: Surfaces, lists: PairLists, law: ContactLaw, n: int, c: int, of_vertex: int, q: wp.array[wp.vec3]
):
    """The c-th pair of those of vertex n and then those of edge n, and its gap. Two edges are listed twice."""
    row = no_row()
    if c < of_vertex:
        t = lists.vertex_colliding_triangles[2 * (lists.vertex_colliding_triangles_offsets[n] + c) + 1]
        row = vertex_row(surfaces, n, t, lists.margin, q)
    else:
        other = lists.edge_colliding_edges[2 * (lists.edge_colliding_edges_offsets[n] + c - of_vertex) + 1]
        if n < other:
            row = edge_row(surfaces, n, other, lists.margin, lists.parallel, q)
    gap = float(1.0)
    if row.nodes[0] >= 0:
        gap = gap_of(row, sum_of(row, q))
    row.stiffness = law.stiffness
    row.damping = law.damping
    row.slope = law.slope
    row.friction = law.friction
    return row, gap


@wp.kernel(enable_backward=False)
def count_pair_loads(
    surfaces: Surfaces, lists: PairLists, law: ContactLaw, particles: Particles, load: wp.array[wp.float32]
):
    """Add twice the weights of all pairs that touch. A list that holds fewer pairs than were found marks the world."""
    n = wp.tid()
    of_vertex, of_edge, lacks, lacks_edges = pair_counts(lists, n)
    if lacks:
        mark(n, TOO_MANY_PAIRS, particles)
    if lacks_edges:
        mark(surfaces.edges[n, 2], TOO_MANY_PAIRS, particles)
    for c in range(of_vertex + of_edge):
        row, gap = listed_row(surfaces, lists, law, n, c, of_vertex, particles.q)
        if gap < 0.0:
            add_load(row, 2.0, load)


@wp.kernel(enable_backward=False)
def scatter_pairs(
    # In
    surfaces: Surfaces,
    lists: PairLists,
    law: ContactLaw,
    dt: float,
    load: wp.array[wp.float32],
    particles: Particles,
    before: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Forces of all pairs."""
    n = wp.tid()
    of_vertex, of_edge, _lacks, _lacks_edges = pair_counts(lists, n)
    for c in range(of_vertex + of_edge):
        row, gap = listed_row(surfaces, lists, law, n, c, of_vertex, particles.q)
        if gap < 0.0:
            m = Mobility()
            m.particle = inverse_mass_of(row, load, particles)
            pull = pull_of(row, dt, particles, before)
            add_to_particles(row, contact_force(row, gap, sum_of(row, particles.qd), pull, m, dt), f)
