"""The choice between two ways of solving, by the iterations that each has taken."""

import warp as wp

from .assembled import Couplings
from .conjugate_gradients import CONVERGED

wp.set_module_options({"enable_backward": False})

#: Places in the counts: iterations of the last assembled step and of the last one with multigrid (zero before the
#: first); steps since the way changed, and the number of these after which the other way is tried again.
ASSEMBLED, MULTIGRID, AGE, WAIT = (wp.constant(k) for k in range(4))
COUNTS = 4
#: The least and the most of that number of steps.
SOON, LATE = wp.constant(64), wp.constant(4096)
#: The iterations of an assembled step that has not been solved for, or had more contacts than room.
DEAR = wp.constant(1 << 24)


@wp.kernel(enable_backward=False)
def choose(
    # In
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    touches: int,
    worth: int,
    cost: int,
    couplings: Couplings,
    # In and out
    counts: wp.array[wp.int32],
    is_assembled: wp.array[wp.int32],
):
    """Choose the way of the next step, from the world with the most iterations of this one.

    Args:
        touches: Whether there may be contacts, because of which steps may end before they are solved for either way.
        worth: Multigrid is tried if assembled solves cost as much as so many of its iterations.
        cost: What an iteration of multigrid costs, in assembled ones.
        couplings: The contacts of the last assembled solve.
    """
    most = int(1)
    is_good = couplings.count[0] <= couplings.nodes.shape[0]
    for world in range(iterations.shape[0]):
        most = wp.max(most, iterations[world])
        is_good = is_good and (touches != 0 or status[world] == CONVERGED)
    counts[AGE] = counts[AGE] + 1
    is_over = bool(False)
    is_for_nothing = bool(False)
    if is_assembled[0] != 0:
        if not is_good:
            most = DEAR
        counts[ASSEMBLED] = most
        is_known = counts[MULTIGRID] > 0
        if is_known and counts[AGE] < counts[WAIT]:
            is_over = 5 * cost * counts[MULTIGRID] < 4 * most
        else:
            is_over = most > worth * cost
        is_for_nothing = is_over and is_known and counts[AGE] == 1
    else:
        counts[MULTIGRID] = most
        is_for_nothing = 4 * cost * most > 5 * counts[ASSEMBLED]
        is_over = is_for_nothing or counts[AGE] >= wp.where(counts[ASSEMBLED] == DEAR, LATE, wp.max(counts[WAIT], SOON))
    if is_for_nothing:
        # The trial of this way was for nothing: the next one comes later.
        counts[WAIT] = wp.clamp(2 * counts[WAIT], SOON, LATE)
    if is_over:
        is_assembled[0] = 1 - is_assembled[0]
        counts[AGE] = 0
