"""Worlds of a Newton model with a failure: found, restored, and reported; and worlds that are reset.

Entities in no world (-1) use the last entry of arrays over worlds.
"""

import warp as wp

from warp_corot.kernels.stepping.integrate import is_finite

wp.set_module_options({"enable_backward": False})

# Failures of a world in this step; the report keeps the largest number of a world with a failure, plus one.
# Of two failures, the graver one has the larger number.
SOUND = wp.constant(0)
UNSTABLE = wp.constant(1)
TOO_MANY_CONTACTS = wp.constant(2)
TOO_MANY_PAIRS = wp.constant(3)
BAD_INPUT = wp.constant(4)
REPORTS = 5

#: What particles had in the last step, if not ``rows.Row.ease``: nobody knows; no row.
UNKNOWN_BEFORE, NO_ROW = wp.constant(-2.0), wp.constant(-1.0)

#: Newton's default for the largest speed of a particle [m/s]. Beyond it the state is a failure.
RUNAWAY = wp.constant(1.0e5)


@wp.func
def place_of(world: int, count: int):
    """A world's entry in an array over worlds; the last one stands for no world."""
    return wp.where(world < 0, count - 1, world)


@wp.kernel(enable_backward=False)
def check_particles(
    # In
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
    fastest: float,
    world: wp.array[wp.int32],
    # Out
    trouble: wp.array[wp.int32],
):
    i = wp.tid()
    if not (is_finite(q[i]) and wp.max(wp.abs(qd[i])) < 0.5 * fastest):
        wp.atomic_max(trouble, place_of(world[i], trouble.shape[0]), UNSTABLE)


@wp.kernel(enable_backward=False)
def put_back_particles(
    # In
    world: wp.array[wp.int32],
    trouble: wp.array[wp.int32],
    before_q: wp.array[wp.vec3],
    before_qd: wp.array[wp.vec3],
    kept_q: wp.array[wp.vec3],
    kept_qd: wp.array[wp.vec3],
    # Out
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
):
    """Undo what was written to particles of marked worlds.

    Args:
        before_q, before_qd: The state before the step.
        kept_q, kept_qd: Former values of the output state, for worlds whose input was not finite; or empty,
            if those were not written.
    """
    i = wp.tid()
    wrong = trouble[place_of(world[i], trouble.shape[0])]
    if wrong == BAD_INPUT:
        if kept_q.shape[0] > 0:
            q[i] = kept_q[i]
            qd[i] = kept_qd[i]
    elif wrong != SOUND:
        q[i] = before_q[i]
        qd[i] = before_qd[i]


@wp.kernel(enable_backward=False)
def check_bodies(
    # In
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
    world: wp.array[wp.int32],
    wrong: int,
    # Out
    trouble: wp.array[wp.int32],
):
    b = wp.tid()
    size = wp.dot(wp.abs(q[b][0:3]), wp.vec3(1.0)) + wp.dot(wp.abs(wp.spatial_top(qd[b])), wp.vec3(1.0))
    size += wp.dot(wp.abs(wp.spatial_bottom(qd[b])), wp.vec3(1.0))
    if not (size <= 3.0e38):
        wp.atomic_max(trouble, place_of(world[b], trouble.shape[0]), wrong)


@wp.kernel(enable_backward=False)
def put_back_bodies(
    # In
    world: wp.array[wp.int32],
    trouble: wp.array[wp.int32],
    before_q: wp.array[wp.transform],
    before_qd: wp.array[wp.spatial_vector],
    kept_q: wp.array[wp.transform],
    kept_qd: wp.array[wp.spatial_vector],
    # Out
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
):
    """Undo what a rigid solver wrote to bodies of marked worlds; like ``put_back_particles``."""
    b = wp.tid()
    wrong = trouble[place_of(world[b], trouble.shape[0])]
    if wrong == BAD_INPUT:
        q[b] = kept_q[b]
        qd[b] = kept_qd[b]
    elif wrong != SOUND:
        q[b] = before_q[b]
        qd[b] = before_qd[b]


@wp.kernel(enable_backward=False)
def report_trouble(
    # In and out
    trouble: wp.array[wp.int32],
    # Out
    report: wp.array[wp.int32],
    seen: wp.array[wp.float64],
):
    """Record the failure and its world, and clear failures for the next step.

    Args:
        seen: Whether there was a failure, in the host's memory.
    """
    w = wp.tid()
    wrong = trouble[w]
    if wrong != SOUND:
        wp.atomic_max(report, wrong, w + 1)
        seen[0] = wp.float64(1.0)
        trouble[w] = SOUND


@wp.kernel(enable_backward=False)
def reset_particles(
    # In
    chosen: wp.array[wp.bool],
    world: wp.array[wp.int32],
    with_q: int,
    with_qd: int,
    initial_q: wp.array[wp.vec3],
    initial_qd: wp.array[wp.vec3],
    # Out
    q: wp.array[wp.vec3],
    qd: wp.array[wp.vec3],
):
    i = wp.tid()
    if chosen[place_of(world[i], chosen.shape[0])]:
        if with_q != 0:
            q[i] = initial_q[i]
        if with_qd != 0:
            qd[i] = initial_qd[i]


@wp.kernel(enable_backward=False)
def reset_rotations(
    # In
    chosen: wp.array[wp.bool],
    world: wp.array[wp.int32],
    tets: wp.array[wp.vec4i],
    # Out
    rotations: wp.array[wp.quat],
):
    """Reset the rotations of elements in chosen worlds to the identity; an element is in the world of its nodes."""
    t = wp.tid()
    if chosen[place_of(world[tets[t][0]], chosen.shape[0])]:
        rotations[t] = wp.quat_identity()


@wp.kernel(enable_backward=False)
def reset_bodies(
    # In
    chosen: wp.array[wp.bool],
    world: wp.array[wp.int32],
    with_q: int,
    with_qd: int,
    initial_q: wp.array[wp.transform],
    initial_qd: wp.array[wp.spatial_vector],
    # Out
    q: wp.array[wp.transform],
    qd: wp.array[wp.spatial_vector],
):
    b = wp.tid()
    if chosen[place_of(world[b], chosen.shape[0])]:
        if with_q != 0:
            q[b] = initial_q[b]
        if with_qd != 0:
            qd[b] = initial_qd[b]
