"""The force on a tool, for a thread of the host that reads it without waiting.

There are two slots and a count. One kernel writes the older slot, and a second kernel, after it on the stream, raises
the count. A reader that finds the same count before and after reading the newest slot has read one state.
"""

import warp as wp

from warp_corot.kernels.contact.motion import Motions
from warp_corot.kernels.stepping.pace import Pace, time_after

wp.set_module_options({"enable_backward": False})

#: Numbers in a slot: time [s], stamp of the device's position [s], position [m], quaternion, force [N], torque [N m].
TIME, STAMP, POSE, WRENCH = (wp.constant(k) for k in (0, 1, 2, 9))
SLOT = wp.constant(15)


@wp.kernel(enable_backward=False)
def write_slot(
    # In
    o: int,
    wrenches: wp.array2d[wp.spatial_vectorf],
    motions: Motions,
    pace: Pace,
    stamp: wp.array[wp.float64],
    count: wp.array[wp.int64],
    # Out
    shared: wp.array[wp.float64],
):
    """Write the state of obstacle ``o`` of the first world; the count lies before the slots."""
    first = 1 + int((count[0] + wp.int64(1)) % wp.int64(2)) * SLOT
    shared[first + TIME] = time_after(pace, 0)
    shared[first + STAMP] = stamp[0]
    pose = motions.later[0, o]
    wrench = wrenches[o, 0]
    for k in range(7):
        shared[first + POSE + k] = wp.float64(pose[k])
    for k in range(6):
        shared[first + WRENCH + k] = wp.float64(wrench[k])


@wp.kernel(enable_backward=False)
def count_slot(count: wp.array[wp.int64], shared: wp.array[wp.float64]):
    count[0] = count[0] + wp.int64(1)
    shared[0] = wp.float64(count[0])
