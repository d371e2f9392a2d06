"""Forces of complete subtrees on CUDA under laws that need no rotation; one thread a subtree, as in ``cuda``.

A subtree's displacements are turned into its own frame once, and its forces back. In between, a leaf's frame B is a
constant: the columns of G in leaf columns and subtree rows are sums and differences of displacements, A = B^T G moves
and negates entries (types 0 and 1; four leaves of type 2 also mix them), and P in subtree rows is B times the law of A.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.elements import FRAME_SHIFT, LEVEL_MASK, Subtrees, mirror_sign
from warp_corot.kernels.math.rotation import column
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import FRAMES, LEAVES

from .cuda import memory_of
from .forces import columns_of, first_of, leaf_forces_of, mat10

wp.set_module_options({"enable_backward": False})


@wp.func
def turn_in(x: mat10, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3, inv_h: float):
    """Displacements relative to the first node's in the frame of columns q, in edge lengths of a leaf."""
    origin = x[0]
    y = mat10()
    for n in range(1, 10):
        d = (x[n] - origin) * inv_h
        y[n] = wp.vec3(wp.dot(q0, d), wp.dot(q1, d), wp.dot(q2, d))
    return y


@wp.func
def turn_out(g: mat10, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
    """Vectors in the frame of columns q turned into world space."""
    x = mat10()
    for n in range(10):
        x[n] = g[n, 0] * q0 + g[n, 1] * q1 + g[n, 2] * q2
    return x


@functools.cache
def law_forces(shape: int, uniform: bool, stress: wp.Function) -> wp.Function:
    """Nodal forces of a subtree, in its own frame, from displacements that ``turn_in`` has turned there.

    ``h`` is a leaf's edge length, ``first`` where its material stands, and that of the other leaves unless uniform.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, frames = LEAVES[shape], FRAMES[shape]
    rows = [[first_of(axis) for axis in frame] for frame in frames]
    backs = [[first_of([frame[i][axis] for i in range(3)]) for axis in range(3)] for frame in frames]
    volume = VOLUME[shape]

    @wp.func
    def law_forces(y: mat10, h: float, mu: wp.array[wp.float32], lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves, frames))
        # Laws are linear in their parameters: P V/h comes of these times V/h.
        area = wp.static(volume) * h * h
        m = area * mu[first]
        k = area * lam[first]
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                m = area * mu[first + leaf]
                k = area * lam[first + leaf]
            c0, c1, c2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            c = wp.matrix_from_cols(c0, c1, c2)
            a = wp.mat33()
            for i in range(3):
                for axis in range(3):
                    if wp.static(axis == rows[leaf][i]):
                        for j in range(3):
                            a[i, j] = wp.static(frames[leaf][i][axis]) * c[axis, j]
                    elif wp.static(abs(frames[leaf][i][axis]) > 1e-9):
                        for j in range(3):
                            a[i, j] += wp.static(frames[leaf][i][axis]) * c[axis, j]
            s = stress(a, m, k)
            p = wp.mat33()
            for axis in range(3):
                for i in range(3):
                    if wp.static(i == backs[leaf][axis]):
                        for j in range(3):
                            p[axis, j] = wp.static(frames[leaf][i][axis]) * s[i, j]
                    elif wp.static(abs(frames[leaf][i][axis]) > 1e-9):
                        for j in range(3):
                            p[axis, j] += wp.static(frames[leaf][i][axis]) * s[i, j]
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        return g

    return law_forces


@functools.cache
def scatter_subtrees(shape: int, grouped: bool, uniform: bool, stress: wp.Function) -> wp.Kernel:
    """Add the forces of subtrees under a law of ``elements.constitutive``. Launch with block_dim BLOCK."""
    load, add = memory_of(shape, grouped)
    forces = law_forces(shape, uniform, stress)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
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
        code = subtrees.code[s]
        h = 0.5 * subtrees.size[(code & LEVEL_MASK) // 3]
        q = subtrees.frames[code >> FRAME_SHIFT]
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror_sign(code)
        y = turn_in(load(subtrees, s, u), q0, q1, q2, 1.0 / h)
        g = forces(y, h, mu, lam, wp.where(wp.static(uniform), 0, subtrees.first[s]))
        add(subtrees, s, turn_out(g, q0, q1, q2), f)

    return scatter_subtrees
