"""Corotated forces of orthotropic materials by complete subtrees on CUDA; one thread a subtree, as in ``laws``.

The law is that of ``corotated.anisotropic``. Each leaf is computed in its own frame, in which the columns of F - I are
differences of displacements, and four unscaled iterations find its rotation. A leaf for which these find no rotation
adds nothing; a bit flags it, and ``repair_leaves`` computes it. Leaves whose rotation is nearly indefinite are flagged,
too: see ``corotated.anisotropic_cpu``.
"""

import functools

import warp as wp

from warp_corot.kernels.corotated.anisotropic import FibreMaterial, OrthotropicMaterial, filled, listed_stress
from warp_corot.kernels.corotated.definite import definite_law, definite_strain, is_definite, load_axes
from warp_corot.kernels.elements.elements import ForestElements, Subtrees, root_of, scatter_stress
from warp_corot.kernels.math.rotation import ITERATIONS, byers_xu, column, newton_rotation, quick_rotation
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import FRAMES, HANDEDNESS, LEAVES

from .forces import columns_of, leaf_forces_of, mat10, turns_of
from .laws import turn_in, turn_out
from .memory import BLOCK, memory_of

wp.set_module_options({"enable_backward": False})


@functools.cache
def anisotropic_forces(shape: int, transverse: bool, one_axes: bool, one_stiffness: bool) -> wp.Function:
    """Nodal forces of a subtree from its displacements, both in the subtree's frame, and a mask of the leaves left out.

    ``frame`` is the subtree's, ``h`` a leaf's edge length, ``first`` the first leaf among the mesh's elements.
    """
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, frames, handed, volume = LEAVES[shape], FRAMES[shape], HANDEDNESS[shape], VOLUME[shape]
    into_leaf, _out_of_leaf = turns_of(shape)
    law = definite_law(transverse)

    @wp.func
    def anisotropic_forces(
        y: mat10,
        frame: wp.mat33,
        h: float,
        material: OrthotropicMaterial,
        axes: wp.array[wp.quat],
        is_active: int,
        activation: wp.array[wp.float32],
        first: int,
    ):
        _generated_from = wp.static(fingerprint(leaves, frames, handed))
        area = wp.static(volume) * h * h
        # The material's axes in the subtree's frame.
        m = wp.transpose(frame) * wp.quat_to_matrix(load_axes(axes, 0))
        c = material.stiffness[0]
        g = mat10()
        left_out = int(0)
        for leaf in range(8):
            t = first + leaf
            if wp.static(not one_axes):
                m = wp.transpose(frame) * wp.quat_to_matrix(load_axes(axes, t))
            if wp.static(not one_stiffness):
                c = material.stiffness[t]
            c0, c1, c2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            gradient = wp.matrix_from_cols(c0, c1, c2)
            # A = B^T G, and the axes, in the leaf's frame B.
            a = into_leaf(leaf, gradient)
            n = into_leaf(leaf, m)
            f0 = c0 + wp.static(wp.vec3(*frames[leaf][0]))
            f1 = c1 + wp.static(wp.vec3(*frames[leaf][1]))
            f2 = c2 + wp.static(wp.vec3(*frames[leaf][2]))
            z0, z1, z2, trusted = newton_rotation(f0, f1, f2, wp.static(handed[leaf]))
            e = definite_strain(z0, z1, z2, f0, f1, f2, gradient, a)
            filled_area = area * filled(material, t)
            s = law(e, n, c, wp.static(0.5**ITERATIONS) * filled_area)
            p0 = s[0, 0] * z0 + s[1, 0] * z1 + s[2, 0] * z2
            p1 = s[0, 1] * z0 + s[1, 1] * z1 + s[2, 1] * z2
            p2 = s[0, 2] * z0 + s[1, 2] * z1 + s[2, 2] * z2
            if is_active != 0:
                d = column(n, 0)
                pull = (filled_area * activation[t]) * (d[0] * f0 + d[1] * f1 + d[2] * f2)
                p0 += d[0] * pull
                p1 += d[1] * pull
                p2 += d[2] * pull
            if not (trusted and is_definite(e)):
                p0 = wp.vec3()
                p1 = wp.vec3()
                p2 = wp.vec3()
                left_out += wp.static(1 << leaf)
            q0, q1, q2, q3 = leaf_forces(p0, p1, p2)
            g[wp.static(leaves[leaf][0])] += q0
            g[wp.static(leaves[leaf][1])] += q1
            g[wp.static(leaves[leaf][2])] += q2
            g[wp.static(leaves[leaf][3])] += q3
        return g, left_out

    return anisotropic_forces


@functools.cache
def scatter_anisotropic_subtrees(
    shape: int, grouped: bool, transverse: bool, one_axes: bool, one_stiffness: bool, resident: int = 0
) -> wp.Kernel:
    """Add the forces of subtrees. Launch with block_dim BLOCK.

    ``axes`` are those of the material; ``flagged`` gets the leaves that were left out, a byte a subtree.
    """
    load, add = memory_of(shape, grouped)
    forces = anisotropic_forces(shape, transverse, one_axes, one_stiffness)

    options = {"launch_bounds": (BLOCK, resident)} if resident else {}

    @unique_kernel(grid_stride=False, **options)
    def scatter_anisotropic_subtrees(
        # In
        subtrees: Subtrees,
        material: OrthotropicMaterial,
        axes: wp.array[wp.quat],
        is_active: int,
        activation: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
        flagged: wp.array[wp.uint8],
    ):
        s = wp.tid()
        h, q, mirror = root_of(subtrees, s)
        q0 = column(q, 0)
        q1 = column(q, 1)
        q2 = column(q, 2) * mirror
        y = turn_in(load(subtrees, s, u), q0, q1, q2, 1.0 / h)
        frame = wp.matrix_from_cols(q0, q1, q2)
        g, left_out = forces(y, frame, h, material, axes, is_active, activation, subtrees.first[s])
        flagged[s] = wp.uint8(left_out)
        add(subtrees, s, turn_out(g, q0, q1, q2), f)

    return scatter_anisotropic_subtrees


_robust_stress = listed_stress(byers_xu)


@unique_kernel()
def repair_leaves(
    # In
    flagged: wp.array[wp.uint64],
    first: wp.array[wp.int32],
    elements: ForestElements,
    material: FibreMaterial,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add the forces of flagged leaves by a method that is right for every F.

    Eight threads share a word of 64 bits, one for each leaf of eight subtrees; nearly always all bits are zero.
    """
    i = wp.tid()
    flags = flagged[i // 8] >> wp.uint64(i % 8)
    member = int(0)
    while flags != wp.uint64(0) and member < 8:
        if (flags & wp.uint64(1)) != wp.uint64(0):
            t = first[8 * (i // 8) + member] + i % 8
            scatter_stress(elements, t, _robust_stress(elements, t, material, t, u), f)
        flags = flags >> wp.uint64(8)
        member += 1


_quick_stress = listed_stress(quick_rotation)


@unique_kernel()
def scatter_flat(
    # In
    elements: ForestElements,
    leaves: wp.array[wp.int32],
    material: FibreMaterial,
    u: wp.array[wp.vec4],
    # Out
    f: wp.array[wp.vec4],
):
    """Add the forces of leaves that are in no subtree; ``leaves`` are their places among the mesh's elements."""
    k = wp.tid()
    scatter_stress(elements, k, _quick_stress(elements, k, material, leaves[k], u), f)
