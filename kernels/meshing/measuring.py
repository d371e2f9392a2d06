"""Measurements of surfaces: distances of points to one, and parts of it that cross each other."""

import warp as wp

from warp_corot.kernels.modules import unique_kernel

# Warp would unroll loops of up to 16 rounds, and compile each round's search by itself.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

#: Maximum number of triangles of its own part that an edge can pass.
MOST_OWN_HITS = wp.constant(8)
#: Fraction of an edge's length that is left out at its ends, where its own triangles begin.
ENDS = wp.constant(1.0e-4)


@wp.kernel(enable_backward=False)
def find_nearest(
    # In
    points: wp.array[wp.vec3],
    mesh: wp.uint64,
    far: float,
    # Out
    faces: wp.array[wp.int32],
    distances: wp.array[wp.float32],
):
    """The triangle closest to each point and its distance; -1 and ``far`` if none is closer than that."""
    i = wp.tid()
    found = wp.mesh_query_point_no_sign(mesh, points[i], far)
    faces[i] = wp.where(found.result, found.face, -1)
    distances[i] = far
    if found.result:
        distances[i] = wp.length(wp.mesh_eval_position(mesh, found.face, found.u, found.v) - points[i])


@unique_kernel()
def find_crossed_parts(
    # In
    points: wp.array[wp.vec3],
    edges: wp.array[wp.vec2i],
    edge_parts: wp.array[wp.int32],
    mesh: wp.uint64,
    triangle_parts: wp.array[wp.int32],
    # Out
    crossed: wp.array[wp.int32],
):
    """Another part with a triangle that an edge crosses, -1 for none."""
    i = wp.tid()
    start = points[edges[i][0]]
    along = points[edges[i][1]] - start
    length = wp.length(along)
    crossed[i] = -1
    if length == 0.0:
        return
    direction = along / length
    at = ENDS * length
    end = (1.0 - ENDS) * length
    for _ in range(MOST_OWN_HITS):
        if at >= end or crossed[i] >= 0:
            return
        found = wp.mesh_query_ray(mesh, start + at * direction, direction, end - at)
        if not found.result:
            return
        if triangle_parts[found.face] != edge_parts[i]:
            crossed[i] = triangle_parts[found.face]
        at += found.t + ENDS * length
