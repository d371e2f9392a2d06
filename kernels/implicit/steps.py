"""Implicit time steps at the nodes: the start values of a step, and the state at its end.

A scheme is a table of coefficients: each row is a sum of the stage's increment d, the velocity v, and two vectors h1
and h2 of the step before, such as its acceleration. The first table is for a step that continues the one before, the
second for a first step.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.integrate import Dynamics, count_support_work, force_at, is_finite
from warp_corot.kernels.stepping.pace import DONE, DT, Pace

from .conjugate_gradients import BROKEN
from .tangent import DAMPING, MASS, STIFFNESS

wp.set_module_options({"enable_backward": False})

#: Rows of a scheme: acceleration and velocity of the stage, velocity after the step, and the next h1 and h2. The last
#: row has the fraction of the step at which the stage is, the fraction of v dt with which the search for the increment
#: begins, and the increment over the unknown of linear solves.
ACCELERATION, RATE, VELOCITY, FIRST, SECOND, STAGE = (wp.constant(k) for k in range(6))
ROWS = 6
#: Columns: d, v, h1 and h2.
COLUMNS = 4


@wp.func
def combined(table: wp.array3d[wp.float32], row: int, which: int, v: wp.vec3, h1: wp.vec3, h2: wp.vec3):
    """A row's sum without its first term."""
    return table[which, row, 1] * v + table[which, row, 2] * h1 + table[which, row, 3] * h2


@wp.kernel(enable_backward=False)
def find_changes(
    # In
    inverse_mass: wp.array[wp.float32],
    u: wp.array[wp.vec4],
    v: wp.array[wp.vec4],
    left_u: wp.array[wp.vec4],
    left_v: wp.array[wp.vec4],
    # Out
    begins: wp.array[wp.int32],
):
    """Check whether free nodes have the positions and velocities of the end of the step before; otherwise this is a
    first step.
    """
    i = wp.tid()
    if inverse_mass[i] > 0.0:
        a = load_node(u, i) - load_node(left_u, i)
        b = load_node(v, i) - load_node(left_v, i)
        if not (wp.dot(a, a) == 0.0 and wp.dot(b, b) == 0.0):
            begins[0] = 1


@wp.kernel(enable_backward=False)
def choose_scales(
    # In
    begins: wp.array[wp.int32],
    table: wp.array3d[wp.float32],
    damping: float,
    # Out
    scales: wp.array[wp.float32],
    inertia: wp.array[wp.float32],
    share: wp.array[wp.float32],
):
    """Choose the scales of the operator for this step, including damping proportional to mass. ``share`` is the
    increment over the operator's unknown.
    """
    which = begins[0]
    a = table[which, ACCELERATION, 0]
    b = table[which, RATE, 0]
    c = table[which, STAGE, 2]
    scales[MASS] = c * (a + damping * b)
    scales[DAMPING] = c * b
    scales[STIFFNESS] = c
    inertia[0] = a + damping * b
    share[0] = c


@wp.kernel(enable_backward=False)
def begin_step(
    # In
    begins: wp.array[wp.int32],
    table: wp.array3d[wp.float32],
    dt: float,
    damping: float,
    inverse_mass: wp.array[wp.float32],
    v: wp.array[wp.vec4],
    h1: wp.array[wp.vec4],
    h2: wp.array[wp.vec4],
    # In and out
    u: wp.array[wp.vec4],
    before: wp.array[wp.vec4],
    # Out
    base: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    pull: wp.array[wp.vec4],
    guess: wp.array[wp.vec4],
    drift: wp.array[wp.vec4],
):
    """Find the base of the increments, their first values, and the pull of inertia and damping.

    ``guess`` is the unknown beyond its first value if the velocity keeps changing as it has since the step before,
    ``before``; it is zero at held nodes. Held nodes keep their velocity. ``drift`` is the stage's velocity without the
    increment's part, or one entry if it is not needed; h1 and h2 have one entry in schemes without them.
    """
    i = wp.tid()
    which = begins[0]
    velocity = load_node(v, i)
    first = wp.vec3()
    second = wp.vec3()
    if h1.shape[0] > 1:
        first = load_node(h1, i)
    if h2.shape[0] > 1:
        second = load_node(h2, i)
    place = load_node(u, i)
    share = table[which, STAGE, 0]
    d = (share * dt) * velocity
    rate = combined(table, RATE, which, velocity, first, second)
    rest = wp.vec3()
    if inverse_mass[i] > 0.0:
        last = load_node(before, i)
        rest = d
        if is_finite(last):
            rest += (share * dt) * (velocity - last)
        store_node(before, i, velocity)
        d = table[which, STAGE, 1] * d
        rest -= d
        store_node(pull, i, -(combined(table, ACCELERATION, which, velocity, first, second) + damping * rate))
    store_node(base, i, place)
    store_node(guess, i, rest / table[which, STAGE, 2])
    store_node(increment, i, d)
    store_node(u, i, place + d)
    if drift.shape[0] > 1:
        if inverse_mass[i] == 0.0:
            rate = velocity - table[which, RATE, 0] * d
        store_node(drift, i, rate)


@wp.kernel(enable_backward=False)
def find_rates(
    scales: wp.array[wp.float32],
    increment: wp.array[wp.vec4],
    drift: wp.array[wp.vec4],
    rates: wp.array[wp.vec4],
):
    """Find the stage's velocities from the present increments."""
    i = wp.tid()
    rate = scales[DAMPING] / scales[STIFFNESS]
    store_node(rates, i, rate * load_node(increment, i) + load_node(drift, i))


@wp.kernel(enable_backward=False)
def find_middle(
    # In
    a: wp.array[wp.vec4],
    b: wp.array[wp.vec4],
    # Out
    middle: wp.array[wp.vec4],
):
    """Find the mean of two states."""
    i = wp.tid()
    store_node(middle, i, 0.5 * (load_node(a, i) + load_node(b, i)))


@wp.kernel(enable_backward=False)
def end_step(
    # In
    begins: wp.array[wp.int32],
    table: wp.array3d[wp.float32],
    world_nodes: int,
    status: wp.array[wp.int32],
    inverse_mass: wp.array[wp.float32],
    base: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    contact_forces: wp.array[wp.vec4],
    pace: Pace,
    offset: int,
    # In and out
    v: wp.array[wp.vec4],
    h1: wp.array[wp.vec4],
    h2: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
    left_u: wp.array[wp.vec4],
    left_v: wp.array[wp.vec4],
    bad_step: wp.array[wp.int64],
    moves: wp.array[wp.int32],
):
    """Find the state after the step. If the solve has broken down, displacements become NaN, and ``bad_step`` records
    the step. ``moves`` becomes nonzero if a held node moves.

    Nodes with ``contact_forces`` take the velocity and the acceleration h1 of backward Euler: contact decides how far
    they go, and schemes that damp nothing would alternate about that. The array has one entry if this is not needed.
    """
    i = wp.tid()
    which = begins[0]
    d = load_node(increment, i)
    velocity = load_node(v, i)
    if inverse_mass[i] > 0.0:
        first = wp.vec3()
        second = wp.vec3()
        if h1.shape[0] > 1:
            first = load_node(h1, i)
        if h2.shape[0] > 1:
            second = load_node(h2, i)
        after = table[which, VELOCITY, 0] * d + combined(table, VELOCITY, which, velocity, first, second)
        if h1.shape[0] > 1:
            store_node(h1, i, table[which, FIRST, 0] * d + combined(table, FIRST, which, velocity, first, second))
        if h2.shape[0] > 1:
            store_node(h2, i, table[which, SECOND, 0] * d + combined(table, SECOND, which, velocity, first, second))
        if contact_forces.shape[0] > 1:
            push = load_node(contact_forces, i)
            if wp.dot(push, push) > 0.0:
                dt = float(pace.seconds[DT])
                after = d / (table[which, STAGE, 0] * dt)
                store_node(h1, i, (after - velocity) / dt)
        velocity = after
    elif wp.dot(d, d) > 0.0:
        moves[0] = 1
    d = d / table[which, STAGE, 0]
    if status[wp.min(i / world_nodes, status.shape[0] - 1)] == BROKEN:
        d = wp.vec3(wp.nan, wp.nan, wp.nan)
    place = load_node(base, i) + d
    store_node(u, i, place)
    store_node(v, i, velocity)
    store_node(increment, i, d)
    if left_u.shape[0] > 1:
        store_node(left_u, i, place)
        store_node(left_v, i, velocity)
    if not is_finite(place):
        wp.atomic_min(bad_step, 0, pace.counts[DONE] + wp.int64(offset + 1))


@wp.kernel(enable_backward=False)
def count_supports(
    # In
    body: Dynamics,
    mass: wp.array[wp.float32],
    elastic: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    # Out
    reactions: wp.array[wp.vec4],
    support_work: wp.array[wp.float64],
):
    """Find the forces of supports after the step, and the work of moving ones against elastic forces; the other forces
    are in ``body``."""
    i = wp.tid()
    if body.inverse_mass[i] == 0.0:
        force = load_node(elastic, i)
        store_node(reactions, i, -(force + force_at(i, body) + mass[i] * body.gravity))
        count_support_work(force, load_node(increment, i), i, support_work)


@wp.kernel(enable_backward=False)
def count_work(
    inverse_mass: wp.array[wp.float32],
    others: wp.array[wp.vec4],
    increment: wp.array[wp.vec4],
    account: wp.array2d[wp.float64],
):
    """Add the work of all but elastic forces on free nodes to its sum."""
    i = wp.tid()
    if inverse_mass[i] > 0.0:
        work = wp.float64(wp.dot(load_node(others, i), load_node(increment, i)))
        account[0, i] = account[0, i] + work
        account[1, i] = account[1, i] + wp.abs(work)


@wp.kernel(enable_backward=False)
def count_solves(
    # In
    iterations: wp.array[wp.int32],
    linear_iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    good: int,
    # Out
    totals: wp.array[wp.int64],
):
    """Count steps, Newton and linear iterations of the world with the most, and unfinished steps."""
    most = int(0)
    linear = int(0)
    unfinished = int(0)
    for world in range(status.shape[0]):
        most = wp.max(most, iterations[world])
        linear = wp.max(linear, linear_iterations[world])
        if status[world] != good:
            unfinished = 1
    totals[0] = totals[0] + wp.int64(1)
    totals[1] = totals[1] + wp.int64(most)
    totals[2] = totals[2] + wp.int64(linear)
    totals[3] = totals[3] + wp.int64(unfinished)
