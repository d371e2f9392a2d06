"""The balance of energy: the energies of each world, the work of forces, and two copies of the state.

``integrate.add_support_work`` counts the work of a support against all forces on its nodes. The part against forces
that are not elastic is subtracted here, because the balance has no energy for them.

A run begins with ``take_over``, which compares the state with the last good copy. It ends with ``sum_nodes``, which
also writes the present state to the other copy, and ``report``, which writes all results for the host to one place.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

from .integrate import Dynamics, by_vectors, force_at, load_at, symplectic_euler_velocity, vector_at
from .pace import BEFORE, CONTROLS, DONE, DONE_THEN, DT, END, SLOT, THEN, Pace, length_before, time_after
from .sums import Sums, add_most, add_sum, add_up, dot64, largest

wp.set_module_options({"enable_backward": False})


@wp.func
def add_work(account: wp.array2d[wp.float64], i: int, work: float):
    account[0, i] = account[0, i] + wp.float64(work)
    account[1, i] = account[1, i] + wp.abs(wp.float64(work))


@wp.kernel(enable_backward=False)
def separate_forces(elastic: wp.array[wp.vec4], f: wp.array[wp.vec4], others: wp.array[wp.vec4]):
    """Find the forces that were added after the elastic ones."""
    i = wp.tid()
    store_node(others, i, load_node(f, i) - load_node(elastic, i))


@wp.kernel(enable_backward=False)
def count_work(
    # In
    body: Dynamics,
    pace: Pace,
    offset: int,
    elastic: wp.array[wp.vec4],
    # In and out
    others: wp.array[wp.vec4],
    account: wp.array2d[wp.float64],
):
    """Count the work of the other forces, each along half of the motion before it and half of the motion after it.

    That is how symplectic Euler conserves energy. Afterwards ``others`` has all forces besides elasticity, constraints
    included.
    """
    i = wp.tid()
    force = load_node(others, i)
    store_node(others, i, load_node(body.f, i) - load_node(elastic, i))
    if wp.dot(force, force) == 0.0:
        return
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    w, velocity = body.inverse_mass[i], load_node(body.v, i)
    later = velocity
    if w > 0.0:
        kick, damped = 0.5 * (before + dt), 1.0 / (1.0 + dt * body.damping)
        later = symplectic_euler_velocity(velocity, force_at(i, body), w, body.gravity, kick, damped)
    add_work(account, i, 0.5 * wp.dot(force, before * velocity + dt * later))


@wp.func
def count_constraint(
    i: int,
    force: wp.vec3,
    all_forces: wp.vec3,
    velocity: wp.vec3,
    damping: float,
    gravity: wp.vec3,
    w: float,
    pace: Pace,
    offset: int,
    account: wp.array2d[wp.float64],
):
    """Count the work of the force C of constraints on a node, which is part of all its forces but gravity.

    Let b and d be the lengths of the last step and of this one, and v and w the velocities before and after the kick.
    Let F be all other forces: elastic ones, gravity and loads. All forces act for (b + d) / 2, so they add the kinetic
    energy (b + d) / 2 (F + C) . (v + w) / 2. The work of F is counted elsewhere, along half of the motion before and
    half of the motion after: F . (b v + d w) / 2. Constraints decide where a node goes, so the rest is their work:
    (b + d) / 2 C . (v + w) / 2 + (b - d) / 4 F . (w - v).
    """
    dt = float(pace.seconds[DT])
    before = dt
    if offset == 0:
        before = float(length_before(pace))
    kick = 0.5 * (before + dt)
    if w == 0.0:
        add_work(account, i, kick * wp.dot(force, velocity))
        return
    later = symplectic_euler_velocity(velocity, all_forces, w, gravity, kick, 1.0 / (1.0 + dt * damping))
    others = all_forces - force + gravity / w
    work = 0.5 * kick * wp.dot(force, velocity + later)
    add_work(account, i, work + 0.25 * (before - dt) * wp.dot(others, later - velocity))


@wp.kernel(enable_backward=False)
def count_constraints(
    # In
    body: Dynamics,
    pace: Pace,
    offset: int,
    constrained: wp.array[wp.vec4],
    # In and out
    account: wp.array2d[wp.float64],
):
    """Count the work of the forces of constraints, which are part of f."""
    i = wp.tid()
    force = load_node(constrained, i)
    if wp.dot(force, force) == 0.0:
        return
    velocity, w = load_node(body.v, i), body.inverse_mass[i]
    count_constraint(i, force, force_at(i, body), velocity, body.damping, body.gravity, w, pace, offset, account)


#: Columns of ``sums``.
KINETIC, AHEAD, GRAVITATIONAL, LOADS, SUPPORTS, REACH, ELASTIC, UNTIMELY, WORKED, WORKED_ABSOLUTE = (
    wp.constant(k) for k in range(10)
)
COLUMNS = 10

#: Places in the report besides the sums: the clock's numbers, the work of moving supports and the sum of its absolute
#: values [J], the first step that was not finite, whether a user has written to the state, and, from CONTROL on, the
#: numbers that control the step.
STEPS, STEPS_THEN, LENGTH, TIME_THEN, LENGTH_BEFORE, WORK, WORK_ABSOLUTE, BAD_STEP, CHANGED, CONTROL = (
    wp.constant(k) for k in range(10)
)
NUMBERS = 9 + CONTROLS

#: A run counts as ended if it came this near to its end, in steps, since the last step is rounded.
NEAR = wp.constant(wp.float64(1e-4))


@wp.func
def equal(a: wp.vec3, b: wp.vec3):
    """False if any component is NaN."""
    return a[0] == b[0] and a[1] == b[1] and a[2] == b[2]


@wp.kernel(enable_backward=False)
def take_over(
    # In
    rest: wp.array[wp.vec4],
    positions: wp.array[Any],
    inverse_mass: wp.array[wp.float32],
    orders: wp.array[wp.float64],
    v: wp.array[wp.vec4],
    # In and out
    u: wp.array[wp.vec4],
    kept_u: wp.array2d[wp.vec4],
    kept_v: wp.array2d[wp.vec4],
    kept_inverse_mass: wp.array[wp.float32],
    # Out
    pace: Pace,
    changed: wp.array[wp.int32],
):
    """Adopt positions that a user wrote; compare the state with the last good copy, and update the copy if they
    differ."""
    i = wp.tid()
    slot = int(orders[SLOT])
    x = load_node(rest, i)
    p = vector_at(positions, i)
    displacement = load_node(u, i)
    q = x + displacement
    if p[0] != q[0] or p[1] != q[1] or p[2] != q[2]:
        displacement = p - x
        store_node(u, i, displacement)
    velocity = load_node(v, i)
    w = inverse_mass[i]
    is_same = equal(displacement, load_node(kept_u[slot], i)) and equal(velocity, load_node(kept_v[slot], i))
    if not is_same or w != kept_inverse_mass[i]:
        store_node(kept_u[slot], i, displacement)
        store_node(kept_v[slot], i, velocity)
        kept_inverse_mass[i] = w
        changed[0] = 1
        pace.seconds[BEFORE] = wp.float64(0.0)


@wp.func
def is_zero(a: wp.vec3):
    return a[0] == 0.0 and a[1] == 0.0 and a[2] == 0.0


@wp.kernel(enable_backward=False)
def sum_nodes(
    # In
    sums: Sums,
    pace: Pace,
    lag: wp.float64,
    body: Dynamics,
    mass: wp.array[wp.float32],
    count: int,
    pushed: int,
    others: wp.array[wp.vec4],
    constrained: int,
    constraints: wp.array[wp.vec4],
    orders: wp.array[wp.float64],
    keeps: int,
    # In and out
    kept_u: wp.array2d[wp.vec4],
    kept_v: wp.array2d[wp.vec4],
):
    """Add up over free nodes: kinetic and gravitational energy, the work of loads since the last good state, the
    largest displacement. If ``keeps``, keep the present state beside the last good one.

    Velocities are half a step behind displacements. From the elastic forces f of these displacements they are known at
    any time near them. Let v_behind and v_ahead be the velocities half of the next step before and after the
    displacements. Where forces are linear, symplectic Euler conserves v_behind . M v_ahead / 2 plus the elastic energy
    exactly, also beyond the stable step, where this product may be negative. The product is the kinetic energy plus
    ``AHEAD``. With velocities at the time of the displacements, the kinetic energy is larger than the product by
    ``UNTIMELY``. ``add_support_work`` counts half of the share of f too early; that half is ``SUPPORTS``. If ``lag`` is
    zero, velocities are at the time of the displacements, and these terms vanish.

    The forces besides elasticity in the last step accelerate nodes, too; their work is counted elsewhere. The work of
    constraints already takes a change of the step into account, so ``AHEAD`` does not do so where they act.
    """
    world, thread = wp.tid()
    slot = int(orders[SLOT])
    dt = lag * pace.seconds[DT]
    before = lag * length_before(pace)
    both = wp.float64(0.25) * (before * before - dt * dt)
    kinetic = wp.float64(0.0)
    ahead = wp.float64(0.0)
    gravitational = wp.float64(0.0)
    work = wp.float64(0.0)
    supports = wp.float64(0.0)
    untimely = wp.float64(0.0)
    reach = wp.float64(0.0)
    for k in range(thread, count, sums.threads):
        i = world * count + k
        x = load_node(body.u, i)
        reach = wp.max(reach, dot64(x, x))
        velocity = load_node(body.v, i)
        force = load_node(body.f, i)
        if body.inverse_mass[i] == 0.0:
            supports -= wp.float64(0.5) * before * dot64(force, velocity)
        else:
            m = wp.float64(mass[i])
            pull = wp.vec3d(force) + m * wp.vec3d(body.gravity)
            power = dot64(force, velocity) + m * dot64(body.gravity, velocity)
            if body.load.shape[0] > 0:
                external = load_at(i, body)
                pull += wp.vec3d(external)
                power += dot64(external, velocity)
                work += dot64(external, x) - dot64(external, load_node(kept_u[slot], i))
            if pushed != 0:
                pull += wp.vec3d(load_node(others, i))
            square = wp.dot(pull, pull) / m
            ahead += wp.float64(0.5) * before * power
            if constrained == 0 or is_zero(load_node(constraints, i)):
                ahead += wp.float64(0.5) * both * square
            untimely += square
            kinetic += wp.float64(0.5) * m * dot64(velocity, velocity)
            gravitational -= m * dot64(body.gravity, x)
        if keeps != 0:
            store_node(kept_u[1 - slot], i, x)
            store_node(kept_v[1 - slot], i, velocity)
    add_sum(sums, world, thread, KINETIC, kinetic)
    add_sum(sums, world, thread, AHEAD, ahead)
    add_sum(sums, world, thread, GRAVITATIONAL, gravitational)
    add_sum(sums, world, thread, LOADS, work)
    add_sum(sums, world, thread, SUPPORTS, supports)
    add_sum(sums, world, thread, UNTIMELY, wp.float64(0.125) * dt * dt * untimely)
    add_most(sums, world, thread, REACH, wp.sqrt(reach))


@wp.kernel(enable_backward=False)
def sum_rows(sums: Sums, rows: wp.array2d[wp.float64], count: int, column: int):
    """Add up rows of numbers, ``count`` of each world, in one column each: strain energies, or the work of constraints
    and its absolute value."""
    world, thread = wp.tid()
    for row in range(rows.shape[0]):
        total = wp.float64(0.0)
        for k in range(thread, count, sums.threads):
            total += rows[row, world * count + k]
        add_sum(sums, world, thread, column + row, total)


@wp.kernel(enable_backward=False)
def keep_words(words: wp.array[wp.uint32], orders: wp.array[wp.float64], beside: int, kept: wp.array2d[wp.uint32]):
    """Copy further arrays to the last good state, or to the copy beside it."""
    i = wp.tid()
    slot = int(orders[SLOT])
    if beside != 0:
        slot = 1 - slot
    kept[slot, i] = words[i]


@wp.kernel(enable_backward=False)
def report(
    # In
    sums: Sums,
    orders: wp.array[wp.float64],
    support_work: wp.array[wp.float64],
    bad_step: wp.array[wp.int64],
    changed: wp.array[wp.int32],
    control: wp.array[wp.float64],
    # In and out
    pace: Pace,
    # Out
    totals: wp.array2d[wp.float64],
    numbers: wp.array[wp.float64],
):
    """Add up the partial sums, reset them, and write all results for the host.

    If the run has reached its end, the time is exactly ``END``.
    """
    world, column, lane = wp.tid()
    together = add_up(sums, world, lane, column)
    if column == REACH:
        together = largest(sums, world, lane, column)
    for k in range(lane, sums.parts.shape[1], sums.lanes):
        sums.parts[world, k, column] = wp.float64(0.0)
    if lane == 0:
        totals[world, column] = together
        if world == 0 and column == 0:
            if wp.abs(time_after(pace, 0) - orders[END]) <= NEAR * pace.seconds[DT]:
                pace.seconds[THEN] = orders[END]
                pace.counts[DONE_THEN] = pace.counts[DONE]
            numbers[STEPS] = wp.float64(pace.counts[DONE])
            numbers[STEPS_THEN] = wp.float64(pace.counts[DONE_THEN])
            numbers[LENGTH] = pace.seconds[DT]
            numbers[TIME_THEN] = pace.seconds[THEN]
            numbers[LENGTH_BEFORE] = pace.seconds[BEFORE]
            numbers[WORK] = support_work[0]
            numbers[WORK_ABSOLUTE] = support_work[1]
            numbers[BAD_STEP] = wp.float64(bad_step[0])
            numbers[CHANGED] = wp.float64(changed[0])
            for k in range(CONTROLS):
                numbers[CONTROL + k] = control[k]


TAKE_OVER = by_vectors(take_over, "positions")
