"""Places of contact between nodes, such as points of an organ's own surface: the nodes around a place bear it.

A place moves as the weighted mean of its bearers, and they divide its force in the same proportion, so that forces,
torques and work are those of the place. Places that share a bearer move together: each force moves all of them.
"""

import warp as wp

from .motion import Foreseen, Surface

wp.set_module_options({"enable_backward": False})


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
    surface.rest[s] = place.rest
    surface.x[s] = place.x
    surface.d[s] = place.d
    surface.yielding[s] = place.yielding
    surface.bearing.loose[s] = wp.clamp(place.loose, 0.0, 1.0)
    surface.bearing.held[s] = place.held


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
