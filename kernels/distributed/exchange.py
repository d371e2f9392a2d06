"""Copies of nodal values: between a whole body and its part, and between a part and the buffers that are sent."""

from typing import Any

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def gather_values(places: wp.array[wp.int32], source: wp.array[Any], found: wp.array[Any]):
    """found[i] = source[places[i]]."""
    i = wp.tid()
    found[i] = source[places[i]]


@wp.kernel(enable_backward=False)
def scatter_values(places: wp.array[wp.int32], source: wp.array[Any], found: wp.array[Any]):
    """found[places[i]] = source[i]."""
    i = wp.tid()
    found[places[i]] = source[i]


#: The types of values that GPUs exchange, and the kernels for each.
EXCHANGED = (wp.float32, wp.int32, wp.vec3, wp.vec4, wp.vec3l)
GATHER, SCATTER = (
    {kind: wp.overload(kernel, [wp.array[wp.int32], wp.array[kind], wp.array[kind]]) for kind in EXCHANGED}
    for kernel in (gather_values, scatter_values)
)


@wp.kernel(enable_backward=False)
def move_values(sources: wp.array[wp.int32], targets: wp.array[wp.int32], source: wp.array[Any], found: wp.array[Any]):
    """found[targets[i]] = source[sources[i]]."""
    i = wp.tid()
    found[targets[i]] = source[sources[i]]


# All types of values at once: each later one would compile this module again.
for _kind in (wp.float32, wp.float64, wp.vec3, wp.vec4, wp.int32, wp.uint8):
    wp.overload(move_values, [wp.array[wp.int32], wp.array[wp.int32], wp.array[_kind], wp.array[_kind]])


@wp.kernel(enable_backward=False)
def clear_values(places: wp.array[wp.int32], values: wp.array[Any]):
    """Set the values at some places to zero."""
    values[places[wp.tid()]] = values.dtype(0)


for _kind in (wp.float64, wp.vec3, wp.vec3l, wp.vec4):
    wp.overload(clear_values, [wp.array[wp.int32], wp.array[_kind]])


@wp.kernel(enable_backward=False)
def forget_length(changed: wp.array[wp.int32], before: wp.array[wp.float64]):
    """Note that velocities were written by a user and so belong to steps of any length."""
    if changed[0] != 0:
        before[0] = wp.float64(0.0)
