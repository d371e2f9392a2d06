"""The closest points of pairs whose surfaces face each other."""

import warp as wp

from .locate import locate_edge, locate_node
from .motion import Surface
from .rows import Meeting, Rows, triangle_normal

wp.set_module_options({"enable_backward": False})

#: The largest cosine between the way to a node beyond a triangle's border and the next triangle.
LEANING = wp.constant(0.1)


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
def leans_over(row: int, surface: Surface, meeting: Meeting, rows: Rows):
    """Whether the way from the border of a triangle to a node leads over a neighbour of the triangle.

    Then the neighbour is closer, and its own pair counts. A plane across that way would hold back what slides over both
    triangles.
    """
    t = rows.other[row]
    c = meeting.triangles[t]
    share = rows.shares[row]
    first = int(-1)
    last = int(-1)
    corners = int(0)
    point = wp.vec3()
    for i in range(3):
        if share[i + 1] < 0.0:
            corners += 1
            last = c[i]
            point -= share[i + 1] * surface.x[c[i]]
            if first < 0:
                first = c[i]
    if corners == 3 or first < 0:
        return False
    n = rows.normal[row]
    for k in range(meeting.corner_starts[first], meeting.corner_starts[first + 1]):
        at = meeting.corners[k] % 3
        other = meeting.corners[k] / 3
        e = meeting.triangles[other]
        q = e[(at + 1) % 3]
        if corners == 2:
            r = e[(at + 2) % 3]
            if other == t or (q != last and r != last):
                continue
            if q == last:
                q = r
        inward = surface.x[q] - point
        along = wp.dot(n, inward)
        if along > 0.0 and along * along > LEANING * LEANING * wp.length_sq(inward):
            return True
    return False


@wp.func
def locate_facing(row: int, surface: Surface, meeting: Meeting, rows: Rows) -> bool:
    """The closest points of a pair; whether it may touch."""
    nodes = meeting.body.shape[0]
    owner = rows.owner[row]
    if owner >= nodes:
        return locate_edge(row, owner - nodes, rows.other[row], surface, meeting, rows)
    if owner < 0 or not locate_node(row, owner, rows.other[row], surface, meeting, rows):
        return False
    if not is_faced(row, owner, surface, meeting, rows):
        return False
    # Within a body, such pairs hold back parts of it that close on one another at rims.
    if meeting.body[owner] == meeting.body[meeting.triangles[rows.other[row]][0]]:
        return True
    return not leans_over(row, surface, meeting, rows)
