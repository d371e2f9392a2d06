"""The code that differs between the three shapes, generated from ``tables.shapes``: sums and differences, and nodes at
rest.
"""

import functools

import warp as wp

from warp_corot.kernels.tables.shapes import GRADIENT, REST, VOLUME, column_sums, fingerprint, force_sums

wp.set_module_options({"enable_backward": False})

mat43 = wp.types.matrix(shape=(4, 3), dtype=wp.float32)


@wp.func
def rest_shape(shape: int):
    """Node positions of a shape of edge length one in its own frame, a row a node."""
    x0 = wp.static(mat43(*(x for node in REST[0] for x in node)))
    if shape == 1:
        x0 = wp.static(mat43(*(x for node in REST[1] for x in node)))
    elif shape == 2:
        x0 = wp.static(mat43(*(x for node in REST[2] for x in node)))
    return x0


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


# --- the explicit stiffness matrix of each shape ---------------------------------------------------------------------
#
# The paper's product with the explicit 12x12 stiffness matrix K_T of each shape, zeros skipped in the generated code.
#
# In its local frame an element of type T, edge length h and isotropic material has
#     K_T = h (lambda STIFFNESS_LAMBDA[T] + mu STIFFNESS_MU[T]),
# rows and columns ordered node by node, x, y, z within a node. Its entries take only a few values, so the code computes
# each value once and then adds and subtracts; entries that are zero are left out when the code is generated. Products
# are for the unmirrored Maubach frame; for a mirrored element, pass the left-handed frame.

vec12 = wp.types.vector(length=12, dtype=wp.float32)


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


def is_zero(shape: int, row: int, col: int) -> bool:
    """Whether an entry of K_T vanishes for every isotropic material."""
    return abs(STIFFNESS_LAMBDA[shape][row][col]) + abs(STIFFNESS_MU[shape][row][col]) < 1e-12


def _canonical(pair: tuple[float, float]) -> tuple[tuple[float, float], float]:
    """An entry up to sign, and the sign."""
    sign = -1.0 if pair < (0.0, 0.0) else 1.0
    return (sign * pair[0] + 0.0, sign * pair[1] + 0.0), sign


class Coefficients:
    """The few values among a matrix's entries, each lambda * l + mu * m, and where they stand.

    Attributes:
        distinct: The values up to sign, (l, m) pairs.
        table: Which of them each entry is, -1 for zero (unless zeros are kept as a value of their own).
        signs: 1 or -1 for each entry.
    """

    def __init__(self, lam: list[list[float]], mu: list[list[float]], *, keep_zeros: bool = False):
        rows = [
            [_canonical((round(a, 12), round(b, 12))) for a, b in zip(p, q, strict=True)]
            for p, q in zip(lam, mu, strict=True)
        ]
        kept = {pair for row in rows for pair, _ in row if keep_zeros or pair != (0.0, 0.0)}
        self.distinct = sorted(kept)
        self.table = [[self.distinct.index(pair) if pair in kept else -1 for pair, _ in row] for row in rows]
        self.signs = [[sign for _, sign in row] for row in rows]


@functools.cache
def stiffness_product(shape: int, skip_zeros: bool = True) -> wp.Function:
    """Generate y = (K_T / h) z for one shape; with ``skip_zeros=False`` all 144 products, the dense baseline."""
    entries = Coefficients(STIFFNESS_LAMBDA[shape], STIFFNESS_MU[shape], keep_zeros=not skip_zeros)
    distinct, table, signs = entries.distinct, entries.table, entries.signs
    count = len(distinct)
    coefficients_t = wp.types.vector(length=count, dtype=wp.float32)

    @wp.func
    def product(z: vec12, mu: float, lam: float):
        _generated_from = wp.static(fingerprint(distinct, table, signs))
        c = coefficients_t()
        for k in range(wp.static(count)):
            c[k] = wp.static(distinct[k][0]) * lam + wp.static(distinct[k][1]) * mu
        y = vec12()
        for i in range(12):
            for j in range(12):
                if wp.static(table[i][j] >= 0):
                    if wp.static(signs[i][j] > 0.0):
                        y[i] += c[wp.static(table[i][j])] * z[j]
                    else:
                        y[i] -= c[wp.static(table[i][j])] * z[j]
        return y

    return product
