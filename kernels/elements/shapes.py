"""The code that differs between the three shapes, generated from ``tables.shapes``: sums and differences, and nodes at
rest.
"""

import functools

import warp as wp

from warp_corot.kernels.tables.shapes import REST, column_sums, force_sums

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
