"""The fraction of a linear solve's answer that contacts allow: the first one at which the power along it vanishes.

Along a change c from motions d, the power of all forces is g(s) = c . (b - A d) - s c . A c + contacts(s), with A
without contacts. It falls with s, because all energies are convex. Worlds in which g(1) is not far below zero take the
whole change.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node

from .sums import add_up

wp.set_module_options({"enable_backward": False})

#: Columns of a world's search: the current fraction, the ends of the bracket, and the power at these; the power at zero
#: without contacts, and its decrease with the fraction; the power at zero with contacts, and the
#: bracket's width one trial before.
TRIED, LOW, HIGH, AT_LOW, AT_HIGH, POWER, LOSS, FIRST, WIDTH = (wp.constant(k) for k in range(9))
COLUMNS = 9
#: The whole change is taken if the power at its end, over that at its beginning, is at most this in magnitude.
ENOUGH = wp.constant(wp.float64(0.2))
#: The search ends where the power, over that at the beginning, is at most this in magnitude.
FOUND = wp.constant(wp.float64(0.01))


@wp.kernel(enable_backward=False)
def begin_search(
    # In
    power: wp.array3d[wp.float64],
    loss: wp.array3d[wp.float64],
    lanes: int,
    # Out
    search: wp.array2d[wp.float64],
    slopes: wp.array[wp.float64],
):
    """Begin with a fraction of zero."""
    world, lane = wp.tid()
    first = add_up(power, world, lane, lanes, 0)
    second = add_up(loss, world, lane, lanes, 0)
    if lane == 0:
        search[world, POWER] = first
        search[world, LOSS] = second
        search[world, TRIED] = wp.float64(0.0)
        slopes[world] = wp.float64(0.0)


@wp.kernel(enable_backward=False)
def take_trial(
    # In
    number: int,
    is_last: int,
    # In and out
    search: wp.array2d[wp.float64],
    slopes: wp.array[wp.float64],
):
    """Read the power at the current fraction, first 0 and then 1, and choose the next fraction.

    It is interpolated, or in the middle of a bracket that has not become half as wide: contacts that begin in the
    middle of the change are so stiff that interpolation alone would hardly leave the bracket's lower end. The last
    fraction is the upper end, where such contacts act, so that the next solve knows of them.
    """
    world = wp.tid()
    s = search[world, TRIED]
    g = search[world, POWER] - s * search[world, LOSS] + slopes[world]
    slopes[world] = wp.float64(0.0)
    if number == 0:
        search[world, LOW] = s
        search[world, AT_LOW] = g
        search[world, HIGH] = wp.float64(1.0)
        search[world, AT_HIGH] = wp.float64(0.0)
        search[world, TRIED] = wp.float64(1.0)
        search[world, FIRST] = g
        search[world, WIDTH] = wp.float64(2.0)
        return
    if number == 1:
        if g >= -ENOUGH * search[world, AT_LOW]:
            search[world, LOW] = s
            search[world, AT_LOW] = wp.float64(0.0)
        search[world, AT_HIGH] = g
    elif wp.abs(g) <= FOUND * search[world, FIRST]:
        search[world, LOW] = s
        search[world, HIGH] = s
    elif g >= wp.float64(0.0):
        # Halve the power at the end that stays, so that both ends of the bracket move (Illinois rule).
        search[world, LOW] = s
        search[world, AT_LOW] = g
        search[world, AT_HIGH] = wp.float64(0.5) * search[world, AT_HIGH]
    else:
        search[world, HIGH] = s
        search[world, AT_HIGH] = g
        search[world, AT_LOW] = wp.float64(0.5) * search[world, AT_LOW]
    low = search[world, LOW]
    high = search[world, HIGH]
    fall = search[world, AT_LOW] - search[world, AT_HIGH]
    is_slow = high - low > wp.float64(0.5) * search[world, WIDTH]
    search[world, WIDTH] = high - low
    share = high
    if is_last != 0:
        share = high
    elif is_slow:
        share = wp.float64(0.5) * (low + high)
    elif fall > wp.float64(0.0) and high > low:
        share = low + (high - low) * search[world, AT_LOW] / fall
    search[world, TRIED] = share


@wp.kernel(enable_backward=False)
def add_share(
    # In
    search: wp.array2d[wp.float64],
    count: int,
    change: wp.array[wp.vec4],
    # In and out
    d: wp.array[wp.vec4],
):
    """d += fraction of the change."""
    k = wp.tid()
    share = float(search[k / count, TRIED])
    store_node(d, k, load_node(d, k) + share * load_node(change, k))
