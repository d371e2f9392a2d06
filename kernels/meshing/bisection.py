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
