"""What may meet of soft surfaces, and the pairs of it that are near.

A row is a pair of a node and a triangle, or of two edges: four nodes with a share each, positive on the one side and
negative on the other, so that the sum of shares times places is the way from the second side to the first.
"""

import warp as wp

from .motion import Surface

wp.set_module_options({"enable_backward": False})

#: Overlaps up to this share of a triangle's or an edge's size are pushed apart; what is deeper is another part of the
#: body. Of a body with itself also this share of the way between the two at rest: neighbours that have passed one
#: another must get back.
BAND, BAND_AT_REST = wp.constant(0.25), wp.constant(0.1)


@wp.struct
class Meeting:
    """What may meet: triangles and edges of the surface, and which body they are of."""

    body: wp.array[wp.int32]  # [S]
    triangles: wp.array[wp.vec3i]  # [T]
    opposite: wp.array[wp.int32]  # [T] the fourth nodes of their tetrahedra, -1 inside the body
    edges: wp.array[wp.vec2i]  # [E] places, -1 where there is none
    sides: wp.array[wp.vec2i]  # [E] their two triangles
    reach: wp.array[wp.float32]  # [S] how far a node may go until pairs are looked for again [m]
    lower: wp.array2d[wp.vec3]  # [worlds, bodies] bounds of all that a body may reach [m]
    upper: wp.array2d[wp.vec3]
    meets_itself: int
    friction: float


@wp.struct
class Rows:
    """Pairs that are near, [P], sorted by the first of the two, a node or an edge of S + E, and then by the other."""

    total: wp.array[wp.int32]  # [1] how many there are, or were if there were room
    starts: wp.array[wp.int32]  # [S + E]
    counts: wp.array[wp.int32]  # [S + E]
    owner: wp.array[wp.int32]  # the node, or S and the edge; -1 for none
    other: wp.array[wp.int32]  # the triangle, or the edge
    places: wp.array[wp.vec4i]
    shares: wp.array[wp.vec4]
    normal: wp.array[wp.vec3]  # from the second to the first
    gap: wp.array[wp.float32]
    acts: wp.array[wp.int32]
    force: wp.array[wp.vec3]  # on the first [N]
    more: wp.array[wp.vec3]


@wp.func
def row_count(rows: Rows):
    return wp.min(rows.total[0], rows.owner.shape[0])


@wp.func
def triangle_normal(surface: Surface, c: wp.vec3i):
    a = surface.x[c[0]]
    return wp.normalize(wp.cross(surface.x[c[1]] - a, surface.x[c[2]] - a))
