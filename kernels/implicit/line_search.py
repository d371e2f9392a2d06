"""The fraction of a linear solve's answer that contacts allow: the first one at which the power along it vanishes.

Along a change c from motions d, the power of all forces is g(s) = c . (b - A d) - s c . A c + contacts(s), with A
without contacts. It falls with s, because all energies are convex. Worlds in which g(1) is not far below zero take the
whole change.
"""

import warp as wp

from warp_corot.kernels.elements.elements import load_node, store_node
from warp_corot.kernels.stepping.sums import Sums, add_up

wp.set_module_options({"enable_backward": False})

#: Columns of a world's search: the current fraction, the ends of the bracket, and the power at these; the power at zero
#: without contacts, and its decrease with the fraction; the power at zero with contacts; the upper end before, with
#: the power there; and the number of fractions that were tried.
TRIED, LOW, HIGH, AT_LOW, AT_HIGH, POWER, LOSS, FIRST, BEFORE, AT_BEFORE, NUMBER = (wp.constant(k) for k in range(11))
COLUMNS = 11
#: Maximum number of fractions that are tried, with 0 and 1.
TRIALS = wp.constant(13)
#: The whole change is taken if the power at its end, over that at its beginning, is at most this in magnitude.
ENOUGH = wp.constant(wp.float64(0.2))
#: A fraction between is taken if the power there is negative, and over that at the beginning at most this in magnitude.
CLOSE = wp.constant(wp.float64(0.05))
#: The power bends in the bracket if it is so many times as far below zero at the upper end as above at the lower one.
BENT = wp.constant(wp.float64(4.0))


@wp.kernel(enable_backward=False)
def begin_search(
    # In
    power: Sums,
    loss: Sums,
    # Out
    search: wp.array2d[wp.float64],
    slopes: wp.array[wp.float64],
    searching: wp.array[wp.int32],
):
    """Begin with a fraction of zero; ``searching`` counts the worlds that search."""
    world, lane = wp.tid()
    first = add_up(power, world, lane, 0)
    second = add_up(loss, world, lane, 0)
    if lane == 0:
        search[world, POWER] = first
        search[world, LOSS] = second
        search[world, TRIED] = wp.float64(0.0)
        search[world, NUMBER] = wp.float64(0.0)
        slopes[world] = wp.float64(0.0)
        if world == 0:
            searching[0] = power.parts.shape[0]


@wp.func
def end_search(world: int, search: wp.array2d[wp.float64], searching: wp.array[wp.int32]):
    search[world, NUMBER] = wp.float64(TRIALS)
    wp.atomic_sub(searching, 0, 1)


@wp.kernel(enable_backward=False)
def take_trial(
    # In and out
    search: wp.array2d[wp.float64],
    slopes: wp.array[wp.float64],
    searching: wp.array[wp.int32],
):
    """Read the power at the current fraction, first 0 and then 1, and choose the next fraction. A world whose bracket
    is empty keeps its fraction.

    Stiff contacts that close on the way bend the power: it falls slowly up to them, and steeply beyond. A secant
    through both ends of the bracket stays near its beginning then, and the middle of the bracket is tried instead.
    Every other fraction, and the last one, comes from a line through the last two upper ends, which meets zero beyond
    the bend.
    """
    world = wp.tid()
    number = int(search[world, NUMBER])
    if number >= TRIALS:
        slopes[world] = wp.float64(0.0)
        return
    search[world, NUMBER] = wp.float64(number + 1)
    s = search[world, TRIED]
    g = search[world, POWER] - s * search[world, LOSS] + slopes[world]
    slopes[world] = wp.float64(0.0)
    if number == 0:
        search[world, FIRST] = g
        search[world, LOW] = s
        search[world, AT_LOW] = g
        search[world, HIGH] = wp.where(g > wp.float64(0.0), wp.float64(1.0), s)
        search[world, AT_HIGH] = wp.float64(0.0)
        search[world, BEFORE] = wp.float64(-1.0)
        search[world, TRIED] = search[world, HIGH]
        if search[world, HIGH] == s:
            end_search(world, search, searching)
        return
    enough = wp.where(number == 1, ENOUGH, CLOSE) * search[world, FIRST]
    if g >= wp.float64(0.0) or g >= -enough:
        search[world, LOW] = s
        search[world, AT_LOW] = wp.max(g, wp.float64(0.0))
    if g < wp.float64(0.0):
        if number > 1:
            search[world, BEFORE] = search[world, HIGH]
            search[world, AT_BEFORE] = search[world, AT_HIGH]
        search[world, HIGH] = s
        search[world, AT_HIGH] = g
    low = search[world, LOW]
    high = search[world, HIGH]
    fall = search[world, AT_LOW] - search[world, AT_HIGH]
    share = high
    if fall > wp.float64(0.0) and high > low:
        share = wp.float64(0.5) * (low + high)
        if -search[world, AT_HIGH] <= BENT * search[world, AT_LOW]:
            share = low + (high - low) * search[world, AT_LOW] / fall
        steep = search[world, AT_HIGH] - search[world, AT_BEFORE]
        if number % 2 == 0 and search[world, BEFORE] > high and steep > wp.float64(0.0):
            beyond = high + (search[world, BEFORE] - high) * search[world, AT_HIGH] / steep
            if beyond > low:
                share = beyond
    search[world, TRIED] = share
    if high <= low or number + 1 == TRIALS:
        end_search(world, search, searching)


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
