"""The forces of obstacles and of near soft surfaces, with all rounds in one launch of one thread block.

Few nodes, triangles and pairs are near a tool. A round is then a chain of loads that wait for one another, and a launch
for each of its parts takes longer than its work. In one block the data stays in the cache of a multiprocessor, and the
parts wait for the block's threads only. The forces are those of the launches in ``touches``, ``triangles`` and
``pairs``.
"""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace
from warp_corot.kernels.stepping.threads import synchronize_block

from .bearing import is_borne
from .near import BESIDE, Near
from .rows import Meeting, Rows, row_count
from .together_items import (
    Sums,
    begin_row,
    begin_touch,
    clear_bearers,
    correct_row,
    correct_touch,
    press_borne,
    push_place,
    weigh_row,
    weigh_touch,
)
from .touches import Touches
from .triangles import BEGIN, CORRECT, END
from .vertices import Rigid

wp.set_module_options({"enable_backward": False})

#: Number of threads of the block.
BLOCK = 512
#: Threads that take the same branch.
WARP = wp.constant(32)
#: The first two passes; further ones are rounds, by turns on triangles and on pairs.
LOCATE, FIND = wp.constant(0), wp.constant(1)


@wp.func
def padded(count: int, threads: int):
    """The number of threads for some items, so that those of a warp have items of one kind."""
    if threads == 1:
        return count
    return (count + WARP - 1) / WARP * WARP


@wp.func
def act(
    thread: int,
    threads: int,
    number: int,
    solves: int,
    on_rows: bool,
    are_borne: int,
    near: Near,
    dt: float,
    triangles: wp.array[wp.vec3i],
    meeting: Meeting,
    rows: Rows,
    touches: Touches,
    rigid: Rigid,
    turn: int,
    sums: Sums,
):
    """All pairs, or all triangles near obstacles and all borne places beside these: find them, see which push, or
    correct their forces if ``solves``.
    """
    k = int(thread)
    if on_rows:
        pairs = row_count(rows)
        while k < pairs:
            if number == LOCATE:
                begin_row(k, rigid.law, rigid.surface, meeting, rows, turn, sums)
            elif solves != 0:
                correct_row(k, rigid.law, dt, rigid.surface, meeting.friction, rows, turn, sums)
            else:
                weigh_row(k, rigid.law, dt, rigid.surface, rows, sums)
            k += threads
        return
    count = near.touch_count[0]
    first = padded(count, threads)
    beyond = wp.where(are_borne != 0, first + near.count[0], count)
    while k < beyond:
        if k < count:
            o = near.touches[k] // triangles.shape[0]
            t = near.touches[k] % triangles.shape[0]
            if number == FIND:
                begin_touch(o, t, rigid, triangles, touches, turn, sums)
            elif solves != 0:
                correct_touch(o, t, rigid.law, dt, rigid.surface, triangles[t], touches, turn, sums)
            else:
                weigh_touch(o, t, rigid.law, dt, rigid.surface, triangles[t], touches, sums)
        elif k >= first:
            s = near.nodes[k - first]
            if (near.flags[s] & BESIDE) != 0 and is_borne(s, rigid.surface):
                press_borne(s, number == FIND, solves, dt, rigid, turn, sums)
        k += threads


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=BLOCK)
def push_together(
    # In
    threads: int,
    near: Near,
    rounds: int,
    are_borne: int,
    triangles: wp.array[wp.vec3i],
    pace: Pace,
    meeting: Meeting,
    # In and out
    rows: Rows,
    touches: Touches,
    rigid: Rigid,
    sums: Sums,
):
    """Make all rounds of a step: in each the forces on triangles, those of pairs, and those on nodes.

    Args:
        threads: The number of threads, all of one block.
        rounds: The number of rounds.
        are_borne: Whether any places are.
    """
    thread = wp.tid()
    dt = float(pace.seconds[DT])
    have_rows = row_count(rows) > 0
    last = wp.max(2 * rounds, FIND) + wp.where(have_rows, 1, 0)
    turn = int(0)
    # One loop, so that the code of each part is there once.
    number = int(FIND)
    if have_rows:
        number = int(LOCATE)
    while number <= last:
        on_rows = number == LOCATE or (number > FIND and number % 2 == 1)
        parts = int(0)
        if number == FIND:
            parts = BEGIN
        elif number > FIND and (on_rows or not have_rows):
            parts = CORRECT
        if number == last:
            parts = parts | END
        solves = int(0)
        while solves < 2:
            # The first two passes have no rounds.
            if solves == 0 or number > FIND:
                act(
                    thread,
                    threads,
                    number,
                    solves,
                    on_rows,
                    are_borne,
                    near,
                    dt,
                    triangles,
                    meeting,
                    rows,
                    touches,
                    rigid,
                    turn,
                    sums,
                )
                synchronize_block()
            solves += 1
        k = int(thread)
        while k < near.count[0]:
            s = near.nodes[k]
            push_place(s, near.flags[s], parts, dt, rigid, turn, sums)
            k += threads
        synchronize_block()
        turn = 1 - turn
        number += 1
        if not have_rows and number % 2 == 1:
            number += 1
    # The last pass has left what moved the places.
    k = int(thread)
    while are_borne != 0 and k < near.count[0]:
        if is_borne(near.nodes[k], rigid.surface):
            clear_bearers(near.nodes[k], 1 - turn, rigid.surface)
        k += threads
