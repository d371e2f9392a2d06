"""The dilatation that the eight leaves of a complete subtree share; see ``elements.dilatation``.

This is the fast kernel for its forces on CUDA, where a thread takes a subtree, with ten displacements in and ten
forces out; ``cpu`` has that for the CPU. ``elements.mean_dilatation`` computes everything else leaf by leaf.
"""

import functools

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation, mean_of, pressure_stress_of
from warp_corot.kernels.elements.shapes import columns_of
from warp_corot.kernels.tables.shapes import fingerprint
from warp_corot.kernels.tables.subtree import LEAVES

from .forces import mat10, turns_of

wp.set_module_options({"enable_backward": False})


@functools.cache
def dilatation_sums_of(shape: int, uniform: bool, of: Dilatation) -> wp.Function:
    """The sums of lambda theta and of lambda over the eight leaves, which have equal volumes.

    The ten displacements are in the frame of ``forces.turn_in``.
    """
    measure, columns = of.measure, columns_of(shape)
    leaves = LEAVES[shape]
    into_leaf, _out_of_leaf = turns_of(shape)

    @wp.func
    def dilatation_sums(y: mat10, lam: wp.array[wp.float32], first: int):
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
        return sum, weight

    return dilatation_sums


@functools.cache
def pressure_leaves(shape: int, of: Dilatation) -> wp.Function:
    """The law of leaves (``forces``) of the pressure alone; the leaves of a subtree share the pressure."""
    stress = pressure_stress_of(of)
    into_leaf, out_of_leaf = turns_of(shape)

    @wp.func
    def pressure_leaf(material: IsotropicMaterial, pressure: float, leaf: int, t: int, area: float, g: wp.mat33):
        return out_of_leaf(leaf, stress(into_leaf(leaf, g), pressure, area * material.lam[t])), True, True

    return pressure_leaf


@functools.cache
def shared_pressure(shape: int, uniform: bool, of: Dilatation) -> wp.Function:
    """w' of the dilatation that a subtree's leaves share."""
    sums, slope_of = dilatation_sums_of(shape, uniform, of), of.slope

    @wp.func
    def shared_pressure(material: IsotropicMaterial, y: mat10, first: int, q0: wp.vec3, q1: wp.vec3, q2: wp.vec3):
        sum, weight = sums(y, material.lam, first)
        return slope_of(mean_of(sum, weight))

    return shared_pressure
