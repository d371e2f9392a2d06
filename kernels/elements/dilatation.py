"""Dilatation that several elements share, so that nearly incompressible tissue does not lock.

The part of a law's energy that lambda multiplies is a function w of a dilatation theta of each element: tr e, tr E or
J - 1. Linear tetrahedra have more of these than a nearly incompressible body has displacements to spare, and lock. Here
elements share it. A group of elements, such as the eight leaves of a subtree, has the mean of theirs, weighted by
lambda and volume, and the energy
    W = sum over e of lambda_e V_e w(theta),  theta = sum of lambda_e V_e theta_e / sum of lambda_e V_e.

This alone would let an element of a group turn over while others grow, as elements of crushed tissue do. So where
theta_e is J - 1, W also has lambda_e V_e h(theta_e) for each element. h is zero up to |theta| = ``FREE``; from there on
h'' grows from 0 to 1 over ``RAMP``. Forces are exact derivatives: P_e = lambda_e (w'(theta) + h'(theta_e)) d theta_e /
dF.

Functions here take the displacement gradient A as ``constitutive`` has it. The kernels are in ``mean_dilatation``,
those of subtrees' forces in ``subtrees.forces``.
"""

import functools
from typing import NamedTuple

import warp as wp

from warp_corot.kernels.math.matrices import cofactor_differential
from warp_corot.kernels.math.rotation import cofactor, identity3

from .constitutive import (
    dilation,
    green_strain,
    volumetric_curvature,
    volumetric_energy,
    volumetric_slope,
)

wp.set_module_options({"enable_backward": False})


#: |J - 1| of an element up to which it is free to differ from its group's.
FREE = wp.constant(0.25)
#: Beyond that, the range of |J - 1| over which its stiffness grows to lambda.
RAMP = wp.constant(0.5)
#: Maximum number of elements in a group: three left of each of the six roots of a cube.
MOST = 18


class Dilatation(NamedTuple):
    """The functions (device code) that stand for lambda times half the square of a trace in a law.

    Attributes:
        lanes: The struct of ``native/dilatation.h`` that has them for lanes.
        measure: theta and d theta / dF of A.
        turning: The differential of d theta / dF at A in a direction dA.
        energy, slope, curvature: w and its derivatives, of theta.
        holding: h and its derivatives, of theta_e.
    """

    lanes: str
    measure: wp.Function
    turning: wp.Function
    energy: wp.Function
    slope: wp.Function
    curvature: wp.Function
    holding: wp.Function

    @property
    def key(self) -> str:
        """What names kernels, as functions' keys do."""
        return self.lanes[-1]


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


@wp.func
def held(theta: float):
    beyond = wp.max(wp.abs(theta) - FREE, 0.0)
    near = wp.min(beyond, RAMP)
    far = beyond - near
    slope = 0.5 * near * near / RAMP
    energy = near * slope / 3.0 + far * (slope + 0.5 * far)
    return wp.vec3(energy, wp.sign(theta) * (slope + far), near / RAMP)


@wp.func
def not_held(theta: float):
    return wp.vec3()


_SQUARE = (square_energy, square_slope, square_curvature)
#: tr e of linear elasticity, tr E of St. Venant-Kirchhoff, J - 1 of corotated and, in the logarithm, of neo-Hookean.
SMALL = Dilatation("SmallDilatation", small_dilatation, small_turning, *_SQUARE, not_held)
GREEN = Dilatation("GreenDilatation", green_dilatation, green_turning, *_SQUARE, not_held)
VOLUME = Dilatation("VolumeDilatation", volume_dilatation, volume_turning, *_SQUARE, held)
LOG_VOLUME = Dilatation(
    "LogVolumeDilatation",
    volume_dilatation,
    volume_turning,
    log_energy,
    log_slope,
    log_curvature,
    held,
)


@wp.func
def mean_of(sum: float, weight: float):
    """A weighted mean; zero where nothing has weight."""
    return wp.where(weight != 0.0, sum / wp.where(weight != 0.0, weight, 1.0), 0.0)


@functools.cache
def pressure_stress_of(of: Dilatation) -> wp.Function:
    """First Piola-Kirchhoff stress of an element with displacement gradient A.

    ``pressure`` is w' of the dilatation that it shares, ``weight`` is lambda or in proportion to it.
    """
    measure, holding = of.measure, of.holding

    @wp.func
    def pressure_stress(a: wp.mat33, pressure: float, weight: float):
        theta, slope = measure(a)
        return (weight * (pressure + holding(theta)[1])) * slope

    return pressure_stress
