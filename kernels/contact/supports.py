"""Overlaps of places that held nodes bear for the most part.

Such a place hardly follows its free nodes. To close an overlap that the held nodes cause, these would have to go by
the overlap over their small share, with forces that grow with the inverse of the share's square. So a part of the
overlap stays: of that which the place would have if its free nodes had the displacement of its held ones. Then forces
are at most those of a place half of which is free, and they end once the free nodes have gone as far as that.
"""

import warp as wp

from .bearing import is_borne, loose_share
from .motion import Surface

wp.set_module_options({"enable_backward": False})

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
