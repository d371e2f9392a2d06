"""The dilatation that the eight leaves of a complete subtree share; see ``elements.dilatation``.

This is the fast kernel for its forces on CUDA, where a thread takes a subtree, with ten displacements in and ten
forces out; ``cpu`` has that for the CPU. ``elements.shared_dilatation`` computes everything else leaf by leaf.
"""

import functools

import warp as wp

from warp_corot.kernels.corotated.algebraic import stretch_stress
from warp_corot.kernels.elements.dilatation import VOLUME as VOLUME_CHANGE
from warp_corot.kernels.elements.dilatation import Dilatation, mean_of, pressure_stress_of
from warp_corot.kernels.elements.elements import Subtrees, root_of
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.math.rotation import column
from warp_corot.kernels.modules import unique_kernel
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import LEAVES

from .forces import mat10, turns_of
from .laws import turn_in, turn_out
from .memory import memory_of

wp.set_module_options({"enable_backward": False})


@functools.cache
def dilatation_sums_of(shape: int, uniform: bool, of: Dilatation, chosen: range = range(8)) -> wp.Function:
    """The sums of lambda theta and of lambda over the chosen leaves, which have equal volumes.

    The ten displacements are in the frame of ``laws.turn_in``.
    """
    measure, columns = of.measure, columns_of(shape)
    leaves, begin, end = LEAVES[shape], chosen.start, chosen.stop
    into_leaf, _out_of_leaf = turns_of(shape)

    @wp.func
    def dilatation_sums(y: mat10, lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves, begin, end))
        k = lam[first]
        sum = float(0.0)
        weight = float(0.0)
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                k = lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            theta, _slope = measure(into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2)))
            sum += k * theta
            weight += k
        return sum, weight

    return dilatation_sums


@functools.cache
def pressure_forces_of(shape: int, uniform: bool, of: Dilatation, chosen: range = range(8)) -> wp.Function:
    """Forces of the chosen leaves from ten displacements in the same frame, and from the slope of the energy at the
    dilatation that all eight leaves share."""
    stress, columns, leaf_forces = pressure_stress_of(of), columns_of(shape), leaf_forces_of(shape)
    leaves, volume, begin, end = LEAVES[shape], VOLUME[shape], chosen.start, chosen.stop
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def pressure_forces(y: mat10, h: float, pressure: float, lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves, begin, end))
        k = lam[first]
        # P V / h is the stress times this.
        area = wp.static(volume) * h * h
        g = mat10()
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                k = lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            p = out_of_leaf(leaf, stress(into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2)), pressure, k * area))
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        return g

    return pressure_forces


@functools.cache
def dilating_forces_of(shape: int, uniform: bool, chosen: range = range(8)) -> wp.Function:
    """Corotated forces and the forces of the pressure in one pass, and a mask of the leaves left out; otherwise the
    same as ``pressure_forces_of``.

    Leaves that the corotated law leaves out still add the forces of the pressure.
    """
    pressure_stress, columns, leaf_forces = pressure_stress_of(VOLUME_CHANGE), columns_of(shape), leaf_forces_of(shape)
    leaves, volume, begin, end = LEAVES[shape], VOLUME[shape], chosen.start, chosen.stop
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def dilating_forces(
        y: mat10, h: float, pressure: float, mu: wp.array[wp.float32], lam: wp.array[wp.float32], first: int
    ):
        _generated_from = wp.static(fingerprint(leaves, begin, end))
        # P V / h is the stress times this.
        area = wp.static(volume) * h * h
        m = area * mu[first]
        k = area * lam[first]
        g = mat10()
        left_out = int(0)
        for leaf in range(wp.static(begin), wp.static(end)):
            if wp.static(not uniform):
                m = area * mu[first + leaf]
                k = area * lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            a = into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2))
            sigma, trusted = stretch_stress(a, m, 0.0)
            if not trusted:
                sigma = wp.mat33()
                left_out |= wp.static(1 << leaf)
            p = out_of_leaf(leaf, sigma + pressure_stress(a, pressure, k))
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        return g, left_out

    return dilating_forces


@functools.cache
def scatter_dilatation(shape: int, grouped: bool, uniform: bool, of: Dilatation) -> wp.Kernel:
    """Add the forces of the shared dilatation of subtrees on CUDA. Launch with block_dim ``memory.BLOCK``."""
    load, add = memory_of(shape, grouped)
    sums, forces, slope_of = dilatation_sums_of(shape, uniform, of), pressure_forces_of(shape, uniform, of), of.slope

    @unique_kernel(grid_stride=False)
    def scatter_dilatation(
        # In
        subtrees: Subtrees,
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
        first = wp.where(wp.static(uniform), 0, subtrees.first[s])
        sum, weight = sums(y, lam, first)
        g = forces(y, h, slope_of(mean_of(sum, weight)), lam, first)
        add(subtrees, s, turn_out(g, q0, q1, q2), f)

    return scatter_dilatation
