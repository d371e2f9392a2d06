"""Forces of complete subtrees on CUDA under laws that need no rotation; one thread a subtree, as in ``cuda``."""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import Subtrees, root_of
from warp_corot.kernels.modules import unique_kernel

from .forces import always_trusted, own_forces
from .memory import memory_of

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_subtrees(shape: int, grouped: bool, uniform: bool, stress: wp.Function) -> wp.Kernel:
    """Add the forces of subtrees under a law of ``elements.constitutive``. Launch with block_dim BLOCK."""
    load, add = memory_of(shape, grouped)
    forces = own_forces(shape, uniform, always_trusted(stress))

    @unique_kernel(grid_stride=False)
    def scatter_subtrees(
        # In
        subtrees: Subtrees,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        g, _degenerate = forces(load(subtrees, s, u), q, h, mirror, material, first)
        add(subtrees, s, g, f)

    return scatter_subtrees
