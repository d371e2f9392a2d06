"""Active stress that follows keyframes."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def follow_activation(
    # In
    elements: wp.array[wp.int32],
    times: wp.array[wp.float64],
    stress: wp.array2d[wp.float32],
    dt: float,
    clock: wp.array[wp.int64],
    world_starts: wp.array[wp.float64],
    world_element_count: int,
    offset: int,
    # Out
    activation: wp.array[wp.float32],
):
    """Active stress by its keyframes at the beginning of a step, ``offset`` steps after the clock's last count."""
    k = wp.tid()
    t = elements[k]
    start = world_starts[t // world_element_count]
    now = (wp.float64(clock[0] + wp.int64(offset)) - start) * wp.float64(dt)
    last = times.shape[0] - 1
    key = int(0)
    while key < last - 1 and times[key + 1] <= now:
        key += 1
    s = wp.clamp((now - times[key]) / (times[key + 1] - times[key]), wp.float64(0.0), wp.float64(1.0))
    row = wp.min(k, stress.shape[1] - 1)
    a = stress[key, row]
    activation[t] = a + float(s) * (stress[key + 1, row] - a)
