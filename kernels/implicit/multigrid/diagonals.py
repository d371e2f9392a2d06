"""Parts of subtrees on CUDA for the finest level: rows of a shared dilatation, and the diagonal."""

import functools

import warp as wp

from warp_corot.kernels.corotated.turned_subtrees import LeafMaterial, leaf_axes
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.kernels.elements.elements import ForestElements, Subtrees, nodal_forces, rest_volume, root_of
from warp_corot.kernels.elements.forces import in_local_frame, own_gradient
from warp_corot.kernels.elements.shapes import leaf_forces_of
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.subtrees.forces import mat10
from warp_corot.kernels.subtrees.memory import memory_of
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import HANDEDNESS, LEAVES

from .shared import kept_share
from .subtrees import OwnBlocks, own_block
from .values import inverse_block

wp.set_module_options({"enable_backward": False})


@functools.cache
def keep_rows(shape: int, of: Dilatation) -> wp.Kernel:
    """Write the rows of subtrees whose leaves share their dilatation, at displacements u, with w - 1 in the fourth
    lane; see ``shared``. Those of the first nodes of all subtrees come first, then those of the second ones.
    """
    leaves = LEAVES[shape]
    measure, curvature_of = of.measure, of.curvature

    @unique_kernel()
    def keep_rows(
        # In
        count: int,
        leaf_numbers: wp.array[wp.int32],
        elements: ForestElements,
        u: wp.array[wp.vec4],
        mu: wp.array[float],
        lam: wp.array[float],
        stride: int,
        most: float,
        # Out
        rows: wp.array[wp.vec4],
    ):
        _generated_from = wp.static(fingerprint(leaves))
        s = wp.tid()
        first = leaf_numbers[s]
        row = mat10()
        sum = float(0.0)
        total = float(0.0)
        shear = float(0.0)
        for leaf in range(8):
            t = first + leaf
            theta, slope = measure(own_gradient(elements, t, u))
            modulus = lam[t * stride]
            weight = modulus * rest_volume(elements, t)
            sum += weight * theta
            total += weight
            shear += mu[t * stride] * rest_volume(elements, t)
            f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, -modulus * slope))
            row[wp.static(leaves[leaf][0])] += f0
            row[wp.static(leaves[leaf][1])] += f1
            row[wp.static(leaves[leaf][2])] += f2
            row[wp.static(leaves[leaf][3])] += f3
        factor = float(0.0)
        if total > 0.0:
            factor = wp.sqrt(kept_share(total, shear, most) * wp.max(curvature_of(sum / total), 0.0) / total)
        size = float(0.0)
        for n in range(10):
            size += wp.length(row[n])
        for n in range(10):
            own = wp.length(row[n])
            weight = float(1.0)
            if own > 0.0:
                weight = 0.25 * size / own
            v = factor * row[n]
            rows[n * count + s] = wp.vec4(v[0], v[1], v[2], weight - 1.0)

    return keep_rows


@functools.cache
def add_diagonals(shape: int, grouped: bool, uniform: bool, shares: bool) -> wp.Kernel:
    """Add the diagonal blocks of K: xx, yy and zz, or if ``mixed`` xy, xz and yz. Launch with block_dim
    ``subtrees.memory.BLOCK``.
    """
    _load, add = memory_of(shape, grouped)
    leaf_gradients = leaf_forces_of(shape)
    leaves, hands, volume = LEAVES[shape], HANDEDNESS[shape], VOLUME[shape]

    @wp.func
    def part_of(a: wp.vec3, m: float, k: float, mixed: bool):
        part = wp.vec3(a[0] * a[1], a[0] * a[2], a[1] * a[2]) * (m + k)
        if not mixed:
            square = m * wp.dot(a, a)
            part = (m + k) * wp.cw_mul(a, a) + wp.vec3(square, square, square)
        return part

    @unique_kernel(grid_stride=False)
    def add_diagonals(
        # In
        subtrees: Subtrees,
        material: LeafMaterial,
        turns: wp.array[wp.vec4],
        rows: wp.array[wp.vec4],
        mixed: bool,
        # In and out
        diagonals: wp.array[wp.vec4],
    ):
        _generated_from = wp.static(fingerprint(leaves, hands))
        s = wp.tid()
        h, _q, mirror = root_of(subtrees, s)
        count = turns.shape[0] / 8
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        size = wp.static(volume) * h
        m = size * material.mu[first]
        k = wp.min(size * material.lam[first], material.most_lambda * m)
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                m = size * material.mu[first + leaf]
                k = wp.min(size * material.lam[first + leaf], material.most_lambda * m)
            a0, a1, a2 = leaf_axes(turns, leaf * count + s, mirror * wp.static(hands[leaf]))
            f0, f1, f2, f3 = leaf_gradients(a0, a1, a2)
            g[wp.static(leaves[leaf][0])] += part_of(f0, m, k, mixed)
            g[wp.static(leaves[leaf][1])] += part_of(f1, m, k, mixed)
            g[wp.static(leaves[leaf][2])] += part_of(f2, m, k, mixed)
            g[wp.static(leaves[leaf][3])] += part_of(f3, m, k, mixed)
        if wp.static(shares):
            for n in range(10):
                row = rows[n * count + s]
                v = wp.vec3(row[0], row[1], row[2])
                g[n] += part_of(v, 0.0, 1.0 + row[3], mixed)
        add(subtrees, s, g, diagonals)

    return add_diagonals


@wp.kernel(enable_backward=False)
def invert_diagonals(
    # In
    stiffening: float,
    scales: wp.array[float],
    own: OwnBlocks,
    # In and out
    straight: wp.array[wp.vec4],
    mixed: wp.array[wp.vec4],
    # Out
    inverses: wp.array[wp.mat33],
):
    """Find the inverses of diagonal blocks, zero at held nodes, and empty their parts for the next time."""
    at = wp.tid()
    a = straight[at]
    b = mixed[at]
    straight[at] = wp.vec4()
    mixed[at] = wp.vec4()
    inverse = wp.mat33()
    if own.masses[at] >= 0.0:
        block = wp.mat33(a[0], b[0], b[1], b[0], a[1], b[2], b[1], b[2], a[2])
        inverse = inverse_block((scales[2] + scales[1] * stiffening) * block + own_block(own, at))
    inverses[at] = inverse
