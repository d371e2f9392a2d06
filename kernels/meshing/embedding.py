"""Points bound to the nodes of a mesh: their motion, their normals, and the elements that contain them."""

import warp as wp

from warp_corot.kernels.modules import unique_kernel

from .bisection import in_child, refinement_end
from .growth import VOID

wp.set_module_options({"enable_backward": False})


@unique_kernel()
def move_points(
    # In
    rest: wp.array[wp.vec3],
    nodes: wp.array[wp.vec4i],
    weights: wp.array[wp.vec4],
    displacements: wp.array[wp.vec3],
    # Out
    positions: wp.array[wp.vec3],
):
    """Rest position plus the weighted displacements of four nodes: exact at rest."""
    i = wp.tid()
    u = wp.vec3(0.0)
    for n in range(4):
        u += weights[i][n] * displacements[nodes[i][n]]
    positions[i] = rest[i] + u


@unique_kernel()
def add_triangle_normals(
    # In
    positions: wp.array[wp.vec3],
    triangles: wp.array[wp.vec3i],
    # Out
    normals: wp.array[wp.vec3],
):
    """Add each triangle's normal, times twice its area, at its corners."""
    tri = triangles[wp.tid()]
    p = positions[tri[0]]
    normal = wp.cross(positions[tri[1]] - p, positions[tri[2]] - p)
    for n in range(3):
        wp.atomic_add(normals, tri[n], normal)


@unique_kernel()
def normalize_all(
    # In and out
    normals: wp.array[wp.vec3],
):
    i = wp.tid()
    size = wp.max(wp.max(wp.abs(normals[i])), 1.0e-37)
    normals[i] = wp.normalize(normals[i] / size)


@wp.kernel(enable_backward=False)
def descend(
    # In
    roots: wp.array[wp.int32],
    weights: wp.array[wp.vec4d],
    level: wp.array[wp.int32],
    first_child: wp.array[wp.int32],
    # Out
    leaves: wp.array[wp.int32],
):
    """The live leaf that contains a point, -1 for none, found from the root that does, by barycentric coordinates."""
    i = wp.tid()
    element = roots[i]
    w = weights[i]
    while first_child[element] >= 0:
        k = refinement_end(level[element])
        second = w[0] < w[k]
        element = first_child[element] + wp.where(second, 1, 0)
        w = in_child(w, k, second)
    leaves[i] = wp.where(first_child[element] == VOID, -1, element)


@unique_kernel()
def find_holders(
    # In
    tree: wp.uint64,
    points: wp.array[wp.vec3d],
    corners: wp.array[wp.vec3d],
    inverses: wp.array[wp.mat33d],
    # Out
    holders: wp.array[wp.int32],
):
    """The tetrahedron that contains a point, -1 for none; of several, the one in which it is deepest."""
    i = wp.tid()
    p = points[i]
    at = wp.vec3(float(p[0]), float(p[1]), float(p[2]))
    query = wp.bvh_query_aabb(tree, at, at)
    best = wp.float64(-1.0e-9)
    holder = int(-1)
    candidate = int(0)
    while wp.bvh_query_next(query, candidate):
        w = inverses[candidate] * (p - corners[candidate])
        least = wp.min(wp.min(w), wp.float64(1.0) - w[0] - w[1] - w[2])
        if least > best:
            best = least
            holder = candidate
    holders[i] = holder
