"""What steps beside obstacles on the CPU visit, and lists to which several threads add; see ``approach``."""

import warp as wp

from warp_corot.kernels.elements.simd8 import on_cpu

from .motion import Dynamics, Surface
from .watch import BESIDE, Near

wp.set_module_options({"enable_backward": False})

#: Flags for places that were not visited in the step before, and for those that may touch something in this one.
LATE, LISTED = wp.constant(16), wp.constant(32)


@wp.struct
class Part:
    """The surface of a body. Its carriers are places, or the nodes that bear them; see ``Visits``."""

    number: int
    place: int  # its first place
    start: int  # its first carrier among ``nodes``
    shift: int  # how much larger the numbers of these are among all carriers
    nodes: Surface
    dynamics: Dynamics


@wp.struct
class Visits:
    """What steps visit. Carriers are all places, [S], and then all nodes that bear places, [B]: [N] = [S + B]."""

    # [N] a displacement, and how far the carrier may go from there before it is due, plus ``came`` then [m]
    budgets: wp.array[wp.vec4]
    # [N] how far the carrier has come to this displacement since all places were visited [m]
    ways: wp.array[wp.float32]
    # of each place that a carrier bears, as in ``Bearing.places``: ``ways`` plus ``came`` at which it is visited [m]
    until: wp.array[wp.float32]
    entries: wp.array[wp.vec4i]  # [S] where these are for the nodes that bear a place
    needs: wp.array[wp.float32]  # [N] how much of their budgets must be left in this step for those that are due [m]
    spans: wp.array[wp.float32]  # [S] the longest edge around a place at rest [m]
    # [2] how far any obstacle has gone since all places were visited, and goes in this step, at most [m]
    came: wp.array[wp.float32]
    step: wp.array[wp.int64]  # [1] the number of the last step
    is_first: wp.array[wp.int32]  # [1] whether this step visits everything
    may_miss: wp.array[wp.int32]  # [1] whether places may not have moved into obstacles unseen
    count: wp.array[wp.int32]  # [1] the number of steps, ever
    body: wp.array[wp.int32]  # [S] the body of a place
    first_place: wp.array[wp.int32]  # [bodies]
    places: wp.array[wp.int32]  # [S] that number at the last visit to a place
    touches: wp.array[wp.int32]  # [O T] the same for an obstacle and a triangle
    contacts: wp.array[wp.int32]  # contacts of places and of pairs that may act, by their numbers in ``mass_split``
    contact_count: wp.array[wp.int32]  # [1]
    carriers: wp.array[wp.int32]  # [N] that number when the motion of a carrier was found last
    # Lists for each body, from its first place or carrier on, and how many there are in each, [bodies]:
    chosen: wp.array[wp.int32]  # [S] the places that are visited in this step
    chosen_count: wp.array[wp.int32]
    due: wp.array[wp.int32]  # [N] those that are due, by their numbers among ``nodes`` of a ``Part``
    due_count: wp.array[wp.int32]
    carrying: wp.array[wp.int32]  # [N] those whose motion is known
    carrying_count: wp.array[wp.int32]
    triangles: wp.array[wp.vec3i]  # [T]
    corner_starts: wp.array[wp.int32]  # [S + 1] the triangles around each place, see ``Skin``
    corners: wp.array[wp.int32]
    # [S] displacements of places at the last search for pairs; how far they have come from there, and go in this step
    # without contact, as carriers [N] do; and the means of these in each world, [W] [m]
    searched: wp.array[wp.vec4]
    gone: wp.array[wp.vec4]
    goes: wp.array[wp.vec4]
    carried: wp.array[wp.vec4]
    mean_gone: wp.array[wp.vec4]
    mean_goes: wp.array[wp.vec4]
    is_shared: int  # whether several threads visit at the same time


# Where one thread works, plain instructions take a fraction of the time of atomic ones.
@wp.func_native(
    on_cpu(
        """
    int& now = wp::index(a, i);
    if (now == value) return false;
    if (is_shared) return __atomic_exchange_n(&now, value, __ATOMIC_RELAXED) != value;
    now = value;
    return true;
""",
        otherwise="return false;\n",
    )
)
def claim(a: wp.array[wp.int32], i: int, value: int, is_shared: int) -> bool:
    """Write a value. Returns whether there was another one, to one thread of those that ask at the same time."""
    ...


@wp.func_native(
    on_cpu("""
    int& end = wp::index(counts, k);
    wp::index(list, first + (is_shared ? __atomic_fetch_add(&end, 1, __ATOMIC_RELAXED) : end++)) = item;
""")
)
def append(list: wp.array[wp.int32], first: int, counts: wp.array[wp.int32], k: int, item: int, is_shared: int):
    """Add an item to the end of the k-th list, which begins at ``first``."""
    ...


@wp.func
def choose(s: int, here: Near, visits: Visits):
    """Visit a place in this step, once. Returns whether it was not chosen before."""
    was = visits.places[s]
    if not claim(visits.places, s, visits.count[0], visits.is_shared):
        return False
    k = visits.body[s]
    append(visits.chosen, visits.first_place[k], visits.chosen_count, k, s, visits.is_shared)
    here.flags[s] = BESIDE | wp.where(was + 1 < visits.count[0], LATE, 0)
    return True


@wp.func_native(
    on_cpu("""
    // The order of numbers that are not negative is that of their bits.
    int* to = reinterpret_cast<int*>(&wp::index(budgets, n)) + 3;
    const int bits = *reinterpret_cast<const int*>(&most);
    if (is_shared) {
        int now = __atomic_load_n(to, __ATOMIC_RELAXED);
        while (bits < now && !__atomic_compare_exchange_n(to, &now, bits, true, __ATOMIC_RELAXED, __ATOMIC_RELAXED));
    } else if (bits < *to) *to = bits;
""")
)
def lower_budget(budgets: wp.array[wp.vec4], n: int, most: float, is_shared: int):
    """Lower a budget to at most a value that is not negative."""
    ...
