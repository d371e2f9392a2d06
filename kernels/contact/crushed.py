"""Elements that are turned inside out: more than a body bears."""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import frame, local_gradient

wp.set_module_options({"enable_backward": False})


@functools.cache
def count_crushed(Elements: type) -> wp.Kernel:
    """Count elements with det F < 0."""

    @wp.kernel(module="unique", enable_backward=False)
    def count_crushed(elements: Elements, u: wp.array[wp.vec4], count: wp.array[wp.int32]):
        t = wp.tid()
        q = frame(elements, t)
        if wp.determinant(q + local_gradient(elements, t, u)) * wp.determinant(q) < 0.0:
            wp.atomic_add(count, 0, 1)

    return count_crushed
