"""Elements that are turned inside out: more than a body bears."""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})


@functools.cache
def count_crushed(Elements: type) -> wp.Kernel:
    """Count elements with det F < 0."""

    @unique_kernel()
    def count_crushed(elements: Elements, u: wp.array[wp.vec4], count: wp.array[wp.int32]):
        t = wp.tid()
        q = frame(elements, t)
        if wp.determinant(q + local_gradient(elements, t, u)) * wp.determinant(q) < 0.0:
            wp.atomic_add(count, 0, 1)

    return count_crushed
