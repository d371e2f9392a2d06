"""Preconditioned conjugate gradients, the iterations of all worlds side by side: vectors vec4, scalars float64."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.balance import sum_of_lanes

from .sums import add_up, dot64

wp.set_module_options({"enable_backward": False})

#: Columns of parts of sums: r . r, r . z and p . q.
SQUARE, PRODUCT, CURVATURE = (wp.constant(k) for k in range(3))
COLUMNS = 3
#: Places in the scalars of a world: r . z, the factors alpha and beta, and r . r now, at first and at the end.
RZ, ALPHA, BETA, RR, FIRST, END = (wp.constant(k) for k in range(6))
SCALARS = 6
#: How a world's solve stands.
RUNNING, CONVERGED, NEGATIVE, LIMIT, BROKEN = (wp.constant(k) for k in range(5))


@wp.kernel(enable_backward=False)
def begin(b: wp.array[wp.vec4], x: wp.array[wp.vec4], r: wp.array[wp.vec4]):
    """x = 0, r = b."""
    i = wp.tid()
    store_node(x, i, wp.vec3())
    store_node(r, i, load_node(b, i))


@wp.func
def is_number(a: wp.float64):
    """False for NaN and infinity."""
    return wp.abs(a) <= wp.float64(1.0e300)


@wp.func
def stop(status: wp.array[wp.int32], running: wp.array[wp.int32], world: int, how: int):
    status[world] = how
    wp.atomic_sub(running, 0, 1)


@wp.kernel(enable_backward=False)
def take_first(
    # In
    parts: wp.array3d[wp.float64],
    lanes: int,
    tolerance: wp.array[wp.float64],
    # Out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """Scalars before the first iteration; worlds without a right side, or with a tolerance of one, are done."""
    world, lane = wp.tid()
    rr = add_up(parts, world, lane, lanes, SQUARE)
    rz = add_up(parts, world, lane, lanes, PRODUCT)
    if lane == 0:
        scalars[world, RZ] = rz
        scalars[world, BETA] = wp.float64(0.0)
        scalars[world, ALPHA] = wp.float64(0.0)
        scalars[world, RR] = rr
        scalars[world, FIRST] = rr
        scalars[world, END] = tolerance[world] * tolerance[world] * rr
        iterations[world] = 0
        status[world] = CONVERGED
        if rr > wp.float64(0.0) or not is_number(rr):
            status[world] = BROKEN
            if is_number(rr) and tolerance[world] >= wp.float64(1.0):
                status[world] = CONVERGED
            elif is_number(rr) and is_number(rz) and rz > wp.float64(0.0):
                status[world] = RUNNING
                wp.atomic_add(running, 0, 1)


@wp.kernel(enable_backward=False)
def take_alpha(
    # In
    parts: wp.array3d[wp.float64],
    lanes: int,
    # In and out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """alpha = r . z / p . q. Where p . q <= 0 the world stops: at its last iterate, or with p = z if it has none."""
    world, lane = wp.tid()
    curvature = add_up(parts, world, lane, lanes, CURVATURE)
    if lane == 0:
        alpha = wp.float64(0.0)
        if status[world] == RUNNING:
            iterations[world] = iterations[world] + 1
            if not is_number(curvature):
                stop(status, running, world, BROKEN)
            elif curvature <= wp.float64(0.0):
                stop(status, running, world, NEGATIVE)
                if iterations[world] == 1:
                    alpha = wp.float64(1.0)
            else:
                alpha = scalars[world, RZ] / curvature
        scalars[world, ALPHA] = alpha


@wp.kernel(enable_backward=False)
def advance(
    # In
    p: wp.array[wp.vec4],
    q: wp.array[wp.vec4],
    scalars: wp.array2d[wp.float64],
    count: int,
    threads: int,
    lanes: int,
    # In and out
    x: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
    # Out
    parts: wp.array3d[wp.float64],
):
    """x += alpha p, r -= alpha q, and parts of r . r."""
    world, thread = wp.tid()
    alpha = float(scalars[world, ALPHA])
    total = wp.float64(0.0)
    k = thread
    while k < count:
        i = world * count + k
        rest = load_node(r, i)
        if alpha != 0.0:
            rest -= alpha * load_node(q, i)
            store_node(x, i, load_node(x, i) + alpha * load_node(p, i))
            store_node(r, i, rest)
        total += dot64(rest, rest)
        k += threads
    total = sum_of_lanes(total)
    if thread % lanes == 0:
        parts[world, thread / lanes, SQUARE] = total


@wp.kernel(enable_backward=False)
def take_beta(
    # In
    parts: wp.array3d[wp.float64],
    lanes: int,
    most: int,
    # In and out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """beta = r . z after the iteration over r . z before; a world stops where r . r is small enough."""
    world, lane = wp.tid()
    rr = add_up(parts, world, lane, lanes, SQUARE)
    rz = add_up(parts, world, lane, lanes, PRODUCT)
    if lane == 0 and status[world] == RUNNING:
        scalars[world, BETA] = rz / scalars[world, RZ]
        scalars[world, RZ] = rz
        scalars[world, RR] = rr
        if not (is_number(rr) and is_number(rz)):
            stop(status, running, world, BROKEN)
        elif rr <= scalars[world, END]:
            stop(status, running, world, CONVERGED)
        elif iterations[world] >= most:
            stop(status, running, world, LIMIT)
        elif rz <= wp.float64(0.0):
            stop(status, running, world, BROKEN)


@wp.kernel(enable_backward=False)
def take_direction(z: wp.array[wp.vec4], scalars: wp.array2d[wp.float64], count: int, p: wp.array[wp.vec4]):
    """p = z + beta p; beta is zero before the first iteration."""
    i = wp.tid()
    beta = float(scalars[i / count, BETA])
    v = load_node(z, i)
    if beta != 0.0:
        v += beta * load_node(p, i)
    store_node(p, i, v)
