"""Forces of general tetrahedra on CUDA, one thread an element; the solver for Newton uses them.

Two things make them fast. Rest matrices are stored component by component, so that the threads of a warp read
neighbouring numbers, and neighbouring elements' forces are added up before they go to memory. Blocks of 64 threads were
the fastest.
"""

import warp as wp

from warp_corot.kernels.math.matrices import column

from .elements import add_four_forces, load_node

wp.set_module_options({"enable_backward": False})

#: Threads of a block: more wait longer for one another (H200: 64 takes 0.86 of 256).
BLOCK = 64


@wp.struct
class PosedElements:
    """As ``GeneralElements``, stored so that the threads of a warp read neighbouring numbers."""

    nodes: wp.array[wp.vec4i]  # [T]
    rest_inverse: wp.array2d[wp.float32]  # [9, T], row by row
    volume: wp.array[wp.float32]  # [T]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    const int4 n = *reinterpret_cast<const int4*>(&wp::index(nodes, t));
    return wp::vec_t<4, wp::int32>(n.x, n.y, n.z, n.w);
#else
    return wp::index(nodes, t);
#endif
""")
def load_four(nodes: wp.array[wp.vec4i], t: int) -> wp.vec4i:
    """An element's nodes by one 16-byte load; see ``load_node``."""
    ...


@wp.func
def rest_inverse_of(elements: PosedElements, t: int):
    b = elements.rest_inverse
    return wp.mat33(b[0, t], b[1, t], b[2, t], b[3, t], b[4, t], b[5, t], b[6, t], b[7, t], b[8, t])


@wp.func
def edge_differences(nodes: wp.vec4i, x: wp.array[wp.vec4]):
    """The last three nodes' vectors from the first's, columns."""
    x0 = load_node(x, nodes[0])
    return wp.matrix_from_cols(load_node(x, nodes[1]) - x0, load_node(x, nodes[2]) - x0, load_node(x, nodes[3]) - x0)


add_forces = add_four_forces(1)


@wp.func
def add_stress(elements: PosedElements, t: int, nodes: wp.vec4i, p: wp.mat33, f: wp.array[wp.vec4]):
    """Add the nodal forces of element t from its first Piola-Kirchhoff stress."""
    # The rest matrix is read again here, so that it takes no registers in between.
    h = (-elements.volume[t]) * p * wp.transpose(rest_inverse_of(elements, t))
    f1, f2, f3 = column(h, 0), column(h, 1), column(h, 2)
    add_forces(f, nodes, -(f1 + f2 + f3), f1, f2, f3)
