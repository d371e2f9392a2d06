"""Increments of an implicit step from linear solves, and the turn of a free body at which a step is linearised.

A linearisation at the beginning of the step takes a turn by an angle a for a stretch of a^2 / 2. So the state is turned
first as the body turns as a whole. Then strains are the same, and forces have the directions of the end of the step.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.sums import Sums, add_up, store_sum

from .conjugate_gradients import BROKEN, CONVERGED, LIMIT

wp.set_module_options({"enable_backward": False})


#: Columns of sizes: the largest change of an increment, and the largest displacement [m].
CHANGE, REACH = (wp.constant(k) for k in range(2))
COLUMNS = 2


@wp.kernel(enable_backward=False)
def take_free(
    inverse_mass: wp.array[wp.float32],
    share: wp.array[wp.float32],
    increment: wp.array[wp.vec4],
    d: wp.array[wp.vec4],
):
    """d = the whole motion at free nodes, of which the increment is a share, and zero at the others."""
    i = wp.tid()
    free = wp.vec3()
    if inverse_mass[i] > 0.0:
        free = load_node(increment, i) / share[0]
    store_node(d, i, free)


@wp.kernel(enable_backward=False)
def move_held(
    # In
    inverse_mass: wp.array[wp.float32],
    base: wp.array[wp.vec4],
    share: wp.array[wp.float32],
    to_end: int,
    # In and out
    increment: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
):
    """Move held nodes from the stage to the end of the step, or back."""
    i = wp.tid()
    if inverse_mass[i] == 0.0:
        factor = share[0]
        if to_end != 0:
            factor = 1.0 / share[0]
        moved = factor * load_node(increment, i)
        store_node(increment, i, moved)
        store_node(u, i, load_node(base, i) + moved)


@wp.kernel(enable_backward=False)
def take_increments(
    # In
    count: int,
    inverse_mass: wp.array[wp.float32],
    base: wp.array[wp.vec4],
    share: wp.array[wp.float32],
    d: wp.array[wp.vec4],
    # In and out
    increment: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
    sizes: wp.array2d[wp.float32],
):
    """Take a share of d as the increment of free nodes, and find the largest change and displacement of each world; all
    are one if ``sizes`` has one row."""
    i = wp.tid()
    if inverse_mass[i] > 0.0:
        after = share[0] * load_node(d, i)
        place = load_node(base, i) + after
        if sizes.shape[0] > 0:
            world = wp.min(i / count, sizes.shape[0] - 1)
            wp.atomic_max(sizes, world, CHANGE, wp.length(after - load_node(increment, i)))
            wp.atomic_max(sizes, world, REACH, wp.length(place))
        store_node(increment, i, after)
        store_node(u, i, place)


@wp.kernel(enable_backward=False)
def judge_increments(
    # In
    sizes: wp.array2d[wp.float32],
    linear: wp.array[wp.int32],
    solved: wp.array[wp.int32],
    tolerance: float,
    most: int,
    # In and out
    iterations: wp.array[wp.int32],
    total: wp.array[wp.int32],
    # Out
    status: wp.array[wp.int32],
    going: wp.array[wp.int32],
):
    """Count a linearisation; another one follows if increments of a world still change."""
    world = wp.tid()
    total[world] = total[world] + linear[world]
    iterations[world] = iterations[world] + 1
    status[world] = CONVERGED
    if solved[world] == BROKEN:
        status[world] = BROKEN
    elif solved[world] == LIMIT:
        status[world] = LIMIT
    if status[world] != BROKEN and sizes[world, CHANGE] > tolerance * sizes[world, REACH]:
        status[world] = LIMIT
        if iterations[world] < most:
            going[0] = 1


#: The sums: mass, the number of held nodes, and from here on moments of mass, momenta and squares.
MASS, HELD, FIRST, MOMENTUM, SPIN, SQUARES = (wp.constant(k) for k in (0, 1, 2, 5, 8, 11))
MOTION_COLUMNS = 17
Motion = wp.types.vector(length=MOTION_COLUMNS, dtype=wp.float64)
#: A smaller turn is left out: its square is within the rounding of strains [rad].
LEAST = wp.constant(wp.float64(1.0e-3))


@wp.func
def motion_of(m: wp.float64, is_held: bool, x: wp.vec3d, v: wp.vec3d):
    """A node's share of the sums."""
    one = Motion()
    spin = wp.cross(x, v)
    one[MASS] = m
    if is_held:
        one[HELD] = wp.float64(1.0)
    for axis in range(3):
        after = (axis + 1) % 3
        one[FIRST + axis] = m * x[axis]
        one[MOMENTUM + axis] = m * v[axis]
        one[SPIN + axis] = m * spin[axis]
        one[SQUARES + axis] = m * x[axis] * x[axis]
        one[SQUARES + 3 + axis] = m * x[axis] * x[after]
    return one


@wp.kernel(enable_backward=False)
def sum_motion(
    sums: Sums,
    mass: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
):
    """Find parts of the sums of each world."""
    world, thread = wp.tid()
    total = Motion()
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        if mass[i] > 0.0:
            x = wp.vec3d(load_node(rest, i)) + wp.vec3d(load_node(u, i))
            total += motion_of(wp.float64(mass[i]), inverse_mass[i] == 0.0, x, wp.vec3d(load_node(v, i)))
    for column in range(MOTION_COLUMNS):
        store_sum(sums, world, thread, column, total[column])


@wp.func
def skew(w: wp.vec3d):
    zero = wp.float64(0.0)
    return wp.mat33d(zero, -w[2], w[1], w[2], zero, -w[0], -w[1], w[0], zero)


@wp.kernel(enable_backward=False)
def find_turns(
    # In
    sums: Sums,
    dt: wp.float64,
    # Out
    centres: wp.array[wp.vec3],
    turns: wp.array[wp.mat33],
    any_turns: wp.array[wp.int32],
):
    """Find the rotation Q - 1 of each world's body about its centre of mass in a step of backward Euler: that of
    1 + dt [w] with the angular velocity w, by atan(dt |w|). It is zero for bodies with held nodes.
    """
    world, lane = wp.tid()
    motion = Motion()
    for column in range(MOTION_COLUMNS):
        motion[column] = add_up(sums, world, lane, column)
    if lane > 0:
        return
    centres[world] = wp.vec3()
    turns[world] = wp.mat33()
    m = motion[MASS]
    if not m > wp.float64(0.0) or motion[HELD] > wp.float64(0.0):
        return
    first = wp.vec3d(motion[FIRST], motion[FIRST + 1], motion[FIRST + 2])
    momentum = wp.vec3d(motion[MOMENTUM], motion[MOMENTUM + 1], motion[MOMENTUM + 2])
    c = first / m
    spin = wp.vec3d(motion[SPIN], motion[SPIN + 1], motion[SPIN + 2]) - wp.cross(c, momentum)
    xx = motion[SQUARES] - first[0] * c[0]
    yy = motion[SQUARES + 1] - first[1] * c[1]
    zz = motion[SQUARES + 2] - first[2] * c[2]
    xy = motion[SQUARES + 3] - first[0] * c[1]
    yz = motion[SQUARES + 4] - first[1] * c[2]
    zx = motion[SQUARES + 5] - first[2] * c[0]
    w = dt * (wp.inverse(wp.mat33d(yy + zz, -xy, -zx, -xy, zz + xx, -yz, -zx, -yz, xx + yy)) * spin)
    square = wp.dot(w, w)
    # False if it is not finite.
    if square > LEAST * LEAST and square < wp.float64(1.0e12):
        s = wp.sqrt(wp.float64(1.0) + square)
        k = skew(w)
        turns[world] = wp.mat33(k / s + (k * k) / (s * (s + wp.float64(1.0))))
        centres[world] = wp.vec3(c)
        any_turns[0] = 1


@wp.kernel(enable_backward=False)
def turn_nodes(
    # In
    count: int,
    rest: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
    centres: wp.array[wp.vec3],
    turns: wp.array[wp.mat33],
    # Out
    turned: wp.array[wp.vec4],
    way: wp.array[wp.vec4],
):
    """Find the turned displacements, and the way to them."""
    i = wp.tid()
    world = i / count
    place = load_node(u, i)
    d = turns[world] * (load_node(rest, i) + place - centres[world])
    store_node(turned, i, place + d)
    store_node(way, i, d)
