"""The code that differs between the three shapes, generated from ``tables.shapes``: sums and differences."""

import functools

import warp as wp

from warp_corot.kernels.tables.shapes import GRADIENT, VOLUME, column_sums, force_sums

wp.set_module_options({"enable_backward": False})

mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@functools.cache
def columns_of(shape: int) -> wp.Function:
    """Differences of four nodes' vectors: the local gradient's columns times the edge length, or those of F."""
    first, second, third = (_of_nodes(expression) for expression in column_sums(shape))

    @wp.func
    def columns(x0: wp.vec3, x1: wp.vec3, x2: wp.vec3, x3: wp.vec3):
        return first(x0, x1, x2, x3), second(x0, x1, x2, x3), third(x0, x1, x2, x3)

    return columns


@functools.cache
def leaf_forces_of(shape: int) -> wp.Function:
    """Forces on the four nodes from the columns of the stress times V / h."""
    first, second, third, fourth = (_of_columns(expression) for expression in force_sums(shape))

    @wp.func
    def leaf_forces(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3):
        return first(p0, p1, p2), second(p0, p1, p2), third(p0, p1, p2), fourth(p0, p1, p2)

    return leaf_forces


@functools.cache
def _of_nodes(expression: str) -> wp.Function:
    @wp.func_native(f"return {expression};")
    def sum_of_nodes(x0: wp.vec3, x1: wp.vec3, x2: wp.vec3, x3: wp.vec3) -> wp.vec3: ...

    return sum_of_nodes


@functools.cache
def _of_columns(expression: str) -> wp.Function:
    @wp.func_native(f"return {expression};")
    def sum_of_columns(p0: wp.vec3, p1: wp.vec3, p2: wp.vec3) -> wp.vec3: ...

    return sum_of_columns


# --- the stiffness matrix of each shape -------------------------------------------------------------------------------
#
# In its local frame an element of type T, edge length h and isotropic material has
#     K_T = h (lambda STIFFNESS_LAMBDA[T] + mu STIFFNESS_MU[T]),
# rows and columns ordered node by node, x, y, z within a node. Its entries take only a few values.


def _stiffness(shape: int) -> tuple[list[list[float]], list[list[float]]]:
    w, volume = GRADIENT[shape], VOLUME[shape]
    lam = [[0.0] * 12 for _ in range(12)]
    mu = [[0.0] * 12 for _ in range(12)]
    for row in range(12):
        n, a = divmod(row, 3)
        for col in range(12):
            m, b = divmod(col, 3)
            lam[row][col] = volume * w[a][n] * w[b][m]
            laplace = sum(w[c][n] * w[c][m] for c in range(3)) if a == b else 0.0
            mu[row][col] = volume * (laplace + w[b][n] * w[a][m])
    return lam, mu


_TABLES = tuple(_stiffness(shape) for shape in range(3))

#: The part of K_T / h that lambda multiplies [type][12][12].
STIFFNESS_LAMBDA = tuple(tables[0] for tables in _TABLES)
#: The part of K_T / h that mu multiplies [type][12][12].
STIFFNESS_MU = tuple(tables[1] for tables in _TABLES)


def _canonical(pair: tuple[float, float]) -> tuple[tuple[float, float], float]:
    """An entry up to sign, and the sign."""
    sign = -1.0 if pair < (0.0, 0.0) else 1.0
    return (sign * pair[0] + 0.0, sign * pair[1] + 0.0), sign


class Coefficients:
    """The few values among a matrix's entries, each lambda * l + mu * m, and where they stand.

    Attributes:
        distinct: The values up to sign, (l, m) pairs.
        table: Which of them each entry is, -1 for zero.
        signs: 1 or -1 for each entry.
    """

    def __init__(self, lam: list[list[float]], mu: list[list[float]]):
        rows = [
            [_canonical((round(a, 12), round(b, 12))) for a, b in zip(p, q, strict=True)]
            for p, q in zip(lam, mu, strict=True)
        ]
        kept = {pair for row in rows for pair, _ in row if pair != (0.0, 0.0)}
        self.distinct = sorted(kept)
        self.table = [[self.distinct.index(pair) if pair in kept else -1 for pair, _ in row] for row in rows]
        self.signs = [[sign for _, sign in row] for row in rows]
