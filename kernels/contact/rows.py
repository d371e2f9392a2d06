"""Rows of contact: an obstacle at a place, an obstacle at a triangle, or a pair of soft surfaces, which is a node at a
triangle, or two edges.

A row has up to four places with weights, positive on the first side and negative on the second, so that the sum of
weights times positions is the vector from the second side to the first.
"""

import warp as wp

from .motion import Surface
from .watch import Watch

wp.set_module_options({"enable_backward": False})

#: Overlaps up to this fraction of a triangle's or an edge's size are pushed apart; a deeper one belongs to another part
#: of the body. In self-contact the limit is also at most this fraction of the distance between the two at rest, so
#: that neighbours that have passed each other get back; the last fraction is for nodes next to a triangle.
BAND, BAND_AT_REST, BAND_OF_NEIGHBOURS = wp.constant(0.25), wp.constant(0.1), wp.constant(0.04)


@wp.struct
class Meeting:
    """What a search for pairs knows of a surface."""

    normals: wp.array[wp.vec3]  # [T] at the last search
    outs: wp.array[wp.vec3]  # [E] the sums of the two normals at each edge, at the last search
    reach: wp.array[wp.float32]  # [S] how far a node may move until the next search for pairs [m]
    ahead: wp.array[wp.vec3]  # see ``Watch``
    roots: wp.array3d[wp.int32]  # [2, worlds, bodies] the bodies' roots in the trees of triangles and of edges; CUDA
    meets_itself: int
    flat_edges: int  # whether flat edges may touch flat edges


@wp.struct
class Rows:
    """Contacts that there may be, [R], and what steps keep of them.

    Those of obstacles are numbered S for each obstacle, and then T for each obstacle. The near pairs of soft surfaces
    are a table of their own, sorted by the first item, a node or an edge of S + E, and then by the second.
    """

    weights: wp.array[wp.vec4]  # of the places, positive on the first side; zero where nothing is near
    normal: wp.array[wp.vec3]  # from the second side to the first, out of an obstacle
    gap: wp.array[wp.float32]  # [m]
    moved: wp.array[wp.vec3]  # motion of the obstacle's point in this step, and of that back to an anchor [m]
    friction: wp.array[wp.float32]
    acts: wp.array[wp.int32]  # see ``mass_split``
    force: wp.array[wp.vec3]  # on the first side [N]
    more: wp.array[wp.vec3]  # its change in the last iteration [N]
    places: wp.array[wp.vec4i]  # of pairs
    total: wp.array[wp.int32]  # [1] how many pairs there are, or were if there were room
    starts: wp.array[wp.int32]  # [S + E]
    counts: wp.array[wp.int32]  # [S + E]
    owner: wp.array[wp.int32]  # the node, or S and the edge; -1 for none
    other: wp.array[wp.int32]  # the triangle, or the edge
    away: wp.array[wp.float32]  # how far the two were apart at the last search, at least [m]; empty on CUDA


@wp.struct
class OldRows:
    """The former rows' data that a search keeps; see ``Rows``."""

    starts: wp.array[wp.int32]  # [S + E]
    counts: wp.array[wp.int32]  # [S + E]
    other: wp.array[wp.int32]
    acts: wp.array[wp.int32]
    force: wp.array[wp.vec3]


@wp.func
def row_count(rows: Rows):
    if rows.owner.shape[0] == 0:
        return 0
    return wp.min(rows.total[0], rows.owner.shape[0])


@wp.func
def triangle_normal(surface: Surface, c: wp.vec3i):
    a = surface.x[c[0]]
    return wp.normalize(wp.cross(surface.x[c[1]] - a, surface.x[c[2]] - a))


@wp.kernel(enable_backward=False)
def keep_rows(watch: Watch, rows: Rows, old: OldRows, most: wp.array[wp.int32]):
    """Copy the present rows, because the search overwrites them; a thread for each node and edge. ``most``: how many
    there have been, or would have been if there had been room."""
    i = wp.tid()
    if watch.due[0] == 0:
        return
    if i == 0:
        most[0] = wp.max(most[0], rows.total[0])
    owners = rows.starts.shape[0]
    old.starts[i] = rows.starts[i]
    old.counts[i] = rows.counts[i]
    row = int(i)
    while row < row_count(rows):
        old.other[row] = rows.other[row]
        old.acts[row] = rows.acts[row]
        old.force[row] = rows.force[row]
        row += owners


@wp.kernel(enable_backward=False)
def begin_rows(watch: Watch, rows: Rows):
    """There are none."""
    if watch.due[0] != 0:
        rows.total[0] = 0
