"""Dilatation that several elements share, so that nearly incompressible tissue does not lock.

The part of a law's energy that lambda multiplies is a function w of a dilatation theta of each element: tr e, tr E or
J - 1. Linear tetrahedra have more of these than a nearly incompressible body has displacements to spare, and lock. Here
elements share it. The eight leaves of a subtree have the mean of theirs, weighted by lambda and volume, and the energy
    W = sum over e of lambda_e V_e w(theta),  theta = sum of lambda_e V_e theta_e / sum of lambda_e V_e.
Elements in no subtree have one theta at each node, the mean of the elements around it, and the mean of w at their four
nodes. Forces are exact derivatives: P_e = lambda_e w'(theta) d theta_e / dF.

Functions here take the displacement gradient A as ``constitutive`` has it. The kernels of nodes are here, those of
subtrees in ``subtrees.dilatation``.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from warp_corot.kernels.math.matrices import cofactor_differential
from warp_corot.kernels.math.rotation import cofactor, identity3

from .constitutive import (
    IsotropicMaterial,
    dilation,
    green_strain,
    volumetric_curvature,
    volumetric_energy,
    volumetric_slope,
)
from .elements import add_force, gradient_of, nodal_forces, rest_volume
from .forces import in_local_frame, own_gradient

wp.set_module_options({"enable_backward": False})


class Dilatation(NamedTuple):
    """What a law has in the place of lambda times half the square of a trace; functions of device code.

    Attributes:
        lanes: The native code for lanes, files of ``native``.
        measure: theta and d theta / dF of A.
        turning: The differential of d theta / dF at A in a direction dA.
        energy, slope, curvature: w and its derivatives, of theta.
    """

    lanes: tuple[str, ...]
    measure: wp.Function
    turning: wp.Function
    energy: wp.Function
    slope: wp.Function
    curvature: wp.Function


@wp.func
def small_dilatation(a: wp.mat33):
    return wp.trace(a), identity3()


@wp.func
def small_turning(a: wp.mat33, da: wp.mat33):
    return wp.mat33()


@wp.func
def green_dilatation(a: wp.mat33):
    return wp.trace(green_strain(a)), identity3() + a


@wp.func
def green_turning(a: wp.mat33, da: wp.mat33):
    return da


@wp.func
def volume_dilatation(a: wp.mat33):
    """J - 1, and cof F = I + tr(A) I - A^T + cof A."""
    cof = cofactor(a)
    return dilation(a, cof), cof - wp.transpose(a) + (1.0 + wp.trace(a)) * identity3()


@wp.func
def volume_turning(a: wp.mat33, da: wp.mat33):
    return cofactor_differential(a, da) - wp.transpose(da) + wp.trace(da) * identity3()


@wp.func
def square_energy(theta: float):
    return 0.5 * theta * theta


@wp.func
def square_slope(theta: float):
    return theta


@wp.func
def square_curvature(theta: float):
    return 1.0


@wp.func
def log_energy(theta: float):
    """Half of (ln J)^2, continued where J is small as neo-Hookean's."""
    return volumetric_energy(theta, 0.0, 1.0)


@wp.func
def log_slope(theta: float):
    return volumetric_slope(theta, 0.0, 1.0)


@wp.func
def log_curvature(theta: float):
    return volumetric_curvature(theta, 0.0, 1.0)


_SQUARE = (square_energy, square_slope, square_curvature)
#: tr e of linear elasticity, tr E of St. Venant-Kirchhoff, J - 1 of corotated and, in the logarithm, of neo-Hookean.
SMALL = Dilatation(("dilatation_small",), small_dilatation, small_turning, *_SQUARE)
GREEN = Dilatation(("dilatation_green",), green_dilatation, green_turning, *_SQUARE)
VOLUME = Dilatation(("dilatation_of_volume", "dilatation_volume"), volume_dilatation, volume_turning, *_SQUARE)
LOG_VOLUME = Dilatation(
    ("log", "dilatation_of_volume", "dilatation_log_volume"),
    volume_dilatation,
    volume_turning,
    log_energy,
    log_slope,
    log_curvature,
)


@wp.func
def mean_of(sum: float, weight: float):
    """A weighted mean; zero where nothing has weight."""
    return wp.where(weight != 0.0, sum / wp.where(weight != 0.0, weight, 1.0), 0.0)


@wp.func
def theta_at(sums: wp.array[wp.vec4], i: int):
    """The dilatation of a node, and its change, from the sums of ``sum_at_nodes``."""
    at = sums[i]
    return mean_of(at[0], at[1]), mean_of(at[2], at[1])


@functools.cache
def sum_at_nodes(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add each element's lambda V / 4 times its dilatation, one, and its dilatation's change along p, to its nodes."""
    measure = of.measure

    @wp.kernel(module="unique", enable_backward=False)
    def sum_at_nodes(
        # In
        elements: Elements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        p: wp.array[wp.vec4],
        # In and out
        sums: wp.array[wp.vec4],
    ):
        t = wp.tid()
        weight = 0.25 * material.lam[t * material.stride] * rest_volume(elements, t)
        theta, slope = measure(own_gradient(elements, t, u))
        change = float(0.0)
        if p.shape[0] > 0:
            change = wp.ddot(slope, own_gradient(elements, t, p))
        part = weight * wp.vec3(theta, 1.0, change)
        targets = elements.targets[t]
        for n in range(4):
            add_force(sums, targets[n], part)

    return sum_at_nodes


@functools.cache
def scatter_from_nodes(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add the forces of the nodes' dilatation; a thread an element."""
    measure, slope_of = of.measure, of.slope

    @wp.kernel(module="unique", enable_backward=False)
    def scatter_from_nodes(
        # In
        elements: Elements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        sums: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        t = wp.tid()
        nodes = elements.nodes[t]
        pressure = float(0.0)
        for n in range(4):
            theta, _change = theta_at(sums, nodes[n])
            pressure += 0.25 * slope_of(theta)
        _theta, slope = measure(own_gradient(elements, t, u))
        stress = (material.lam[t * material.stride] * pressure) * slope
        f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, stress))
        targets = elements.targets[t]
        add_force(f, targets[0], f0)
        add_force(f, targets[1], f1)
        add_force(f, targets[2], f2)
        add_force(f, targets[3], f3)

    return scatter_from_nodes


@functools.cache
def add_product_from_nodes(Elements: type, of: Dilatation) -> wp.Kernel:
    """y += K p of the nodes' dilatation; without ``turning``, the part of K that is positive semidefinite."""
    measure, turning_of, slope_of, curvature_of = of.measure, of.turning, of.slope, of.curvature

    @wp.kernel(module="unique", enable_backward=False)
    def add_product_from_nodes(
        # In
        elements: Elements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        p: wp.array[wp.vec4],
        sums: wp.array[wp.vec4],
        turning: float,
        # In and out
        y: wp.array[wp.vec4],
    ):
        t = wp.tid()
        nodes = elements.nodes[t]
        pressure = float(0.0)
        change = float(0.0)
        for n in range(4):
            theta, d_theta = theta_at(sums, nodes[n])
            pressure += 0.25 * slope_of(theta)
            change += 0.25 * curvature_of(theta) * d_theta
        a = own_gradient(elements, t, u)
        _theta, slope = measure(a)
        stress = change * slope + (turning * pressure) * turning_of(a, own_gradient(elements, t, p))
        stress = material.lam[t * material.stride] * stress
        f0, f1, f2, f3 = nodal_forces(elements, t, in_local_frame(elements, t, -stress))
        add_force(y, nodes[0], f0)
        add_force(y, nodes[1], f1)
        add_force(y, nodes[2], f2)
        add_force(y, nodes[3], f3)

    return add_product_from_nodes


@wp.func
def hat_gradient(elements: Any, t: int, n: int):
    """The gradient of the n-th node's hat function in the frame of ``own_gradient`` (columns)."""
    x = wp.vec3(1.0, 0.0, 0.0)
    o = wp.vec3()
    unit = gradient_of(
        elements, t, wp.where(n == 0, x, o), wp.where(n == 1, x, o), wp.where(n == 2, x, o), wp.where(n == 3, x, o)
    )
    return wp.vec3(unit[0, 0], unit[0, 1], unit[0, 2])


@wp.func
def row_of(elements: Any, t: int, slope: wp.mat33, hat: wp.vec3):
    """d theta_e / d u of a node: (d theta_e / dF) grad N, in world space."""
    return in_local_frame(elements, t, slope) * hat


@functools.cache
def turning_block(Elements: type, of: Dilatation) -> wp.Function:
    """The part of a diagonal block that the turning of d theta / dF gives, over lambda V w'."""
    turning_of = of.turning

    @wp.func
    def turning_block(elements: Elements, t: int, a: wp.mat33, hat: wp.vec3):
        block = wp.mat33()
        axis = int(0)
        while axis < 3:
            e = wp.vec3(float(axis == 0), float(axis == 1), float(axis == 2))
            d = turning_of(a, wp.transpose(in_local_frame(elements, t, identity3())) * wp.outer(e, hat))
            block += wp.outer(in_local_frame(elements, t, d) * hat, e)
            axis += 1
        return block

    return turning_block


@functools.cache
def add_diagonal_from_nodes(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add diagonal blocks of which those of K are no more: each element's as if its dilatation were its own."""
    measure, slope_of, curvature_of = of.measure, of.slope, of.curvature
    turning_of = turning_block(Elements, of)

    @wp.kernel(module="unique", enable_backward=False)
    def add_diagonal_from_nodes(
        # In
        elements: Elements,
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        sums: wp.array[wp.vec4],
        turning: float,
        # In and out
        blocks: wp.array[wp.mat33],
    ):
        t = wp.tid()
        nodes = elements.nodes[t]
        pressure = float(0.0)
        curvature = float(0.0)
        for n in range(4):
            theta, _change = theta_at(sums, nodes[n])
            pressure += 0.25 * slope_of(theta)
            curvature += 0.25 * curvature_of(theta)
        a = own_gradient(elements, t, u)
        _theta, slope = measure(a)
        weight = material.lam[t * material.stride] * rest_volume(elements, t)
        n = int(0)
        while n < 4:
            hat = hat_gradient(elements, t, n)
            row = row_of(elements, t, slope, hat)
            block = curvature * wp.outer(row, row) + (turning * pressure) * turning_of(elements, t, a, hat)
            wp.atomic_add(blocks, nodes[n], weight * block)
            n += 1

    return add_diagonal_from_nodes


@functools.cache
def add_energies_from_nodes(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add each element's share of the energy of the nodes' dilatation [J] to that of element ``leaves[t]``."""
    energy_of = of.energy

    @wp.kernel(module="unique", enable_backward=False)
    def add_energies_from_nodes(
        # In
        elements: Elements,
        leaves: wp.array[wp.int32],
        material: IsotropicMaterial,
        sums: wp.array[wp.vec4],
        # In and out
        energies: wp.array[wp.float64],
    ):
        t = wp.tid()
        nodes = elements.nodes[t]
        density = float(0.0)
        for n in range(4):
            theta, _change = theta_at(sums, nodes[n])
            density += 0.25 * energy_of(theta)
        place = t
        if leaves.shape[0] > 0:
            place = leaves[t]
        energy = wp.float64(material.lam[t * material.stride] * density) * wp.float64(rest_volume(elements, t))
        energies[place] = energies[place] + energy

    return add_energies_from_nodes
