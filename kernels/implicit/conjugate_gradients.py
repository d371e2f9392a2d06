"""Preconditioned conjugate gradients; all worlds iterate together.

Vectors are vec4, scalars float64. Kernels with ``sums`` first add the parts of sums up; see ``stepping.sums``.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.sums import Sums, add_up, dot64, store_sum

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def sum_products(sums: Sums, a: wp.array[wp.vec4], b: wp.array[wp.vec4], column: int):
    """Parts of a . b."""
    world, thread = wp.tid()
    total = wp.float64(0.0)
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        total += dot64(load_node(a, i), load_node(b, i))
    store_sum(sums, world, thread, column, total)


#: Columns of parts of sums: r . r, r . z, p . q and b . b.
SQUARE, PRODUCT, CURVATURE, RIGHT = (wp.constant(k) for k in range(4))
COLUMNS = 4
#: Places in the scalars of a world: r . z, the factors alpha and beta, and r . r now, b . b, r . r within the
#: tolerance, where the solve ends, and where it began.
RZ, ALPHA, BETA, RR, FIRST, WITHIN, END, BEGAN = (wp.constant(k) for k in range(8))
SCALARS = 8
#: State of a world's solve.
RUNNING, CONVERGED, NEGATIVE, LIMIT, BROKEN = (wp.constant(k) for k in range(5))


@wp.func
def is_number(a: wp.float64):
    """False for NaN and infinity."""
    return wp.abs(a) <= wp.float64(1.0e300)


@wp.func
def stop(status: wp.array[wp.int32], running: wp.array[wp.int32], world: int, how: int):
    status[world] = how
    wp.atomic_sub(running, 0, 1)


@wp.kernel(enable_backward=False)
def measure_guess(sums: Sums, b: wp.array[wp.vec4], x: wp.array[wp.vec4], q: wp.array[wp.vec4]):
    """Find the parts of b . x and x . q, q = A x, for a first guess."""
    world, thread = wp.tid()
    product = wp.float64(0.0)
    curvature = wp.float64(0.0)
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        guess = load_node(x, i)
        product += dot64(load_node(b, i), guess)
        curvature += dot64(load_node(q, i), guess)
    store_sum(sums, world, thread, PRODUCT, product)
    store_sum(sums, world, thread, CURVATURE, curvature)


@wp.kernel(enable_backward=False)
def take_guess(sums: Sums, scalars: wp.array2d[wp.float64]):
    """alpha = b . x / x . q, the factor of the guess with the least energy; zero if the guess does not help."""
    world, lane = wp.tid()
    product = add_up(sums, world, lane, PRODUCT)
    curvature = add_up(sums, world, lane, CURVATURE)
    if lane == 0:
        alpha = wp.float64(0.0)
        if curvature > wp.float64(0.0) and is_number(curvature) and is_number(product):
            alpha = product / curvature
        scalars[world, ALPHA] = alpha


@wp.kernel(enable_backward=False)
def begin(
    # In
    sums: Sums,
    b: wp.array[wp.vec4],
    like: wp.array[wp.vec4],
    q: wp.array[wp.vec4],
    scalars: wp.array2d[wp.float64],
    guessed: int,
    # In and out
    x: wp.array[wp.vec4],
    # Out
    r: wp.array[wp.vec4],
):
    """x = alpha x and r = b - alpha q with a guess, else x = 0 and r = b; parts of r . r, and of like . like for
    comparison."""
    world, thread = wp.tid()
    alpha = float(0.0)
    if guessed != 0:
        alpha = float(scalars[world, ALPHA])
    square = wp.float64(0.0)
    right = wp.float64(0.0)
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        given = load_node(b, i)
        rest = given
        first = wp.vec3()
        if alpha != 0.0:
            first = alpha * load_node(x, i)
            rest -= alpha * load_node(q, i)
        store_node(x, i, first)
        store_node(r, i, rest)
        square += dot64(rest, rest)
        compared = load_node(like, i)
        right += dot64(compared, compared)
    store_sum(sums, world, thread, SQUARE, square)
    store_sum(sums, world, thread, RIGHT, right)


@wp.kernel(enable_backward=False)
def take_first(
    # In
    sums: Sums,
    tolerance: wp.array[wp.float64],
    share: wp.float64,
    # Out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """Set the scalars before the first iteration; worlds whose residual is already small enough are done."""
    world, lane = wp.tid()
    rr = add_up(sums, world, lane, SQUARE)
    bb = add_up(sums, world, lane, RIGHT)
    if lane == 0:
        within = tolerance[world] * tolerance[world] * bb
        end = wp.max(within, share * share * rr)
        scalars[world, RZ] = wp.float64(0.0)
        scalars[world, BETA] = wp.float64(0.0)
        scalars[world, ALPHA] = wp.float64(0.0)
        scalars[world, RR] = rr
        scalars[world, FIRST] = bb
        scalars[world, WITHIN] = within
        scalars[world, END] = end
        scalars[world, BEGAN] = rr
        iterations[world] = 0
        if not (is_number(rr) and is_number(bb)):
            status[world] = BROKEN
        elif rr <= within:
            status[world] = CONVERGED
        else:
            status[world] = RUNNING
            wp.atomic_add(running, 0, 1)


@wp.kernel(enable_backward=False)
def take_beta(
    # In
    sums: Sums,
    # In and out
    scalars: wp.array2d[wp.float64],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """beta = r . z over its former value; zero in the first iteration."""
    world, lane = wp.tid()
    rz = add_up(sums, world, lane, PRODUCT)
    if lane == 0 and status[world] == RUNNING:
        before = scalars[world, RZ]
        scalars[world, BETA] = wp.where(before > wp.float64(0.0), rz / before, wp.float64(0.0))
        scalars[world, RZ] = rz
        if not is_number(rz):
            stop(status, running, world, BROKEN)
        elif rz <= wp.float64(0.0):
            stop(status, running, world, LIMIT)


@wp.kernel(enable_backward=False)
def take_alpha(
    # In
    sums: Sums,
    # In and out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """alpha = r . z / p . q. If p . q <= 0 the world stops, at its last iterate, or with p = z if there is none."""
    world, lane = wp.tid()
    curvature = add_up(sums, world, lane, CURVATURE)
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
    sums: Sums,
    p: wp.array[wp.vec4],
    q: wp.array[wp.vec4],
    scalars: wp.array2d[wp.float64],
    # In and out
    x: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
):
    """x += alpha p, r -= alpha q, and parts of r . r."""
    world, thread = wp.tid()
    alpha = float(scalars[world, ALPHA])
    total = wp.float64(0.0)
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        rest = load_node(r, i)
        if alpha != 0.0:
            rest -= alpha * load_node(q, i)
            store_node(x, i, load_node(x, i) + alpha * load_node(p, i))
            store_node(r, i, rest)
        total += dot64(rest, rest)
    store_sum(sums, world, thread, SQUARE, total)


@wp.kernel(enable_backward=False)
def judge(
    # In
    sums: Sums,
    most: int,
    iterations: wp.array[wp.int32],
    # In and out
    scalars: wp.array2d[wp.float64],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """Stop the worlds whose r . r is small enough."""
    world, lane = wp.tid()
    rr = add_up(sums, world, lane, SQUARE)
    if lane == 0 and status[world] == RUNNING:
        scalars[world, RR] = rr
        if not is_number(rr):
            stop(status, running, world, BROKEN)
        elif rr <= scalars[world, END]:
            stop(status, running, world, CONVERGED)
        elif iterations[world] >= most:
            stop(status, running, world, LIMIT)


@wp.kernel(enable_backward=False)
def take_direction(z: wp.array[wp.vec4], scalars: wp.array2d[wp.float64], count: int, p: wp.array[wp.vec4]):
    """p = z + beta p; beta is zero before the first iteration."""
    i = wp.tid()
    beta = float(scalars[i / count, BETA])
    v = load_node(z, i)
    if beta != 0.0:
        v += beta * load_node(p, i)
    store_node(p, i, v)
