"""Maubach's rule: how a tetrahedron (x0, x1, x2, x3) is bisected, and its children (Maubach 1995).

Every kernel that bisects, merges or descends a tree uses these functions; ``mesh.bisection`` is the host's version.
"""

import warp as wp


@wp.func
def refinement_end(level: int):
    """The index k of the refinement edge x0-xk, which is also the index of the midpoint in both children."""
    return 3 - level % 3


@wp.func
def first_half(x: wp.vec4i, z: int, level: int):
    """The first child of a tetrahedron bisected at z."""
    child = wp.vec4i(x[0], x[1], x[2], z)
    if level % 3 == 1:
        child = wp.vec4i(x[0], x[1], z, x[3])
    elif level % 3 == 2:
        child = wp.vec4i(x[0], z, x[2], x[3])
    return child


@wp.func
def second_half(x: wp.vec4i, z: int, level: int):
    """The second child of a tetrahedron bisected at z."""
    child = wp.vec4i(x[1], x[2], x[3], z)
    if level % 3 == 1:
        child = wp.vec4i(x[1], x[2], z, x[3])
    elif level % 3 == 2:
        child = wp.vec4i(x[1], z, x[2], x[3])
    return child


@wp.func
def halfway(p: wp.vec3i, q: wp.vec3i):
    """The lattice point halfway between two."""
    # Half the difference, because the sum of two numbers may overflow.
    return wp.vec3i(p[0] + (q[0] - p[0]) / 2, p[1] + (q[1] - p[1]) / 2, p[2] + (q[2] - p[2]) / 2)


@wp.func
def lattice_place(p: wp.vec3i, origin: wp.vec3d, spacing: wp.float64):
    """Where a lattice point is [m]."""
    return origin + spacing * wp.vec3d(wp.float64(p[0]), wp.float64(p[1]), wp.float64(p[2]))


@wp.func
def single(a: wp.vec3d):
    return wp.vec3(float(a[0]), float(a[1]), float(a[2]))


@wp.func
def in_child(w: wp.vec4d, k: int, second: bool):
    """Barycentric coordinates in a child from those in its parent, whose refinement edge is x0-xk.

    With z halfway between x0 and xk, a point is in the first child if its coordinate at x0 is the larger one: then z
    gets twice that at xk, and x0 the rest; in the second child the other way round.
    """
    lower = w[0]
    upper = w[k]
    child = w
    if second:
        for n in range(3):
            if n + 1 <= k:
                child[n] = w[n + 1]
        child[k - 1] = upper - lower
        child[k] = wp.float64(2.0) * lower
    else:
        child[0] = lower - upper
        child[k] = wp.float64(2.0) * upper
    return child
