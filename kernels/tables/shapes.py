"""The three element shapes of the bisected forest, as tables that kernels are generated from.

A tetrahedron of level ``l`` has type ``l mod 3`` and edge length ``h = cell / 2**(l div 3)``. In its own orthonormal
frame the hat functions have gradients ``GRADIENT[type][c][n] / h`` (column ``c`` of the frame, node ``n`` in Maubach
order), so the local-frame displacement gradient is a handful of sums and differences of nodal displacements.

Plain Python numbers: kernels read them through ``wp.static`` and tests read the very same tables. The nodes of the
edges are Warp constants too, for kernels that loop over edges.
"""

import math
import zlib

import warp as wp

SQRT2 = math.sqrt(2.0)

#: Frame columns by node: column c of the local gradient is sum_n GRADIENT[type][c][n] * x_n / h.
GRADIENT: tuple[tuple[tuple[float, ...], ...], ...] = (
    ((-1.0, 1.0, 0.0, 0.0), (0.0, -1.0, 1.0, 0.0), (0.0, 0.0, -1.0, 1.0)),
    ((-1.0, 1.0, 0.0, 0.0), (0.0, -1.0, 1.0, 0.0), (-1.0, 0.0, -1.0, 2.0)),
    ((SQRT2, 0.0, -SQRT2, 0.0), (0.0, SQRT2, -SQRT2, 0.0), (0.0, 0.0, -2.0, 2.0)),
)

#: Rest volume over h^3.
VOLUME: tuple[float, ...] = (1.0 / 6.0, 1.0 / 12.0, 1.0 / 24.0)

#: Node positions of an element of edge length one in its own frame, node by node.
REST: tuple[tuple[tuple[float, float, float], ...], ...] = (
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (1.0, 1.0, 1.0)),
    ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0), (1.0, 1.0, 0.0), (0.5, 0.5, 0.5)),
    ((0.0, 0.0, 0.0), (-1.0 / SQRT2, 1.0 / SQRT2, 0.0), (-1.0 / SQRT2, 0.0, 0.0), (-1.0 / SQRT2, 0.0, 0.5)),
)

#: The six edges of a tetrahedron as pairs of local nodes.
EDGES: tuple[tuple[int, int], ...] = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))

#: Both nodes of each edge, for kernels.
FIRST_NODE = wp.constant(wp.types.vector(length=6, dtype=wp.int32)(*(i for i, _ in EDGES)))
SECOND_NODE = wp.constant(wp.types.vector(length=6, dtype=wp.int32)(*(j for _, j in EDGES)))

#: Lengths of the edges over h.
EDGE_LENGTHS: tuple[tuple[float, ...], ...] = tuple(
    tuple(math.dist(corners[i], corners[j]) for i, j in EDGES) for corners in REST
)

#: Radius of the circumscribed sphere over h.
CIRCUMRADIUS: tuple[float, ...] = (math.sqrt(0.75), math.sqrt(0.5625), math.sqrt(0.3125))

# How an element's shape is packed into one integer (see ``warp_corot.discretization.elements``).
LEVEL_BITS = 6
MIRROR_BIT = 6
FRAME_SHIFT = 7


def fingerprint(*tables: object) -> int:
    """A number that changes with the tables a function is generated from.

    Warp leaves ``wp.static`` expressions that depend on a loop variable out of a module's hash, so a function generated
    from a table must name the table's fingerprint outside its loops, or a stale kernel may be taken from the cache.
    """
    return zlib.crc32(repr(tables).encode()) & 0x7FFFFFFF


def gram(shape: int, i: int, j: int) -> float:
    """Inner product of the gradients of hat functions i and j, times h^2."""
    return sum(GRADIENT[shape][c][i] * GRADIENT[shape][c][j] for c in range(3))


def edge_stiffness(shape: int) -> tuple[list[list[float]], list[list[float]]]:
    """The 6x6 edge-spring stiffness of one shape over h^-1: parts multiplying lambda and mu (Delingette 2008)."""
    first, second = [], []
    for i, j in EDGES:
        c_e = gram(shape, i, j)
        first.append([VOLUME[shape] * 0.25 * c_e * gram(shape, k, m) for k, m in EDGES])
        second.append(
            [
                VOLUME[shape] * 0.25 * (gram(shape, j, k) * gram(shape, i, m) + gram(shape, j, m) * gram(shape, i, k))
                for k, m in EDGES
            ]
        )
    return first, second
