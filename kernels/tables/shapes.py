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

#: Columns of the local displacement gradient times h, by type: a weight, and the differences of nodal values that it
#: multiplies, each as (node, node taken off). Everything else about gradients and forces comes from this table.
DIFFERENCES: tuple[tuple[tuple[float, tuple[tuple[int, int], ...]], ...], ...] = (
    ((1.0, ((1, 0),)), (1.0, ((2, 1),)), (1.0, ((3, 2),))),
    ((1.0, ((1, 0),)), (1.0, ((2, 1),)), (1.0, ((3, 2), (3, 0)))),
    ((SQRT2, ((0, 2),)), (SQRT2, ((1, 2),)), (2.0, ((3, 2),))),
)

#: Frame columns by node: column c of the local gradient is sum_n GRADIENT[type][c][n] * x_n / h.
GRADIENT: tuple[tuple[tuple[float, ...], ...], ...] = tuple(
    tuple(
        tuple(weight * sum((n == node) - (n == other) for node, other in pairs) for n in range(4))
        for weight, pairs in columns
    )
    for columns in DIFFERENCES
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


def _scaled(expression: str, weight: float) -> str:
    return expression if weight == 1.0 else f"-({expression})" if weight == -1.0 else f"({expression}) * {weight!r}f"


def column_sums(shape: int) -> list[str]:
    """The columns of ``DIFFERENCES`` as expressions in C++, of vectors x0 to x3."""
    return [_scaled(" + ".join(f"(x{i} - x{j})" for i, j in pairs), weight) for weight, pairs in DIFFERENCES[shape]]


def force_sums(shape: int) -> list[str]:
    """The forces on the four nodes, -V P grad N, as expressions in C++ of the columns p0 to p2 of P V / h."""
    sums = []
    for node in range(4):
        by_weight: dict[float, list[tuple[bool, str]]] = {}
        for c in range(3):
            weight = -GRADIENT[shape][c][node]
            if weight:
                by_weight.setdefault(abs(weight), []).append((weight < 0, f"p{c}"))
        terms = []
        for weight, columns in by_weight.items():
            sign = min(is_taken_off for is_taken_off, _ in columns)
            added = [name for is_taken_off, name in columns if is_taken_off == sign]
            taken_off = [f" - {name}" for is_taken_off, name in columns if is_taken_off != sign]
            terms.append(_scaled(" + ".join(added) + "".join(taken_off), -weight if sign else weight))
        sums.append(" + ".join(terms))
    return sums
