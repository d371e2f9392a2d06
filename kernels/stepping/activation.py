"""Active stress that follows keyframes."""

import warp as wp

from .keyframes import key_before
from .pace import Pace, time_after

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def follow_activation(
    # In
    elements: wp.array[wp.int32],
    times: wp.array[wp.float64],
    stress: wp.array2d[wp.float32],
    pace: Pace,
    world_starts: wp.array[wp.float64],
    world_element_count: int,
    offset: int,
    # Out
    activation: wp.array[wp.float32],
):
    """Set the active stress [Pa] to the keyframes' value at the beginning of a step, ``offset`` steps after the last
    counted one.
    """
    k = wp.tid()
    t = elements[k]
    start = world_starts[t // world_element_count]
    now = time_after(pace, offset) - start
    key, s = key_before(times, now)
    row = wp.min(k, stress.shape[1] - 1)
    a = stress[key, row]
    activation[t] = a + s * (stress[key + 1, row] - a)
