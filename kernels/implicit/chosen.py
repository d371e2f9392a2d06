"""The choice between two ways of solving, by the iterations that each has taken."""

import warp as wp

wp.set_module_options({"enable_backward": False})

#: Places in the counts: iterations of the last assembled solve and of the last one with multigrid (zero before the
#: first); steps since the other way was tried, and the number of these after which it is tried again.
ASSEMBLED, MULTIGRID, AGE, WAIT = (wp.constant(k) for k in range(4))
COUNTS = 4
#: The way that is not in use is tried again after so many steps, at first and at most.
SOON, LATE = wp.constant(64), wp.constant(4096)
#: Multigrid is tried if assembled solves cost as much as so many of its iterations.
WORTH = wp.constant(10)


@wp.kernel(enable_backward=False)
def choose(
    # In
    iterations: wp.array[wp.int32],
    cost: int,
    # In and out
    counts: wp.array[wp.int32],
    is_assembled: wp.array[wp.int32],
):
    """Choose the way of the next step, from the world with the most iterations of this one.

    Args:
        cost: What an iteration of multigrid costs, in assembled ones.
    """
    most = int(1)
    for world in range(iterations.shape[0]):
        most = wp.max(most, iterations[world])
    counts[AGE] = counts[AGE] + 1
    if is_assembled[0] != 0:
        counts[ASSEMBLED] = most
        is_known = counts[MULTIGRID] > 0
        is_dear = most > WORTH * cost and (not is_known or counts[AGE] >= counts[WAIT])
        if is_dear or (is_known and 5 * cost * counts[MULTIGRID] < 4 * most and counts[AGE] < counts[WAIT]):
            is_assembled[0] = 0
            counts[AGE] = 0
        return
    counts[MULTIGRID] = most
    if 4 * cost * most > 5 * counts[ASSEMBLED]:
        # The trial was for nothing: the next one comes later.
        is_assembled[0] = 1
        counts[WAIT] = wp.clamp(2 * counts[WAIT], SOON, LATE)
        counts[AGE] = 0
    elif counts[AGE] >= wp.max(counts[WAIT], SOON):
        is_assembled[0] = 1
        counts[AGE] = 0
