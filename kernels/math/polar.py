"""Rotations of arrays of matrices."""

import functools

import warp as wp

from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})


@functools.cache
def rotate_all(rotation: wp.Function) -> wp.Kernel:
    @unique_kernel()
    def rotate_all(matrices: wp.array[wp.mat33], rotations: wp.array[wp.mat33]):
        i = wp.tid()
        rotations[i] = rotation(matrices[i])

    return rotate_all
