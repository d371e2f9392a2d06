"""Where elements are cut by a surface that is known only at their corners."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def find_surface_points(
    # In
    tets: wp.array[wp.vec4i],
    lattice: wp.array[wp.vec3i],
    phi: wp.array[wp.float32],
    origin: wp.vec3d,
    spacing: wp.float64,
    # Out
    points: wp.array[wp.vec3d],
    inward: wp.array[wp.vec3d],
):
    """A point where the linear interpolant is zero, or nearly, and the unit vector inwards there.

    The search goes from the middle along the gradient, but no farther than the longest edge at the first corner.
    """
    i = wp.tid()
    tet = tets[i]
    corner = lattice[tet[0]]
    value = wp.float64(phi[tet[0]])
    edges = wp.mat33d()
    rises = wp.vec3d()
    middle = wp.vec3d()
    mean = value
    longest = wp.float64(0.0)
    for n in range(3):
        apart = lattice[tet[n + 1]] - corner
        edge = spacing * wp.vec3d(wp.float64(apart[0]), wp.float64(apart[1]), wp.float64(apart[2]))
        edges[n] = edge
        other = wp.float64(phi[tet[n + 1]])
        rises[n] = other - value
        middle += edge
        mean += other
        longest = wp.max(longest, wp.length(edge))
    quarter = wp.float64(0.25)
    gradient = wp.inverse(edges) * rises
    slope = wp.length(gradient)
    along = -gradient / wp.max(slope, wp.float64(1.0e-30))
    step = wp.float64(0.0)
    if slope > wp.float64(0.0):
        step = wp.clamp(quarter * mean / slope, -longest, longest)
    start = spacing * wp.vec3d(wp.float64(corner[0]), wp.float64(corner[1]), wp.float64(corner[2]))
    points[i] = origin + start + quarter * middle + step * along
    inward[i] = along
