"""Forces of complete subtrees on CUDA under laws that need no rotation; one thread a subtree, as in ``cuda``.

A subtree's displacements are turned into its own frame once, and its forces back once. In that frame the frame B of a
leaf is constant. G, the displacement gradient with rows in the subtree's frame and columns in the leaf's, has sums and
differences of displacements as columns. A = B^T G moves and negates entries (four leaves of type 2 also mix them), and
the stress with rows in the subtree's frame is B times the law of A.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import Subtrees, root_of
from warp_corot.kernels.math.rotation import column
from warp_corot.kernels.modules import unique_kernel

from .forces import mat10, turned_forces_of
from .memory import memory_of

wp.set_module_options({"enable_backward": False})


@wp.func
def turn_in(x: mat10, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3, inv_h: float):
    """Displacements relative to the first node's, in the frame with columns q and in edge lengths of a leaf."""
    origin = x[0]
    y = mat10()
    for n in range(1, 10):
        d = (x[n] - origin) * inv_h
        y[n] = wp.vec3(wp.dot(q0, d), wp.dot(q1, d), wp.dot(q2, d))
    return y


@wp.func
def turn_out(g: mat10, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
    """Turn vectors from the frame with columns q into world space."""
    x = mat10()
    for n in range(10):
        x[n] = g[n, 0] * q0 + g[n, 1] * q1 + g[n, 2] * q2
    return x


@functools.cache
def always_trusted(stress: wp.Function) -> wp.Function:
    @wp.func
    def trusted_stress(a: wp.mat33, mu: float, lam: float):
        return stress(a, mu, lam), True

    return trusted_stress


@functools.cache
def scatter_subtrees(shape: int, grouped: bool, uniform: bool, stress: wp.Function) -> wp.Kernel:
    """Add the forces of subtrees under a law of ``elements.constitutive``. Launch with block_dim BLOCK."""
    load, add = memory_of(shape, grouped)
    forces = turned_forces_of(shape, uniform, range(8), always_trusted(stress))

    @unique_kernel(grid_stride=False)
    def scatter_subtrees(
        # In
        subtrees: Subtrees,
        mu: wp.array[wp.float32],
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        y = turn_in(load(subtrees, s, u), q0, q1, q2, 1.0 / h)
        g, _left_out = forces(y, h, mu, lam, wp.where(wp.static(uniform), 0, subtrees.first[s]))
        add(subtrees, s, turn_out(g, q0, q1, q2), f)

    return scatter_subtrees
