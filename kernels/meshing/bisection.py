"""Maubach's rule: where a tetrahedron (x0, x1, x2, x3) is bisected and what its children are (Maubach 1995).

Everything on the device that bisects, merges or walks down a tree goes by these; ``mesh.bisection`` is the host's.
"""

import warp as wp


@wp.func
def refinement_end(level: int):
    """k of the refinement edge x0-xk, which is also where the midpoint stands in both children."""
    return 3 - level % 3


@wp.func
def first_half(x: wp.vec4i, z: int, level: int):
    """The first child of a tetrahedron that is bisected at z."""
    child = wp.vec4i(x[0], x[1], x[2], z)
    if level % 3 == 1:
        child = wp.vec4i(x[0], x[1], z, x[3])
    elif level % 3 == 2:
        child = wp.vec4i(x[0], z, x[2], x[3])
    return child


@wp.func
def second_half(x: wp.vec4i, z: int, level: int):
    """The second child of a tetrahedron that is bisected at z."""
    child = wp.vec4i(x[1], x[2], x[3], z)
    if level % 3 == 1:
        child = wp.vec4i(x[1], x[2], z, x[3])
    elif level % 3 == 2:
        child = wp.vec4i(x[1], z, x[2], x[3])
    return child


@wp.func
def halfway(p: wp.vec3i, q: wp.vec3i):
    """The lattice point in the middle of two."""
    # Half the difference, as the sum of two numbers may not fit.
    return wp.vec3i(p[0] + (q[0] - p[0]) / 2, p[1] + (q[1] - p[1]) / 2, p[2] + (q[2] - p[2]) / 2)
