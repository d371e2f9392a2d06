"""Decisions between the linear solves of a step with contact."""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

from .assembled import SETTLED as NEARLY_SOLVED
from .conjugate_gradients import BEGAN, BROKEN, LIMIT, WITHIN

wp.set_module_options({"enable_backward": False})

#: A step is solved for if the residual of a solve begins at less than this many times the tolerance.
SETTLED = wp.constant(wp.float64(NEARLY_SOLVED))
#: Contacts are located again once it begins at less than this many times the tolerance, and either that, or this share
#: of where it began just after they were located: forces that are not in balance are no good multipliers.
NEAR, BALANCED = wp.constant(wp.float64(100.0)), wp.constant(wp.float64(0.3))
#: The part of the forces of contact with which residuals are compared at least: a tool may push a body on which nothing
#: else acts.
OF_CONTACT = wp.constant(0.1)


@wp.kernel(enable_backward=False)
def begin_round(
    # In
    b: wp.array[wp.vec4],
    image: wp.array[wp.vec4],
    # Out
    rest: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
):
    """rest = b - A d, to which the forces of contact are added in r."""
    i = wp.tid()
    given = load_node(b, i) - load_node(image, i)
    store_node(rest, i, given)
    store_node(r, i, given)


@wp.kernel(enable_backward=False)
def find_scale(
    # In
    b: wp.array[wp.vec4],
    rest: wp.array[wp.vec4],
    r: wp.array[wp.vec4],
    # Out
    like: wp.array[wp.vec4],
):
    """What residuals are compared with: b, or a part of the forces of contact where that is larger."""
    i = wp.tid()
    given = load_node(b, i)
    contact = OF_CONTACT * (load_node(r, i) - load_node(rest, i))
    store_node(like, i, wp.max(wp.abs(given), wp.abs(contact)))


@wp.kernel(enable_backward=False)
def judge_round(
    # In
    scalars: wp.array2d[wp.float64],
    iterations: wp.array[wp.int32],
    pairs: wp.array[wp.int32],
    # In and out
    locates: wp.array[wp.int32],
    outer: wp.array[wp.float64],
    rounds: wp.array[wp.int32],
    total: wp.array[wp.int32],
    # Out
    solves: wp.array[wp.int32],
    going: wp.array[wp.int32],
):
    """Count a linear solve. Another one follows if this one had much to do, or if it did not follow just after pairs of
    soft surfaces were located; contacts are located again if it had little to do.

    Args:
        locates: Whether contacts were located before this solve; then whether they are before the next one.
        outer: Squares of the residuals of worlds when contacts had been located.
    """
    is_settled = bool(True)
    is_near = bool(True)
    for world in range(iterations.shape[0]):
        total[world] = total[world] + iterations[world]
        began = scalars[world, BEGAN]
        within = scalars[world, WITHIN]
        if locates[0] != 0 or rounds[0] == 0:
            outer[world] = began
        is_done = began <= SETTLED * SETTLED * within
        is_settled = is_settled and is_done
        is_balanced = is_done or began <= BALANCED * BALANCED * outer[world]
        is_near = is_near and is_balanced and began <= NEAR * NEAR * within
    rounds[0] = rounds[0] + 1
    solves[0] = rounds[0]
    going[0] = wp.where(is_settled and (locates[0] != 0 or pairs[0] == 0), 0, 1)
    locates[0] = wp.where(is_near, 1, 0)


@wp.kernel(enable_backward=False)
def end_rounds(
    # In
    rounds: wp.array[wp.int32],
    most: int,
    # In and out
    going: wp.array[wp.int32],
    # Out
    status: wp.array[wp.int32],
):
    """End the solves of a step after ``most`` of them; the step is unfinished if another one should follow."""
    if going[0] != 0 and rounds[0] >= most:
        going[0] = 0
        for world in range(status.shape[0]):
            if status[world] != BROKEN:
                status[world] = LIMIT
