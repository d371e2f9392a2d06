"""Newton's method for the minimum of Pi(u) = W(u) - (loads and weight) . u + 1/2 a (d - h) . M (d - h) in each world.

W is the strain energy, u = base + d with the increment d, and the last term is the inertia of a time step; static
solutions have none. Increments keep the digits of short steps. The residual is r = -dPi/du at free nodes and zero at
the others. The device decides from each world's scalars, so an iteration can be recorded.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.sums import Sums, add_up, dot64, largest, store_most, store_sum

from .conjugate_gradients import NEGATIVE, is_number, stop

wp.set_module_options({"enable_backward": False})

#: Columns of parts: of sums |r|^2, |external and reaction forces|^2, r . step, the same with all but elastic forces,
#: step . M step and strain energies, and of largest values |step|^2 and |u|^2.
SQUARE, REFERENCE, SLOPE, OUTER, INERTIA, ENERGY, STEP, REACH = (wp.constant(k) for k in range(8))
COLUMNS = 8
#: Places in the scalars of a world: the norms of the residual now and before, the norm it is compared with, the
#: fraction of the step that is taken, the strain energy at its beginning, r . step, the relative correction, and the
#: tolerance of the linear solve.
RESIDUAL, BEFORE, COMPARED, SHARE, ENERGY_NOW, SLOPE_NOW, CORRECTION, SOLVED_TO = (wp.constant(k) for k in range(8))
SCALARS = 8
#: State of a world.
RUNNING, CONVERGED, STUCK, LIMIT, BROKEN = (wp.constant(k) for k in range(5))

#: Least decrease, as a fraction of the one that the slope predicts.
ARMIJO = wp.constant(wp.float64(1e-4))
#: The only step of a world may go beyond the end of the descent by this fraction of its length.
BEYOND = wp.constant(wp.float64(0.3))
#: Relative rounding error of a strain energy in float32.
ROUNDING = wp.constant(wp.float64(1e-6))
#: The smallest fraction of a step that is tried.
SHORTEST = wp.constant(wp.float64(1e-7))
#: Largest and smallest tolerance of the linear solve.
LOOSEST, TIGHTEST = wp.constant(wp.float64(0.1)), wp.constant(wp.float64(1e-5))
#: Tolerance of the linear solve for a step whose size may end the iteration.
TRUSTED = wp.constant(wp.float64(1e-3))
#: After a whole step below this relative size, the next one may be the last and is solved for accurately.
NEAR = wp.constant(wp.float64(1e-3))


@wp.kernel(enable_backward=False)
def measure_step(
    sums: Sums,
    mass: wp.array[wp.float32],
    r: wp.array[wp.vec4],
    outer: wp.array[wp.vec4],
    step: wp.array[wp.vec4],
    u: wp.array[wp.vec4],
):
    """Find parts of r . step, outer . step and step . M step, and the largest |step|^2 and |u|^2."""
    world, thread = wp.tid()
    slope = wp.float64(0.0)
    work = wp.float64(0.0)
    inertia = wp.float64(0.0)
    longest = wp.float64(0.0)
    reach = wp.float64(0.0)
    for k in range(thread, sums.count, sums.threads):
        i = world * sums.count + k
        s = load_node(step, i)
        x = load_node(u, i)
        square = dot64(s, s)
        slope += dot64(load_node(r, i), s)
        work += dot64(load_node(outer, i), s)
        inertia += wp.float64(mass[i]) * square
        longest = wp.max(longest, square)
        reach = wp.max(reach, dot64(x, x))
    store_sum(sums, world, thread, SLOPE, slope)
    store_sum(sums, world, thread, OUTER, work)
    store_sum(sums, world, thread, INERTIA, inertia)
    store_most(sums, world, thread, STEP, longest)
    store_most(sums, world, thread, REACH, reach)


@wp.kernel(enable_backward=False)
def sum_energies(sums: Sums, energies: wp.array[wp.float64], count: int):
    """Find parts of strain energies, ``count`` for each world."""
    world, thread = wp.tid()
    total = wp.float64(0.0)
    for k in range(thread, count, sums.threads):
        total += energies[world * count + k]
    store_sum(sums, world, thread, ENERGY, total)


@wp.kernel(enable_backward=False)
def begin_worlds(
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    solved: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """Mark all worlds as running."""
    world = wp.tid()
    for k in range(SCALARS):
        scalars[world, k] = wp.float64(0.0)
    iterations[world] = 0
    solved[world] = 0
    status[world] = RUNNING
    wp.atomic_add(running, 0, 1)


@wp.kernel(enable_backward=False)
def judge_residual(
    # In
    sums: Sums,
    tolerance: wp.float64,
    most: int,
    # In and out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
    # Out
    solve_tolerance: wp.array[wp.float64],
):
    """Stop worlds whose residual is small; for the others set the tolerance of the linear solve (Eisenstat and Walker
    1996).

    The residual is compared with the norm of external and reaction forces. Worlds that have stopped need no step and
    get a tolerance of one.
    """
    world, lane = wp.tid()
    square = add_up(sums, world, lane, SQUARE)
    reference = add_up(sums, world, lane, REFERENCE)
    energy = add_up(sums, world, lane, ENERGY)
    if lane == 0:
        solve_tolerance[world] = wp.float64(1.0)
        if status[world] == RUNNING:
            before = scalars[world, RESIDUAL]
            now = wp.sqrt(square)
            compared = wp.sqrt(reference)
            scalars[world, BEFORE] = before
            scalars[world, RESIDUAL] = now
            scalars[world, COMPARED] = compared
            scalars[world, ENERGY_NOW] = energy
            if not (is_number(square) and is_number(energy)):
                stop(status, running, world, BROKEN)
            elif now <= tolerance * compared:
                stop(status, running, world, CONVERGED)
            elif iterations[world] >= most:
                stop(status, running, world, LIMIT)
            else:
                wanted = LOOSEST
                if before > wp.float64(0.0):
                    gained = now / before
                    wanted = wp.min(wp.float64(0.9) * gained * gained, LOOSEST)
                # Not more accurate than the end of the iteration needs.
                useful = wp.float64(0.3) * tolerance * compared / now
                wanted = wp.max(wp.max(wanted, wp.min(useful, LOOSEST)), TIGHTEST)
                if iterations[world] > 0 and scalars[world, CORRECTION] <= NEAR:
                    wanted = wp.min(wanted, TRUSTED)
                scalars[world, SOLVED_TO] = wanted
                solve_tolerance[world] = wanted


@wp.kernel(enable_backward=False)
def begin_search(
    # In
    sums: Sums,
    inner: wp.array[wp.int32],
    # In and out
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    solved: wp.array[wp.int32],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
    # Out
    searching: wp.array[wp.int32],
):
    """Try the whole step in every running world; a step that does not go downhill is dropped."""
    world, lane = wp.tid()
    slope = add_up(sums, world, lane, SLOPE)
    if lane == 0:
        scalars[world, SHARE] = wp.float64(0.0)
        scalars[world, SLOPE_NOW] = slope
        if status[world] == RUNNING:
            iterations[world] = iterations[world] + 1
            solved[world] = solved[world] + inner[world]
            if is_number(slope) and slope > wp.float64(0.0):
                scalars[world, SHARE] = wp.float64(1.0)
                wp.atomic_add(searching, 0, 1)
            else:
                stop(status, running, world, STUCK)


@wp.kernel(enable_backward=False)
def try_step(
    # In
    scalars: wp.array2d[wp.float64],
    base: wp.array[wp.vec4],
    step: wp.array[wp.vec4],
    count: int,
    commits: int,
    # In and out
    increment: wp.array[wp.vec4],
    # Out
    u: wp.array[wp.vec4],
):
    """u = base + d + fraction step; to commit is to set d to that increment."""
    i = wp.tid()
    share = float(scalars[i / count, SHARE])
    d = load_node(increment, i)
    if share > 0.0:
        d += share * load_node(step, i)
    if commits != 0:
        store_node(increment, i, d)
    store_node(u, i, load_node(base, i) + d)


@wp.kernel(enable_backward=False)
def judge_trial(
    # In
    sums: Sums,
    inertia: wp.array[wp.float32],
    status: wp.array[wp.int32],
    # In and out
    scalars: wp.array2d[wp.float64],
    accepted: wp.array[wp.int32],
    searching: wp.array[wp.int32],
):
    """Take the step if Pi decreases by a fraction of the prediction of its slope; otherwise try a shorter one.

    The change of W is measured; the rest of Pi is a polynomial of the fraction. The next fraction comes from the
    parabola through Pi's values and its slope.
    """
    world, lane = wp.tid()
    energy = add_up(sums, world, lane, ENERGY)
    square = add_up(sums, world, lane, INERTIA)
    work = add_up(sums, world, lane, OUTER)
    if lane == 0 and status[world] == RUNNING and accepted[world] == 0:
        share = scalars[world, SHARE]
        slope = scalars[world, SLOPE_NOW]
        before = scalars[world, ENERGY_NOW]
        change = energy - before - share * work
        change += wp.float64(0.5) * wp.float64(inertia[0]) * share * share * square
        noise = ROUNDING * (wp.abs(before) + wp.abs(energy))
        if is_number(energy) and change <= noise - ARMIJO * share * slope:
            accepted[world] = 1
            wp.atomic_sub(searching, 0, 1)
        elif share <= SHORTEST:
            scalars[world, SHARE] = wp.float64(0.0)
            accepted[world] = 1
            wp.atomic_sub(searching, 0, 1)
        else:
            shorter = wp.float64(0.1)
            if is_number(energy):
                shorter = wp.clamp(
                    wp.float64(0.5) * share * slope / (change + share * slope), wp.float64(0.1), wp.float64(0.5)
                )
            scalars[world, SHARE] = shorter * share


@wp.kernel(enable_backward=False)
def judge_step(
    # In
    sums: Sums,
    tolerance: wp.float64,
    inner_status: wp.array[wp.int32],
    # In and out
    scalars: wp.array2d[wp.float64],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """Stop worlds in which a whole step was small, relative to displacements or in energy, or no step could be taken.

    A step from a rough solve may be small because its smooth part is missing: then the next one is solved for
    accurately.
    """
    world, lane = wp.tid()
    longest = largest(sums, world, lane, STEP)
    reach = largest(sums, world, lane, REACH)
    if lane == 0 and status[world] == RUNNING:
        correction = wp.sqrt(longest) / wp.max(wp.sqrt(reach), wp.float64(1e-30))
        scalars[world, CORRECTION] = correction
        if scalars[world, SHARE] == wp.float64(0.0):
            stop(status, running, world, STUCK)
        elif scalars[world, SHARE] < wp.float64(1.0) or inner_status[world] == NEGATIVE:
            scalars[world, CORRECTION] = wp.max(correction, wp.float64(1.0))
        elif scalars[world, SOLVED_TO] <= TRUSTED:
            promised = scalars[world, SLOPE_NOW]
            if correction <= tolerance or promised <= tolerance * tolerance * scalars[world, ENERGY_NOW]:
                stop(status, running, world, CONVERGED)


@wp.kernel(enable_backward=False)
def judge_only(
    # In
    sums: Sums,
    inertia: wp.array[wp.float32],
    # In and out
    scalars: wp.array2d[wp.float64],
    status: wp.array[wp.int32],
    running: wp.array[wp.int32],
):
    """Stop worlds whose whole step does not go far beyond the end of the descent, and let the others begin again.

    r . step after the step is that of elastic forces, which the first column of sums has, and of a polynomial; it is
    zero where the derivative is right. What is not finite is left to the run, which goes back.
    """
    world, lane = wp.tid()
    after = add_up(sums, world, lane, SLOPE) + add_up(sums, world, lane, OUTER)
    after -= wp.float64(inertia[0]) * add_up(sums, world, lane, INERTIA)
    if lane == 0 and status[world] == RUNNING:
        if not is_number(after) or after >= -BEYOND * scalars[world, SLOPE_NOW]:
            stop(status, running, world, CONVERGED)
        else:
            scalars[world, SHARE] = wp.float64(0.0)


@wp.kernel(enable_backward=False)
def end_only(
    # In
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    inner_status: wp.array[wp.int32],
    # In and out
    status: wp.array[wp.int32],
):
    """A world with one iteration ended as its linear solve did, and a residual that falls no more is small enough."""
    world = wp.tid()
    if iterations[world] == 1 and status[world] <= STUCK:
        status[world] = wp.where(inner_status[world] == CONVERGED, CONVERGED, LIMIT)
        if inner_status[world] == BROKEN or not is_number(scalars[world, SLOPE_NOW]):
            status[world] = BROKEN
    elif status[world] == STUCK:
        status[world] = CONVERGED
