"""Boxes about triangles and edges, as far as these may reach before the next search."""

import warp as wp

from .motion import Surface
from .rows import BAND, Meeting

wp.set_module_options({"enable_backward": False})

#: Where boxes of nothing are [m].
NOWHERE = wp.constant(1.0e6)


@wp.func
def triangle_size(surface: Surface, c: wp.vec3i):
    a = surface.x[c[0]]
    return wp.sqrt(wp.length(wp.cross(surface.x[c[1]] - a, surface.x[c[2]] - a)))


@wp.func
def triangle_reach(surface: Surface, meeting: Meeting, c: wp.vec3i):
    return wp.max(meeting.reach[c[0]], wp.max(meeting.reach[c[1]], meeting.reach[c[2]]))


@wp.func
def edge_reach(meeting: Meeting, e: wp.vec2i):
    return wp.max(meeting.reach[e[0]], meeting.reach[e[1]])


@wp.kernel(enable_backward=False)
def box_triangles(surface: Surface, meeting: Meeting, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    t = wp.tid()
    c = meeting.triangles[t]
    if c[0] < 0:
        lower[t] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[t] = lower[t]
        return
    a = surface.x[c[0]]
    b = surface.x[c[1]]
    e = surface.x[c[2]]
    far = triangle_reach(surface, meeting, c) + BAND * triangle_size(surface, c)
    beyond = wp.vec3(far, far, far)
    lower[t] = wp.min(a, wp.min(b, e)) - beyond
    upper[t] = wp.max(a, wp.max(b, e)) + beyond


@wp.kernel(enable_backward=False)
def box_edges(surface: Surface, meeting: Meeting, lower: wp.array[wp.vec3], upper: wp.array[wp.vec3]):
    k = wp.tid()
    e = meeting.edges[k]
    if e[0] < 0:
        lower[k] = wp.vec3(NOWHERE, NOWHERE, NOWHERE)
        upper[k] = lower[k]
        return
    a = surface.x[e[0]]
    b = surface.x[e[1]]
    far = edge_reach(meeting, e) + BAND * wp.length(b - a)
    beyond = wp.vec3(far, far, far)
    lower[k] = wp.min(a, b) - beyond
    upper[k] = wp.max(a, b) + beyond
