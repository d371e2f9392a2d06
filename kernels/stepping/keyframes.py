"""Keyframes: values at increasing times, linear in between, constant before and after."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def key_before(times: wp.array[wp.float64], t: wp.float64):
    """The last key before t, and how far t is on the way to the next key, 0 to 1. There must be two keys or more.

    Before all keys this is the first key, after them the last but one.
    """
    last = times.shape[0] - 1
    key = int(0)
    while key < last - 1 and times[key + 1] <= t:
        key += 1
    share = (t - times[key]) / (times[key + 1] - times[key])
    return key, float(wp.clamp(share, wp.float64(0.0), wp.float64(1.0)))
