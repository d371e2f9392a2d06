"""The forces of obstacles that can pass between nodes, with all rounds in one launch of one thread block.

Few nodes and triangles are near a tool. A round is then a chain of loads that wait for one another, and a launch for
each of its parts takes longer than its work. In one block the data stays in the cache of a multiprocessor, and the
parts wait for the block's threads only. The answers are those of the launches in ``touches`` and ``triangles``.
"""

import warp as wp

from warp_corot.kernels.stepping.pace import DT, Pace
from warp_corot.kernels.stepping.threads import synchronize_block

from .law import Law
from .motion import Motions, Surface
from .near import Near
from .shapes import Shapes
from .touches import Touches, find_among
from .triangles import ADD, BEGIN, END, Skin, crowd_among, push_among, settle_among, solve_among

wp.set_module_options({"enable_backward": False})

#: Number of threads of the block.
BLOCK = 512


@wp.kernel(enable_backward=False, grid_stride=False, launch_bounds=BLOCK)
def push_together(
    # In
    threads: int,
    near: Near,
    before: int,
    rounds: int,
    parts: int,
    are_borne: int,
    skin: Skin,
    shapes: Shapes,
    motions: Motions,
    law: Law,
    pace: Pace,
    # In and out
    touches: Touches,
    crowd: wp.array[wp.float32],
    surface: Surface,
    forces: wp.array2d[wp.vec3],
    anchors: wp.array2d[wp.vec4],
):
    """Make some rounds of forces on triangles, and the forces on nodes before and after each.

    Args:
        threads: The number of threads, all of one block.
        before: Parts of ``push_nodes`` before the first round. BEGIN also finds the points on triangles.
        rounds: The number of rounds.
        parts: Parts of ``push_nodes`` after each round, END only after the last one.
        are_borne: Whether any places are.
    """
    thread = wp.tid()
    dt = float(pace.seconds[DT])
    doing = int(before)
    if (doing & BEGIN) != 0:
        find_among(thread, threads, near, shapes, motions, law, surface, skin.triangles, touches)
        doing = doing | ADD
        synchronize_block()
    # One loop, so that the code of each part is there once.
    number = int(0)
    while number <= rounds:
        if number > 0:
            crowd_among(thread, threads, near, shapes, motions, law, dt, surface, skin, touches, forces, anchors, crowd)
            synchronize_block()
            solve_among(thread, threads, near, law, dt, surface, skin.triangles, crowd, surface.yielding, touches)
            synchronize_block()
            doing = parts | ADD
            if number < rounds:
                doing = doing & ~END
        push_among(
            thread, threads, near, doing, skin, shapes, motions, law, dt, touches, crowd, surface, forces, anchors
        )
        synchronize_block()
        if are_borne != 0 and (doing & ADD) != 0:
            settle_among(thread, threads, near, doing, shapes, motions, surface, forces, anchors)
            synchronize_block()
        number += 1
