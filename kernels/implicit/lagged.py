"""When a preconditioner is set up again, and the choice between two ways of solving, by the iterations of each.

A set-up costs as much as some iterations. It is repeated when the additional iterations since the last one add up to
that cost; the total is then at most about twice the least possible. If a set-up has not helped, the next one comes
later.
"""

import warp as wp

from .assembled import Couplings
from .conjugate_gradients import CONVERGED, RUNNING

wp.set_module_options({"enable_backward": False})


#: Places in the counts: set-ups so far (zero before the first), iterations just after the last one, additional
#: iterations since then, the number of these that is worth a set-up, and iterations of the last solve before the
#: set-up.
SETUPS, FIRST, BEYOND, WORTH, BEFORE = (wp.constant(k) for k in range(5))
COUNTS = 5
#: The set-up that is due: none, one for the present state, or a repetition of the last one whose result has been lost.
NOTHING, PRESENT, AGAIN = (wp.constant(k) for k in range(3))
#: Number of iterations that a set-up is worth, at first and at most.
LEAST_WORTH, MOST_WORTH = wp.constant(8), wp.constant(256)


@wp.kernel(enable_backward=False)
def find_held_changes(inverse_mass: wp.array[wp.float32], held: wp.array[wp.uint8], due: wp.array[wp.int32]):
    """Request a set-up if a free node is now held, or a held one free."""
    i = wp.tid()
    now = wp.where(inverse_mass[i] > 0.0, wp.uint8(0), wp.uint8(1))
    if now != held[i] and due[0] == NOTHING:
        due[0] = PRESENT


@wp.kernel(enable_backward=False)
def keep_state(
    # In
    u: wp.array[wp.vec4],
    inverse_mass: wp.array[wp.float32],
    due: wp.array[wp.int32],
    # In and out
    counts: wp.array[wp.int32],
    # Out
    kept: wp.array[wp.vec4],
    held: wp.array[wp.uint8],
):
    """Record the state of the set-up, unless it is a repetition."""
    i = wp.tid()
    held[i] = wp.where(inverse_mass[i] > 0.0, wp.uint8(0), wp.uint8(1))
    if due[0] != AGAIN or counts[SETUPS] == 0:
        kept[i] = u[i]


@wp.kernel(enable_backward=False)
def note_setup(due: wp.array[wp.int32], counts: wp.array[wp.int32]):
    if due[0] != AGAIN or counts[SETUPS] == 0:
        counts[SETUPS] = counts[SETUPS] + 1
        counts[FIRST] = -1
        counts[BEYOND] = 0
    due[0] = NOTHING


@wp.kernel(enable_backward=False)
def judge_solve(
    # In
    iterations: wp.array[wp.int32],
    status: wp.array[wp.int32],
    # In and out
    counts: wp.array[wp.int32],
    due: wp.array[wp.int32],
):
    """Decide after a solve whether the next one is worth a set-up, from the world with the most iterations."""
    most = int(0)
    is_good = bool(True)
    for world in range(iterations.shape[0]):
        most = wp.max(most, iterations[world])
        if status[world] != CONVERGED and status[world] != RUNNING:
            is_good = False
    if counts[FIRST] < 0:
        counts[FIRST] = most
        worth = int(LEAST_WORTH)
        if counts[SETUPS] > 1 and most >= counts[BEFORE]:
            worth = wp.min(2 * counts[WORTH], MOST_WORTH)
        counts[WORTH] = worth
    else:
        counts[BEYOND] = counts[BEYOND] + wp.max(most - counts[FIRST], 0)
        if counts[BEYOND] >= counts[WORTH] or not is_good:
            due[0] = PRESENT
    counts[BEFORE] = most


#: Places in the counts: iterations of the last assembled step and of the last one with multigrid (zero before the
#: first); steps since the way changed, and the number of these after which the other way is tried again.
ASSEMBLED, MULTIGRID, AGE, WAIT = (wp.constant(k) for k in range(4))
CHOICE_COUNTS = 4
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
