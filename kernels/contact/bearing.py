"""Places of contact between nodes, such as points of an organ's own surface: the nodes around a place bear it.

A place moves as the weighted mean of its bearers, and they divide its force in the same proportion, so that forces,
torques and work are those of the place. Places that share a bearer move together: each force moves all of them.

Carriers are the nodes that move places in implicit steps, and take the forces there: a place that is a node carries
itself. They are numbered, first all places and then all bearers.
"""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.implicit.assembled import Couplings, couple
from warp_corot.kernels.modules import INLINED
from warp_corot.kernels.stepping.pace import DT

from .motion import Foreseen, Part, Surface

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": INLINED})


@wp.func
def is_borne(s: int, surface: Surface):
    # Without borne places nothing more is loaded than without this module.
    if surface.bearing.bearers.shape[0] == 0:
        return False
    return surface.bearing.bearers[s][0] >= 0


@wp.func
def loose_share(s: int, surface: Surface):
    """The share of a place's weights that free nodes have."""
    if is_borne(s, surface):
        return surface.bearing.loose[s]
    return wp.where(surface.yielding[s] > 0.0, 1.0, 0.0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    for (int k = 0; k < 4; ++k)
        for (int m = 0; m < 4; ++m)
            if (b[k] == c[m] && v[k] != 0.0f && w[m] != 0.0f) return true;
    return false;
#else
    typedef int four __attribute__((vector_size(16)));
    four first, other;
    for (int k = 0; k < 4; ++k) first[k] = v[k] != 0.0f ? b[k] : -1, other[k] = w[k] != 0.0f ? c[k] : -2;
    four same = first == other;
    same |= first == __builtin_shufflevector(other, other, 1, 2, 3, 0);
    same |= first == __builtin_shufflevector(other, other, 2, 3, 0, 1);
    same |= first == __builtin_shufflevector(other, other, 3, 0, 1, 2);
    return __builtin_reduce_or(same) != 0;
#endif
""")
def have_common(b: wp.vec4i, v: wp.vec4, c: wp.vec4i, w: wp.vec4) -> bool:
    """Whether two sets of numbers b and c with weights v and w have a common one whose weights are not zero."""
    ...


@wp.func
def share_bearers(s: int, r: int, surface: Surface):
    """Whether a node bears both of two places, which are then as near each other as two nodes of an element."""
    if not is_borne(s, surface) or not is_borne(r, surface):
        return False
    of = surface.bearing
    return have_common(of.bearers[s], of.weights[s], of.bearers[r], of.weights[r])


@wp.func
def place_among(place: Foreseen, weight: float, own: Foreseen):
    """Add a bearer with a weight to a place."""
    place.rest += weight * own.rest
    place.x += weight * own.x
    place.d += weight * own.d
    place.yielding += weight * weight * own.yielding
    if own.yielding > 0.0:
        place.loose += weight
    else:
        place.held += weight * (own.x - own.rest)
    return place


@wp.func
def store_borne(s: int, place: Foreseen, surface: Surface):
    surface.rest[s] = place.rest
    surface.x[s] = place.x
    surface.d[s] = place.d
    surface.yielding[s] = place.yielding
    surface.bearing.loose[s] = wp.clamp(place.loose, 0.0, 1.0)
    surface.bearing.held[s] = place.held


@wp.func
def find_borne(s: int, bearers: Surface, surface: Surface):
    """Find the position of a borne place, and its motion in this step without contact."""
    b = surface.bearing.bearers[s]
    w = surface.bearing.weights[s]
    place = Foreseen()
    for k in range(4):
        if w[k] != 0.0:
            own = Foreseen()
            own.rest = bearers.rest[b[k]]
            own.x = bearers.x[b[k]]
            own.d = bearers.d[b[k]]
            own.yielding = bearers.yielding[b[k]]
            place = place_among(place, w[k], own)
    store_borne(s, place, surface)


@wp.kernel(enable_backward=False)
def place_borne(start: int, bearers: Surface, surface: Surface):
    """Find the positions of borne places of a body, and their motion in this step without contact."""
    s = start + wp.tid()
    surface.f[s] = wp.vec3()
    surface.yielding[s] = 0.0
    if surface.node[s] >= 0:
        find_borne(s, bearers, surface)


@wp.func
def borne_force(b: int, surface: Surface):
    """The force that a bearer gets from the places that it bears, summed in a fixed order."""
    force = wp.vec3()
    for m in range(surface.bearing.starts[b], surface.bearing.starts[b + 1]):
        force += surface.bearing.shares[m] * surface.f[surface.bearing.places[m]]
    return force


# --- overlaps of places that held nodes bear --------------------------------------------------------------------------

#: Free nodes with a smaller share of the weights than this leave overlaps.
MOSTLY = wp.constant(0.5)


@wp.struct
class Support:
    """What bears one side of a contact."""

    loose: float  # the share of the weights that free nodes have
    total: float  # the sum of the weights
    out: wp.vec3  # the displacement [m]
    held: wp.vec3  # the part of it that comes from held nodes [m]


@wp.func
def add_support(support: Support, s: int, weight: float, surface: Surface):
    """Add a place with a positive weight to the sums so far."""
    out = weight * (surface.x[s] - surface.rest[s])
    support.total += weight
    support.out += out
    if surface.yielding[s] > 0.0:
        support.loose += weight * loose_share(s, surface)
        if is_borne(s, surface):
            support.held += weight * surface.bearing.held[s]
    else:
        support.held += out
    return support


@wp.func
def strayed(support: Support):
    """How far free nodes have moved this side beyond where held ones alone would have it [m]."""
    share = support.total - support.loose
    if share <= 0.0:
        return wp.vec3()
    return support.out - support.held * (support.total / share)


@wp.func
def loose_part(loose: float):
    """The square of the share of free nodes in terms of ``MOSTLY``, at most 1."""
    part = wp.clamp(loose / MOSTLY, 0.0, 1.0)
    return part * part


@wp.func
def left_overlap(gap: float, loose: float, beyond: float):
    """How deep an overlap may stay [m].

    Args:
        gap: The gap [m].
        loose: The sum of both sides' shares of free nodes.
        beyond: How far free nodes have opened the gap beyond where held ones alone would have it [m].
    """
    return (1.0 - loose_part(loose)) * wp.max(beyond - gap, 0.0)


@wp.func
def loose_at(p: wp.vec4i, w: wp.vec4, surface: Surface):
    """The sum of the shares of free nodes at places p with weights w."""
    loose = float(0.0)
    for k in range(4):
        if w[k] != 0.0 and surface.yielding[p[k]] > 0.0:
            loose += wp.abs(w[k]) * loose_share(p[k], surface)
    return loose


@wp.func
def left_between(p: wp.vec4i, w: wp.vec4, gap: float, loose: float, n: wp.vec3, surface: Surface):
    """How deep two sides may stay in each other, with positive and negative shares w at the places p [m]; or one side
    in an obstacle. ``loose``: see ``left_overlap``; less than ``MOSTLY``.
    """
    first = Support()
    second = Support()
    for k in range(4):
        if w[k] > 0.0:
            first = add_support(first, p[k], w[k], surface)
        elif w[k] < 0.0:
            second = add_support(second, p[k], -w[k], surface)
    return left_overlap(gap, loose, wp.dot(n, strayed(first) - strayed(second)))


@wp.func
def left_at(p: wp.vec4i, w: wp.vec4, gap: float, n: wp.vec3, surface: Surface):
    """The same whatever the share of free nodes is."""
    loose = loose_at(p, w, surface)
    if loose >= MOSTLY:
        return 0.0
    return left_between(p, w, gap, loose, n, surface)


# --- carriers in implicit steps ---------------------------------------------------------------------------------------


@wp.struct
class Carriers:
    """Carriers of places, [C] = [S + B]; see ``Surface`` and ``Bearing``."""

    surface: Surface
    entry: wp.array[wp.int32]  # of the node in the vectors of the step; -1: unused
    compliance: wp.array[wp.float32]  # of the node alone [m/N]; zero: it is held
    crowd: wp.array2d[wp.float32]  # [2, C] the sum of weights in obstacles that push, and in pairs
    gone: wp.array[wp.vec3]  # how far a held node has gone in the step [m]


@wp.kernel(enable_backward=False)
def begin_carriers(
    # In
    part: Part,
    first: int,
    blocks: wp.array[wp.mat33],
    increment: wp.array[wp.vec4],
    guess: wp.array[wp.vec4],
    # Out
    carriers: Carriers,
):
    """Where a body's carriers are when a step begins, and how far they may go; held nodes are where it ends.

    Args:
        first: The first entry of the body.
        blocks: The blocks on the diagonal of the body's matrix [N/m].
        increment: How far held nodes have gone in the step [m].
        guess: How far free nodes may go [m].
    """
    s = part.start + wp.tid()
    c = part.shift + s
    surface = part.nodes
    i = surface.node[s]
    surface.f[s] = wp.vec3()
    surface.d[s] = wp.vec3()
    surface.yielding[s] = 0.0
    carriers.compliance[c] = 0.0
    carriers.gone[c] = wp.vec3()
    carriers.entry[c] = -1
    if i < 0:
        return
    home = load_node(part.dynamics.rest, i)
    surface.rest[s] = home
    surface.x[s] = home + load_node(part.dynamics.u, i)
    surface.d[s] = load_node(guess, i)
    carriers.entry[c] = first + i
    if part.dynamics.inverse_mass[i] > 0.0:
        surface.yielding[s] = 1.0
        carriers.compliance[c] = 3.0 / wp.max(wp.trace(blocks[i]), 1.0e-30)
    else:
        # The motion tells the search how fast it is.
        surface.d[s] = load_node(increment, i)
        carriers.gone[c] = surface.d[s]


@wp.func
def carriers_of(s: int, surface: Surface):
    """The numbers of a place's carriers, and its weights, zero for none."""
    if is_borne(s, surface):
        first = surface.node.shape[0]
        return surface.bearing.bearers[s] + wp.vec4i(first, first, first, first), surface.bearing.weights[s]
    return wp.vec4i(s, s, s, s), wp.vec4(1.0, 0.0, 0.0, 0.0)


@wp.func
def motion_at(s: int, carriers: Carriers, d: wp.array[wp.vec4]):
    """The motion of a place after motions d [m]."""
    c, w = carriers_of(s, carriers.surface)
    e = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            e += w[k] * load_node(d, carriers.entry[c[k]])
    return e


@wp.func
def gone_at(s: int, carriers: Carriers):
    """How far held nodes have moved a place in the step [m]."""
    c, w = carriers_of(s, carriers.surface)
    e = wp.vec3()
    for k in range(4):
        if w[k] != 0.0:
            e += w[k] * carriers.gone[c[k]]
    return e


@wp.func
def push_at(s: int, force: wp.vec3, carriers: Carriers, y: wp.array[wp.vec4]):
    """Add a force at a place to its carriers that are free [N]."""
    c, w = carriers_of(s, carriers.surface)
    for k in range(4):
        if w[k] != 0.0 and carriers.compliance[c[k]] > 0.0:
            add_force(y, carriers.entry[c[k]], w[k] * force)


@wp.func
def couple_at(number: int, places: int, s: int, part: wp.vec3, carriers: Carriers, couplings: Couplings):
    """Add a place's free carriers to a product of an assembled matrix with this number, which has ``places`` nodes;
    returns how many it has then."""
    c, w = carriers_of(s, carriers.surface)
    for k in range(4):
        if w[k] != 0.0 and carriers.compliance[c[k]] > 0.0:
            places = couple(number, places, carriers.entry[c[k]], w[k] * part, couplings)
    return places


@wp.func
def crowd_at(kind: int, s: int, share: float, carriers: Carriers):
    """Count a contact that pushes at a place with a share of its force; ``kind``: 1 for pairs, else 0."""
    c, w = carriers_of(s, carriers.surface)
    for k in range(4):
        if w[k] != 0.0:
            wp.atomic_add(carriers.crowd, kind, c[k], wp.abs(w[k] * share))


@wp.func
def ease_at(kind: int, s: int, share: float, carriers: Carriers):
    """How far a contact moves with a place that has this share in it, for each unit of force, if all contacts around
    push alike [m/N].
    """
    c, w = carriers_of(s, carriers.surface)
    total = float(0.0)
    for k in range(4):
        part = wp.abs(share * w[k])
        if part > 0.0:
            total += part * wp.max(carriers.crowd[kind, c[k]], part) * carriers.compliance[c[k]]
    return total


@wp.func
def is_held_at(s: int, carriers: Carriers):
    """Whether all carriers of a place are held."""
    c, w = carriers_of(s, carriers.surface)
    free = bool(False)
    for k in range(4):
        free = free or (w[k] != 0.0 and carriers.compliance[c[k]] > 0.0)
    return not free


@wp.func
def mark_carriers(s: int, mark: int, surface: Surface, marked: wp.array[wp.int32]):
    """Add a mark to the carriers of a place."""
    c, w = carriers_of(s, surface)
    for k in range(4):
        if w[k] != 0.0:
            wp.atomic_or(marked, c[k], mark)


@wp.kernel(enable_backward=False)
def end_carriers(part: Part, surface: Surface, contact_forces: wp.array[wp.vec4]):
    """Write the forces at a body's carriers for users: those at the places of ``surface``."""
    s = part.start + wp.tid()
    i = part.nodes.node[s]
    if i < 0:
        return
    if part.shift > 0:
        part.nodes.f[s] = borne_force(s, surface)
    store_node(contact_forces, i, part.nodes.f[s])


#: What a node has touched is a number of bits: those of ``implicit_rows.mark_acting`` after the last step, and whether
#: these have changed since the step before.
CHANGED = wp.constant(1 << 30)


@wp.kernel(enable_backward=False)
def foresee_places(part: Part, touched: wp.array[wp.int32], begins: wp.array[wp.int32]):
    """Where a body's carriers are, and how far their velocities lead; whether what they touch has changed."""
    s = part.start + wp.tid()
    i = part.nodes.node[s]
    if i < 0:
        return
    home = load_node(part.dynamics.rest, i)
    part.nodes.rest[s] = home
    part.nodes.x[s] = home + load_node(part.dynamics.u, i)
    part.nodes.d[s] = float(part.pace.seconds[DT]) * load_node(part.dynamics.v, i)
    if (touched[i] & CHANGED) != 0:
        begins[0] = 1


@wp.kernel(enable_backward=False)
def note_touched(part: Part, marked: wp.array[wp.int32], touched: wp.array[wp.int32]):
    """What the carriers of a body have touched in the step; none is marked afterwards."""
    s = part.start + wp.tid()
    i = part.nodes.node[s]
    now = marked[part.shift + s]
    marked[part.shift + s] = 0
    if i < 0:
        return
    touched[i] = now | wp.where(now != (touched[i] & (CHANGED - 1)), CHANGED, 0)
