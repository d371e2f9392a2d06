"""The rounds of forces between soft surfaces in one launch: blocks wait for one another between the parts of a round.

A part takes no longer than two launches need to follow one another. All blocks must run at once, so there are no more
of them than the device has multiprocessors. The forces are those of the launches in ``pairs``, to the last bit if
results must be reproducible.
"""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace
from warp_corot.kernels.stepping.threads import synchronize_blocks

from .bearing import ease
from .law import Law
from .motion import Surface
from .near import PAIRED, Near
from .pairs import LANES, SHARES, apply, judge_row, push_by_warp, solve_row
from .rows import Rows, end_path

wp.set_module_options({"enable_backward": False})

#: Number of threads of a block.
BLOCK = 512


@wp.func
def judge(thread: int, threads: int, law: Law, dt: float, surface: Surface, rows: Rows, crowd: wp.array[wp.int32]):
    """Which pairs act, and the sum of their shares at each node."""
    k = int(thread)
    while k < rows.live_count[0]:
        row = rows.live[k]
        k += threads
        if judge_row(row, law, dt, surface, rows) != 0:
            p = rows.places[row]
            w = rows.shares[row]
            for m in range(4):
                wp.atomic_add(crowd, p[m], int(SHARES * wp.abs(w[m])))


@wp.func
def solve(
    thread: int,
    threads: int,
    law: Law,
    dt: float,
    surface: Surface,
    friction: float,
    crowd: wp.array[wp.int32],
    rows: Rows,
    added: wp.array[wp.vec3l],
):
    """Correct the force of each pair that acts."""
    k = int(thread)
    count = rows.live_count[0]
    # Warps stay together.
    beyond = count + k % wp.min(threads, LANES)
    while k < beyond:
        more = wp.vec3()
        row = int(0)
        if k < count:
            row = rows.live[k]
            if rows.acts[row] != 0:
                p = rows.places[row]
                eases = wp.vec4()
                for m in range(4):
                    eases[m] = ease(p[m], crowd, surface.yielding, surface) / SHARES
                more = solve_row(row, law, dt, surface, friction, eases, rows)
        push_by_warp(row, more, law, rows, added)
        k += threads


@wp.func
def apply_all(
    thread: int,
    threads: int,
    near: Near,
    law: Law,
    surface: Surface,
    rows: Rows,
    added: wp.array[wp.vec3l],
    crowd: wp.array[wp.int32],
):
    """Give nodes what was added to their forces."""
    k = int(thread)
    while k < near.count[0]:
        s = near.nodes[k]
        k += threads
        if (near.flags[s] & PAIRED) != 0:
            apply(s, law, surface, rows, added, crowd)


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=BLOCK)
def make_rounds(
    # In
    threads: int,
    blocks: int,
    rounds: int,
    near: Near,
    law: Law,
    pace: Pace,
    friction: float,
    # In and out
    surface: Surface,
    rows: Rows,
    crowd: wp.array[wp.int32],
    added: wp.array[wp.vec3l],
    arrived: wp.array[wp.uint64],
):
    """Make the rounds of a step, after pairs were located.

    Args:
        threads, blocks: The number of all threads, and of their blocks, which must all run at once.
        arrived: How often blocks have waited for one another, for all steps [1].
    """
    thread = wp.tid()
    dt = float(pace.seconds[DT])
    if thread == 0:
        end_path(rows)
    apply_all(thread, threads, near, law, surface, rows, added, crowd)
    number = int(0)
    while number < rounds:
        synchronize_blocks(blocks, arrived)
        judge(thread, threads, law, dt, surface, rows, crowd)
        synchronize_blocks(blocks, arrived)
        solve(thread, threads, law, dt, surface, friction, crowd, rows, added)
        synchronize_blocks(blocks, arrived)
        apply_all(thread, threads, near, law, surface, rows, added, crowd)
        number += 1
