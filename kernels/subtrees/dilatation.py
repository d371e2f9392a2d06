"""Dilatation that the eight leaves of a complete subtree share; see ``elements.dilatation``.

Forces have two fast ways: a thread a subtree on CUDA, ten displacements in and ten forces out, and eight subtrees in
the lanes of vector registers on the CPU. What solvers and the balance of energy need besides goes leaf by leaf, a
thread a subtree.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import CONTINUED_BELOW, IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation, hat_gradient, mean_of, row_of, turning_block
from warp_corot.kernels.elements.elements import (
    FRAME_SHIFT,
    LEVEL_MASK,
    ForestElements,
    Subtrees,
    add_force,
    mirror_sign,
    nodal_forces,
    rest_volume,
)
from warp_corot.kernels.elements.forces import in_local_frame, own_gradient
from warp_corot.kernels.elements.lanes import ISOTROPIC, constants, native, scatter_lanes
from warp_corot.kernels.elements.shapes import columns_of, leaf_forces_of
from warp_corot.kernels.math.rotation import column
from warp_corot.kernels.tables.shapes import VOLUME, fingerprint
from warp_corot.kernels.tables.subtree import LEAVES

from .cuda import memory_of
from .forces import mat10, turns_of
from .lanes import begin
from .laws import turn_in, turn_out

wp.set_module_options({"enable_backward": False})


@functools.cache
def scatter_in_lanes(shape: int, of: Dilatation) -> wp.Kernel:
    """Forces of the shared dilatation of subtrees on the CPU; a thread is eight subtrees."""
    law = constants(CONTINUED_BELOW=CONTINUED_BELOW) + native(*of.lanes)
    code = law + ISOTROPIC + begin(shape) + native("dilatation", "subtree_forces")
    return scatter_lanes(code, Subtrees, IsotropicMaterial, wp.uint8)


@functools.cache
def dilatation_forces_of(shape: int, uniform: bool, of: Dilatation) -> wp.Function:
    """Forces of the shared dilatation from ten displacements, in the frame that ``laws.turn_in`` turns them to."""
    measure, slope_of = of.measure, of.slope
    columns, leaf_forces = columns_of(shape), leaf_forces_of(shape)
    leaves, volume = LEAVES[shape], VOLUME[shape]
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def dilatation_forces(y: mat10, h: float, lam: wp.array[wp.float32], first: int):
        _generated_from = wp.static(fingerprint(leaves))
        k = lam[first]
        sum = float(0.0)
        weight = float(0.0)
        for leaf in range(8):
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
        # P V / h.
        pressure = wp.static(volume) * h * h * slope_of(mean_of(sum, weight))
        g = mat10()
        for leaf in range(8):
            if wp.static(not uniform):
                k = lam[first + leaf]
            b0, b1, b2 = columns(
                y[wp.static(leaves[leaf][0])],
                y[wp.static(leaves[leaf][1])],
                y[wp.static(leaves[leaf][2])],
                y[wp.static(leaves[leaf][3])],
            )
            _theta, slope = measure(into_leaf(leaf, wp.matrix_from_cols(b0, b1, b2)))
            p = out_of_leaf(leaf, (k * pressure) * slope)
            f0, f1, f2, f3 = leaf_forces(column(p, 0), column(p, 1), column(p, 2))
            g[wp.static(leaves[leaf][0])] += f0
            g[wp.static(leaves[leaf][1])] += f1
            g[wp.static(leaves[leaf][2])] += f2
            g[wp.static(leaves[leaf][3])] += f3
        return g

    return dilatation_forces


@functools.cache
def scatter_dilatation(shape: int, grouped: bool, uniform: bool, of: Dilatation) -> wp.Kernel:
    """Add the forces of the shared dilatation of subtrees on CUDA. Launch with block_dim ``cuda.BLOCK``."""
    load, add = memory_of(shape, grouped)
    forces = dilatation_forces_of(shape, uniform, of)

    @wp.kernel(module="unique", enable_backward=False, grid_stride=False)
    def scatter_dilatation(
        # In
        subtrees: Subtrees,
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
        g = forces(y, h, lam, wp.where(wp.static(uniform), 0, subtrees.first[s]))
        add(subtrees, s, turn_out(g, q0, q1, q2), f)

    return scatter_dilatation


@functools.cache
def sums_of_leaves(of: Dilatation) -> wp.Function:
    """Dilatation of a subtree, its change along p, and the sum of lambda over its leaves."""
    measure = of.measure

    @wp.func
    def sums_of_leaves(
        elements: ForestElements, first: int, material: IsotropicMaterial, u: wp.array[wp.vec4], p: wp.array[wp.vec4]
    ):
        theta_sum = float(0.0)
        change_sum = float(0.0)
        weight = float(0.0)
        leaf = int(0)
        # Not unrolled: the law is compiled once.
        while leaf < 8:
            t = first + leaf
            k = material.lam[t * material.stride]
            theta, slope = measure(own_gradient(elements, t, u))
            theta_sum += k * theta
            weight += k
            if p.shape[0] > 0:
                change_sum += k * wp.ddot(slope, own_gradient(elements, t, p))
            leaf += 1
        return mean_of(theta_sum, weight), mean_of(change_sum, weight), weight

    return sums_of_leaves


@functools.cache
def add_product_of_subtrees(of: Dilatation) -> wp.Kernel:
    """y += K p of the shared dilatation; without ``turning``, the part of K that is positive semidefinite."""
    measure, turning_of, slope_of, curvature_of = of.measure, of.turning, of.slope, of.curvature
    sums = sums_of_leaves(of)

    @wp.kernel(module="unique", enable_backward=False)
    def add_product_of_subtrees(
        # In
        first: wp.array[wp.int32],
        elements: ForestElements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        p: wp.array[wp.vec4],
        turning: float,
        # In and out
        y: wp.array[wp.vec4],
    ):
        at = first[wp.tid()]
        theta, d_theta, _weight = sums(elements, at, material, u, p)
        change = curvature_of(theta) * d_theta
        pressure = turning * slope_of(theta)
        leaf = int(0)
        while leaf < 8:
            t = at + leaf
            a = own_gradient(elements, t, u)
            _theta, slope = measure(a)
            stress = change * slope + pressure * turning_of(a, own_gradient(elements, t, p))
            stress = material.lam[t * material.stride] * stress
            f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, -stress))
            nodes = elements.nodes[t]
            add_force(y, nodes[0], f0)
            add_force(y, nodes[1], f1)
            add_force(y, nodes[2], f2)
            add_force(y, nodes[3], f3)
            leaf += 1

    return add_product_of_subtrees


vec10i = wp.types.vector(length=10, dtype=wp.int32)


@functools.cache
def add_diagonal_of_subtrees(of: Dilatation) -> wp.Kernel:
    """Add the diagonal blocks of the same K(u)."""
    measure, slope_of, curvature_of = of.measure, of.slope, of.curvature
    sums = sums_of_leaves(of)
    turning_of = turning_block(ForestElements, of)

    @wp.kernel(module="unique", enable_backward=False)
    def add_diagonal_of_subtrees(
        # In
        first: wp.array[wp.int32],
        elements: ForestElements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        turning: float,
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        at = first[wp.tid()]
        theta, _change, weight = sums(elements, at, material, u, u)
        pressure = turning * slope_of(theta)
        volume = rest_volume(elements, at)
        # The sum of lambda d theta_e / du over the leaves around each of the ten nodes.
        rows = mat10()
        numbers = vec10i()
        found = int(0)
        leaf = int(0)
        while leaf < 8:
            t = at + leaf
            a = own_gradient(elements, t, u)
            _theta, slope = measure(a)
            k = material.lam[t * material.stride]
            n = int(0)
            while n < 4:
                i = elements.nodes[t][n]
                hat = hat_gradient(elements, t, n)
                place = int(0)
                while place < found:
                    if numbers[place] == i:
                        break
                    place += 1
                if place == found:
                    numbers[place] = i
                    found += 1
                rows[place] = rows[place] + k * row_of(elements, t, slope, hat)
                if pressure != 0.0:
                    wp.atomic_add(blocks, i, (k * volume * pressure) * turning_of(elements, t, a, hat))
                n += 1
            leaf += 1
        scale = volume * curvature_of(theta) * mean_of(1.0, weight)
        place = int(0)
        while place < found:
            row = rows[place]
            wp.atomic_add(blocks, numbers[place], scale * wp.outer(row, row))
            place += 1

    return add_diagonal_of_subtrees


@functools.cache
def add_energies_of_subtrees(of: Dilatation) -> wp.Kernel:
    """Add each leaf's share of the energy of the shared dilatation [J]."""
    energy_of = of.energy
    sums = sums_of_leaves(of)

    @wp.kernel(module="unique", enable_backward=False)
    def add_energies_of_subtrees(
        # In
        first: wp.array[wp.int32],
        elements: ForestElements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        # In and out
        energies: wp.array[wp.float64],
    ):
        at = first[wp.tid()]
        theta, _change, _weight = sums(elements, at, material, u, u)
        density = energy_of(theta)
        leaf = int(0)
        while leaf < 8:
            t = at + leaf
            energy = wp.float64(material.lam[t * material.stride] * density) * wp.float64(rest_volume(elements, t))
            energies[t] = energies[t] + energy
            leaf += 1

    return add_energies_of_subtrees
