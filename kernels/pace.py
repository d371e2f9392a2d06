"""The time of a simulation on the device: steps done, the length of a step, and the time now.

Kernels read the step from here, so that recorded launches stay valid when it changes. The time is not added up: it is
the time at the last change of the step, and a whole number of steps since then.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Places in ``Pace.counts`` and ``Pace.seconds``.
DONE, DONE_THEN = wp.constant(0), wp.constant(1)
DT, THEN = wp.constant(0), wp.constant(1)
#: Places in ``control``: the step that the state allows, the share of it that is taken, the longest step at rest, the
#: shortest and longest that were taken, by how much the last change made the step shorter [s], how many checks in a row
#: found the bodies calm, whether velocities are a user's, which belong to no step before, how many
#: intervals there are from one check on energies to the next, and the steps done at the last one.
ALLOWED, SHARE, AT_REST, SHORTEST, LONGEST, SHORTENED, CALM, GIVEN, CLOSENESS, FOLLOWED = (
    wp.constant(k) for k in range(10)
)
CONTROLS = 10
#: What a gauge finds of a body: the largest curvature [1/s^2], and the largest strain until the next measurement.
CURVATURE, STRAIN = wp.constant(0), wp.constant(1)
#: What is known of a body at rest: the largest stable step [s], the curvature that was found there, and the shares of a
#: stable step that are safe for small strains and for large ones.
STABLE, REST_CURVATURE, SAFE, SAFE_STRAINED = (wp.constant(k) for k in range(4))

#: Strains |F^T F - I| up to which the first share is safe, and from which on the second is.
SMALL, LARGE = wp.constant(wp.float64(0.1)), wp.constant(wp.float64(0.4))
#: Growth of the step from one measurement to the next at most: what was stiff a moment ago may soon be so again.
GROWTH = wp.constant(wp.float64(1.05))
#: No step is shorter than this share of that at rest.
LEAST = wp.constant(wp.float64(0.002))


@wp.struct
class Pace:
    """The clock, on the device."""

    counts: wp.array[wp.int64]  # [2] steps done; steps done when their length changed last
    seconds: wp.array[wp.float64]  # [2] length of a step; time when it changed last


@wp.func
def time_after(pace: Pace, steps: int):
    """The time some steps after those that are done [s], float64."""
    made = pace.counts[DONE] + wp.int64(steps) - pace.counts[DONE_THEN]
    return pace.seconds[THEN] + wp.float64(made) * pace.seconds[DT]


@wp.func
def change_step(pace: Pace, dt: wp.float64):
    if dt != pace.seconds[DT]:
        pace.seconds[THEN] = time_after(pace, 0)
        pace.counts[DONE_THEN] = pace.counts[DONE]
        pace.seconds[DT] = dt


@wp.kernel(enable_backward=False)
def advance_clock(steps: int, pace: Pace):
    """Count a run of recorded steps; within the run each step carries its offset."""
    pace.counts[DONE] = pace.counts[DONE] + wp.int64(steps)


@wp.kernel(enable_backward=False)
def set_step(dt: wp.float64, pace: Pace):
    change_step(pace, dt)


@wp.kernel(enable_backward=False)
def set_time(time: wp.float64, pace: Pace):
    """Let the time now be exactly this."""
    pace.seconds[THEN] = time
    pace.counts[DONE_THEN] = pace.counts[DONE]


@wp.func
def safe_step(at_rest: wp.array2d[wp.float64], found: wp.array2d[wp.float32], body: int):
    """A step that is stable about the present state and, by a margin, until the next measurement [s]."""
    stiffer = wp.float64(1.0)
    if at_rest[body, REST_CURVATURE] > wp.float64(0.0):
        stiffer = wp.max(wp.float64(found[body, CURVATURE]) / at_rest[body, REST_CURVATURE], stiffer)
    strained = wp.clamp((wp.float64(found[body, STRAIN]) - SMALL) / (LARGE - SMALL), wp.float64(0.0), wp.float64(1.0))
    share = at_rest[body, SAFE] + strained * (at_rest[body, SAFE_STRAINED] - at_rest[body, SAFE])
    return share * at_rest[body, STABLE] / wp.sqrt(stiffer)


@wp.func
def take_allowed_step(control: wp.array[wp.float64], pace: Pace):
    dt = wp.max(control[SHARE] * control[ALLOWED], LEAST * control[AT_REST])
    control[SHORTENED] = pace.seconds[DT] - dt
    if control[GIVEN] != wp.float64(0.0):
        control[SHORTENED] = wp.float64(0.0)
    control[SHORTEST] = wp.min(control[SHORTEST], dt)
    control[LONGEST] = wp.max(control[LONGEST], dt)
    change_step(pace, dt)


@wp.kernel(enable_backward=False)
def take_safe_step(
    # In
    at_rest: wp.array2d[wp.float64],
    # In and out
    found: wp.array2d[wp.float32],
    control: wp.array[wp.float64],
    pace: Pace,
):
    """Take the smallest of the bodies' safe steps: at once where it is shorter than before, slowly where longer."""
    longest = control[AT_REST]
    safe = longest
    for body in range(at_rest.shape[0]):
        safe = wp.min(safe, safe_step(at_rest, found, body))
        found[body, CURVATURE] = 0.0
        found[body, STRAIN] = 0.0
    control[ALLOWED] = wp.min(wp.max(safe, LEAST * longest), GROWTH * control[ALLOWED])
    take_allowed_step(control, pace)
    control[GIVEN] = wp.float64(0.0)


@wp.kernel(enable_backward=False)
def resume_step(control: wp.array[wp.float64], pace: Pace):
    """Take the step that the state allows again, after others that ended at a given time."""
    take_allowed_step(control, pace)
