"""How free pieces of a model turn in an implicit step; see ``kernels.implicit.turning``.

A piece is all particles that tetrahedra connect. It is turned about its centre of mass, as it will turn in the step.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.implicit.turning import COLUMNS, Sums, motion_of
from warp_corot.kernels.stepping.balance import sum_of_lanes

from .particles import ACTIVE

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def sum_motion(
    # In
    first: wp.array[wp.int32],
    members: wp.array[wp.int32],
    inverse_mass: wp.array[wp.float32],
    flags: wp.array[wp.int32],
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    threads: int,
    lanes: int,
    # Out
    parts: wp.array3d[wp.float64],
):
    """Find parts of the sums of each piece, whose particles begin at ``first`` among the members."""
    piece, thread = wp.tid()
    total = Sums()
    k = first[piece] + thread
    while k < first[piece + 1]:
        i = members[k]
        if inverse_mass[i] > 0.0 and (flags[i] & ACTIVE) != 0:
            total += motion_of(wp.float64(1.0) / wp.float64(inverse_mass[i]), False, wp.vec3d(q[i]), wp.vec3d(qd[i]))
        else:
            total += motion_of(wp.float64(0.0), True, wp.vec3d(), wp.vec3d())
        k += threads
    for column in range(COLUMNS):
        part = sum_of_lanes(total[column])
        if thread % lanes == 0:
            parts[piece, thread / lanes, column] = part


@wp.kernel(enable_backward=False)
def turn_particles(
    # In
    piece_of: wp.array[wp.int32],
    q: wp.array[wp.vec3],
    centres: wp.array[wp.vec3],
    turns: wp.array[wp.mat33],
    entry: wp.array[wp.int32],
    # In and out
    x: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    # Out
    turned: wp.array[wp.vec3],
    way: wp.array[wp.vec4],
):
    """Find the turned positions and the way to them; gathered positions are turned in the arrays that are not empty."""
    i = wp.tid()
    at = q[i]
    d = wp.vec3()
    piece = piece_of[i]
    if piece >= 0:
        d = turns[piece] * (at - centres[piece])
        if x.shape[0] > 0:
            store_node(x, i, at + d)
        if u.shape[0] > 0:
            store_node(u, i, load_node(u, i) + d)
    turned[i] = at + d
    store_node(way, entry[i], d)
