"""The clock of a simulation on the device: steps done, the length of a step, and the time.

Kernels read the length of the step from here, so that recorded launches stay valid when it changes. The time is not a
sum of steps: it is the time of the last change of the step plus a whole number of steps since then.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Places in ``Pace.counts`` and ``Pace.seconds``.
DONE, DONE_THEN = wp.constant(0), wp.constant(1)
DT, THEN, BEFORE = wp.constant(0), wp.constant(1), wp.constant(2)
#: Places in ``control``: the step that the state allows, the fraction of it that is used, the longest step at rest, and
#: the shortest and longest steps used.
ALLOWED, SHARE, AT_REST, SHORTEST, LONGEST = (wp.constant(k) for k in range(5))
CONTROLS = 5
#: Places in ``orders``, the host's orders for a run: the time at which it ends [s], NEVER if it has no end; the number
#: of steps done by then; and which of the two copies of the state is the last good one.
END, STOP, SLOT = (wp.constant(k) for k in range(3))
ORDERS = 3
#: The end of a run that has none [s].
NEVER = 1e300
#: Results of the gauge for a body: the largest curvature [1/s^2], and the largest strain until the next measurement.
CURVATURE, STRAIN = wp.constant(0), wp.constant(1)
#: Known numbers of a body at rest: the largest stable step [s], the curvature measured there, and the fractions of a
#: stable step that are safe for small strains and for large ones.
STABLE, REST_CURVATURE, SAFE, SAFE_STRAINED = (wp.constant(k) for k in range(4))

#: The first fraction is safe up to the first of these strains |F^T F - I|, the second one from the other strain on.
SMALL, LARGE = wp.constant(wp.float64(0.1)), wp.constant(wp.float64(0.4))
#: Largest growth of the step from one measurement to the next: a place that was stiff a moment ago may soon be stiff
#: again.
GROWTH = wp.constant(wp.float64(1.05))
#: The fraction of the thinnest obstacle that a node may pass in a step.
PASSED = wp.constant(wp.float64(0.2))
#: No step is shorter than this fraction of the step at rest.
LEAST = wp.constant(wp.float64(0.002))


@wp.struct
class Pace:
    """The clock, on the device."""

    counts: wp.array[wp.int64]  # [2] steps done; steps done when their length changed last
    # [3] length of a step; time when it changed last; length of the step by half of which velocities are behind
    # displacements, zero if a user wrote them: then it is the length of a step
    seconds: wp.array[wp.float64]


@wp.func
def time_after(pace: Pace, steps: int):
    """The time after ``steps`` more steps [s], float64."""
    made = pace.counts[DONE] + wp.int64(steps) - pace.counts[DONE_THEN]
    return pace.seconds[THEN] + wp.float64(made) * pace.seconds[DT]


@wp.func
def length_before(pace: Pace):
    """The length of the last step [s], float64; velocities are half of it behind displacements.

    If the next step is longer or shorter, forces act for half of each. Otherwise energy would grow at every bounce,
    where steps shorten as a body stiffens and lengthen as it springs back, and whenever steps are fitted to the end of
    a run.
    """
    before = pace.seconds[BEFORE]
    return wp.where(before > wp.float64(0.0), before, pace.seconds[DT])


@wp.func
def change_step(pace: Pace, dt: wp.float64):
    if dt != pace.seconds[DT]:
        pace.seconds[THEN] = time_after(pace, 0)
        pace.counts[DONE_THEN] = pace.counts[DONE]
        pace.seconds[DT] = dt


@wp.kernel(enable_backward=False)
def advance_clock(steps: int, pace: Pace):
    """Count the steps of a recorded run; within the run each step has its own offset."""
    pace.counts[DONE] = pace.counts[DONE] + wp.int64(steps)
    pace.seconds[BEFORE] = pace.seconds[DT]


@wp.kernel(enable_backward=False)
def set_time(time: wp.float64, pace: Pace):
    """Set the present time [s]."""
    pace.seconds[THEN] = time
    pace.counts[DONE_THEN] = pace.counts[DONE]


@wp.func
def safe_step(at_rest: wp.array2d[wp.float64], found: wp.array2d[wp.float32], body: int):
    """A step that is stable at the present state and, with a margin, until the next measurement [s]."""
    stiffer = wp.float64(1.0)
    if at_rest[body, REST_CURVATURE] > wp.float64(0.0):
        stiffer = wp.max(wp.float64(found[body, CURVATURE]) / at_rest[body, REST_CURVATURE], stiffer)
    strained = wp.clamp((wp.float64(found[body, STRAIN]) - SMALL) / (LARGE - SMALL), wp.float64(0.0), wp.float64(1.0))
    share = at_rest[body, SAFE] + strained * (at_rest[body, SAFE_STRAINED] - at_rest[body, SAFE])
    return share * at_rest[body, STABLE] / wp.sqrt(stiffer)


@wp.func
def allowed_step(control: wp.array[wp.float64]):
    return wp.max(control[SHARE] * control[ALLOWED], LEAST * control[AT_REST])


@wp.func
def take_allowed_step(control: wp.array[wp.float64], pace: Pace):
    dt = allowed_step(control)
    control[SHORTEST] = wp.min(control[SHORTEST], dt)
    control[LONGEST] = wp.max(control[LONGEST], dt)
    change_step(pace, dt)


@wp.kernel(enable_backward=False)
def take_safe_step(
    # In
    at_rest: wp.array2d[wp.float64],
    # In and out
    found: wp.array2d[wp.float32],
    motion_rates: wp.array[wp.float32],
    control: wp.array[wp.float64],
    pace: Pace,
):
    """Use the smallest of the bodies' safe steps: at once if it is shorter than before, gradually if it is longer.

    No step is so long that a node could pass through an obstacle in it; ``System.motion_rates`` has the speeds.
    """
    longest = control[AT_REST]
    safe = longest
    for body in range(at_rest.shape[0]):
        safe = wp.min(safe, safe_step(at_rest, found, body))
        found[body, CURVATURE] = 0.0
        found[body, STRAIN] = 0.0
    rate = wp.float64(motion_rates[0]) + wp.float64(motion_rates[1])
    motion_rates[1] = 0.0
    if rate > wp.float64(0.0):
        safe = wp.min(safe, PASSED / rate)
    control[ALLOWED] = wp.min(wp.max(safe, LEAST * longest), GROWTH * control[ALLOWED])
    take_allowed_step(control, pace)


@wp.kernel(enable_backward=False)
def resume_step(control: wp.array[wp.float64], pace: Pace):
    """Return to the step that the state allows, after steps that ended at a given time."""
    take_allowed_step(control, pace)


@wp.kernel(enable_backward=False)
def take_orders(given: wp.array[wp.float64], orders: wp.array[wp.float64], changed: wp.array[wp.int32]):
    """Begin a run: copy the orders from the host's memory, since reading it from every thread would be slow."""
    for k in range(ORDERS):
        orders[k] = given[k]
    changed[0] = 0


@wp.kernel(enable_backward=False)
def fit_step(orders: wp.array[wp.float64], control: wp.array[wp.float64], pace: Pace):
    """Choose the length of the remaining steps so that the run ends at its time.

    All have the same length, no longer than the state allows. If the state allows less than the host knew when it gave
    its orders, the run ends early, and the host orders more steps.
    """
    dt = allowed_step(control)
    left = orders[END] - time_after(pace, 0)
    steps = orders[STOP] - wp.float64(pace.counts[DONE])
    if left > wp.float64(0.0) and left <= steps * dt * wp.float64(1.0 + 1e-9):
        dt = left / steps
    change_step(pace, dt)


@wp.func
def key_before(times: wp.array[wp.float64], t: wp.float64):
    """The last key before t, and how far t is on the way to the next key, 0 to 1. There must be two keys or more.

    Before all keys this is the first key, after them the last but one.
    """
    last = times.shape[0] - 1
    key = int(0)
    while key < last - 1 and times[key + 1] <= t:
        key += 1
    share = (t - times[key]) / (times[key + 1] - times[key])
    return key, float(wp.clamp(share, wp.float64(0.0), wp.float64(1.0)))
