"""The closest points of pairs whose surfaces face each other."""

import warp as wp

from .locate import locate_edge, locate_node
from .motion import Surface
from .rows import Meeting, Rows, triangle_normal

wp.set_module_options({"enable_backward": False})


@wp.func
def is_faced(row: int, s: int, surface: Surface, meeting: Meeting, rows: Rows):
    """Whether the normal of a node at a triangle points into the node's body: otherwise the two face each other
    elsewhere. At a rim, where two faces meet, a node need not be above both.
    """
    out = wp.vec3()
    for k in range(meeting.corner_starts[s], meeting.corner_starts[s + 1]):
        out += triangle_normal(surface, meeting.triangles[meeting.corners[k] / 3])
    return wp.dot(out, rows.normal[row]) <= 0.0


@wp.func
def locate_facing(row: int, surface: Surface, meeting: Meeting, rows: Rows) -> bool:
    """The closest points of a pair; whether it may touch."""
    nodes = meeting.body.shape[0]
    owner = rows.owner[row]
    if owner >= nodes:
        return locate_edge(row, owner - nodes, rows.other[row], surface, meeting, rows)
    if owner < 0 or not locate_node(row, owner, rows.other[row], surface, meeting, rows):
        return False
    return is_faced(row, owner, surface, meeting, rows)
