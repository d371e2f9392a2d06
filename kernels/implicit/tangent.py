"""Rows of A = a M + b D + c K from products with K and D, and the inverse of A's diagonal blocks."""

import warp as wp

from warp_corot.kernels.elements.elements import add_force, load_node, store_node
from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})

#: Places in ``scales``: a, b and c.
MASS, DAMPING, STIFFNESS = (wp.constant(k) for k in range(3))
#: Eigenvalues of a block that is not definite are raised to this share of the largest.
LEAST = wp.constant(1.0e-3)


@wp.kernel(enable_backward=False)
def finish_rows(
    # In
    scales: wp.array[wp.float32],
    mass: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    x: wp.array[wp.vec4],
    damped: wp.array[wp.vec4],
    # In and out
    y: wp.array[wp.vec4],
):
    """y = a M x + b D x + c y from y = K x and ``damped`` = -D x, one entry without damping; y = x at held nodes."""
    i = wp.tid()
    v = load_node(x, i)
    if inverse_mass[i] > 0.0:
        v = (scales[MASS] * mass[i]) * v + scales[STIFFNESS] * load_node(y, i)
        if damped.shape[0] == y.shape[0]:
            v -= scales[DAMPING] * load_node(damped, i)
    store_node(y, i, v)


@wp.kernel(enable_backward=False)
def finish_blocks(
    # In
    scales: wp.array[wp.float32],
    mass: wp.array[wp.float32],
    inverse_mass: wp.array[wp.float32],
    stiffening: float,
    # In and out
    blocks: wp.array[wp.mat33],
):
    """Find the diagonal blocks of A from those of K; viscous damping counts as ``stiffening`` b K."""
    i = wp.tid()
    block = wp.identity(3, dtype=wp.float32)
    if inverse_mass[i] > 0.0:
        block = (scales[MASS] * mass[i]) * block
        block += (scales[STIFFNESS] + scales[DAMPING] * stiffening) * blocks[i]
    blocks[i] = block


@unique_kernel()
def invert_blocks(blocks: wp.array[wp.mat33], inverses: wp.array[wp.mat33]):
    """Invert symmetric blocks; an indefinite block is made positive definite first."""
    i = wp.tid()
    block = blocks[i]
    block = 0.5 * (block + wp.transpose(block))
    scale = wp.max(wp.max(wp.abs(block[0, 0]), wp.abs(block[1, 1])), wp.abs(block[2, 2]))
    inverse = wp.identity(3, dtype=wp.float32)
    if scale > 0.0 and scale < 3.0e38:
        a = block / scale
        minor = a[0, 0] * a[1, 1] - a[0, 1] * a[0, 1]
        d = wp.determinant(a)
        if a[0, 0] > LEAST and minor > LEAST * LEAST and d > LEAST * LEAST * LEAST:
            inverse = wp.inverse(a) / scale
        else:
            q, values = wp.eig3(a)
            most = wp.max(wp.max(wp.abs(values[0]), wp.abs(values[1])), wp.abs(values[2]))
            least = wp.max(LEAST * most, LEAST)
            kept = wp.vec3(
                1.0 / wp.max(wp.abs(values[0]), least),
                1.0 / wp.max(wp.abs(values[1]), least),
                1.0 / wp.max(wp.abs(values[2]), least),
            )
            inverse = (q * wp.diag(kept) * wp.transpose(q)) / scale
    inverses[i] = inverse


@wp.kernel(enable_backward=False)
def apply_blocks(blocks: wp.array[wp.mat33], r: wp.array[wp.vec4], z: wp.array[wp.vec4]):
    """z = B r, block by block."""
    i = wp.tid()
    store_node(z, i, blocks[i] * load_node(r, i))


@wp.kernel(enable_backward=False)
def add_products(
    first: wp.array[wp.int32],
    second: wp.array[wp.int32],
    blocks: wp.array[wp.mat33],
    x: wp.array[wp.vec4],
    y: wp.array[wp.vec4],
):
    """y += A x of blocks of A at pairs of nodes, which may repeat."""
    k = wp.tid()
    add_force(y, first[k], blocks[k] * load_node(x, second[k]))
