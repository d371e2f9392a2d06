"""Dilatation that several elements share, so that nearly incompressible tissue does not lock.

The part of a law's energy that lambda multiplies is a function w of a dilatation theta of each element: tr e, tr E or
J - 1. Linear tetrahedra have more of these than a nearly incompressible body has displacements to spare, and lock. Here
elements share it. A group of elements, such as the eight leaves of a subtree, has the mean of theirs, weighted by
lambda and volume, and the energy
    W = sum over e of lambda_e V_e w(theta),  theta = sum of lambda_e V_e theta_e / sum of lambda_e V_e.

This alone would let an element of a group turn over while others grow, as elements of crushed tissue do. So where
theta_e is J - 1, W also has lambda_e V_e h(theta_e) for each element. h is zero up to |theta| = 0.25; from there on
h'' grows from 0 to 1 over 0.5. Forces are exact derivatives: P_e = lambda_e (w'(theta) + h'(theta_e)) d theta_e /
dF.

Functions here are those of ``native/dilatation.h`` and take the displacement gradient A as ``constitutive`` has it. The
kernels of subtrees' forces are in ``subtrees.forces``.
"""

import functools
from typing import Any, NamedTuple

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import add_nodal_forces, rest_volume
from warp_corot.kernels.elements.forces import (
    element_energies,
    in_local_frame,
    own_gradient,
    scatter_forces,
    to_own_frame,
)
from warp_corot.kernels.elements.simd8 import LAW_HEADERS, law_kernel
from warp_corot.kernels.modules import Family

wp.set_module_options({"enable_backward": False})


#: Maximum number of elements in a group: three left of each of the six roots of a cube.
MOST = 18


class Dilatation(NamedTuple):
    """The functions (device code) that stand for lambda times half the square of a trace in a law.

    Attributes:
        lanes: The struct of ``native/dilatation.h`` that has them.
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
        return self.lanes

    @property
    def is_held(self) -> bool:
        """Whether elements are held from turning over."""
        return self.lanes in ("VolumeDilatation", "LogVolumeDilatation")


def _dilatation(name: str) -> Dilatation:
    of = f"corot::{name}"

    @wp.func_native(f"return corot::theta_of<{of}>(a);")
    def theta_of(a: wp.mat33) -> float: ...

    @wp.func_native(f"return corot::slopes_of<{of}>(a);")
    def slopes_of(a: wp.mat33) -> wp.mat33: ...

    @wp.func
    def measure(a: wp.mat33):
        return theta_of(a), slopes_of(a)

    @wp.func_native(f"return corot::turning_of<{of}>(a, da);")
    def turning(a: wp.mat33, da: wp.mat33) -> wp.mat33: ...

    @wp.func_native(f"return {of}::energy(theta);")
    def energy(theta: float) -> float: ...

    @wp.func_native(f"return {of}::pressure(theta);")
    def slope(theta: float) -> float: ...

    @wp.func_native(f"return {of}::pressure(corot::dual_of<float>(theta, 1.0f)).slope;")
    def curvature(theta: float) -> float: ...

    held = f"{of}::holding(corot::dual_of<float>(theta, 1.0f))"

    @wp.func_native(f"const auto h = {held};\nreturn wp::vec3({of}::held_energy(theta), h.value, h.slope);")
    def holding(theta: float) -> wp.vec3: ...

    return Dilatation(name, measure, turning, energy, slope, curvature, holding)


#: tr e of linear elasticity, tr E of St. Venant-Kirchhoff, J - 1 of corotated and, in the logarithm, of neo-Hookean.
SMALL, GREEN, VOLUME, LOG_VOLUME = (
    _dilatation(f"{name}Dilatation") for name in ("Small", "Green", "Volume", "LogVolume")
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


# --- kernels of groups of elements -----------------------------------------------------------------------------------
#
# Kernels of a dilatation that elements share; see ``dilatation``.
#
# There are three passes. The first measures elements: theta, and its change along a direction if there is one. The
# second replaces these by the law's values for the shared ones of groups. The third, a thread an element again, adds
# forces, products or energies. Between them stands one vec4 an element: (theta, change, 0, 0) and then (w, w', w''
# change, w''), at the elements' places in the mesh.
#
# Launches may be larger than the mesh: ``live`` has the current number of elements; without it, all count.

OF_ELEMENTS = Family(__name__, LAW_HEADERS)


@wp.func
def place_of(places: wp.array[wp.int32], t: int):
    """The place of element t in the mesh; without ``places`` it is t."""
    place = t
    if places.shape[0] > 0:
        place = places[t]
    return place


@wp.func
def is_live(live: wp.array[wp.int32], t: int):
    if live.shape[0] > 0:
        return t < live[0]
    return True


@functools.cache
def law_at(of: Dilatation) -> wp.Function:
    """The numbers of the third pass for a shared dilatation and its change."""
    energy_of, slope_of, curvature_of = of.energy, of.slope, of.curvature

    @wp.func
    def law_at(theta: float, change: float):
        curvature = curvature_of(theta)
        return wp.vec4(energy_of(theta), slope_of(theta), curvature * change, curvature)

    return law_at


@functools.cache
def weight_law_at(of: Dilatation) -> wp.Function:
    """The same for derivatives with respect to elements' weights, with w'' theta times the change in the place of w."""
    slope_of, curvature_of = of.slope, of.curvature

    @wp.func
    def weight_law_at(theta: float, change: float):
        curvature = curvature_of(theta) * change
        return wp.vec4(curvature * theta, slope_of(theta), curvature, 0.0)

    return weight_law_at


# --- the first pass ---------------------------------------------------------------------------------------------------


@OF_ELEMENTS.member
def measure_elements(Elements: type, of: Dilatation) -> wp.Kernel:
    measure = of.measure

    @OF_ELEMENTS.kernel()
    def measure_elements(
        # In
        elements: Elements,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        u: wp.array[wp.vec4],
        p: wp.array[wp.vec4],
        # Out
        shared: wp.array[wp.vec4],
    ):
        if not is_live(live, wp.tid()):
            return
        t = place_of(places, wp.tid())
        theta, slope = measure(own_gradient(elements, t, u))
        change = float(0.0)
        if p.shape[0] > 0:
            change = wp.ddot(slope, own_gradient(elements, t, p))
        shared[t] = wp.vec4(theta, change, 0.0, 0.0)

    return measure_elements


# --- the second pass: groups ------------------------------------------------------------------------------------------


@wp.func
def range_of(starts: wp.array[wp.int32], members: wp.array[wp.int32], g: int):
    """The range of a group in its members, or, where there are none, of a subtree's leaves in the mesh."""
    begin = starts[g]
    end = begin + 8
    if members.shape[0] > 0:
        end = starts[g + 1]
    return begin, end


@functools.cache
def share_in_groups(Elements: type, law: wp.Function) -> wp.Kernel:
    """A thread a group; see ``range_of`` for what a group is."""

    @law_kernel()
    def share_in_groups(
        # In
        starts: wp.array[wp.int32],
        members: wp.array[wp.int32],
        live: wp.array[wp.int32],
        elements: Elements,
        material: IsotropicMaterial,
        # In and out
        shared: wp.array[wp.vec4],
    ):
        g = wp.tid()
        if not is_live(live, g):
            return
        begin, end = range_of(starts, members, g)
        theta = float(0.0)
        change = float(0.0)
        total = float(0.0)
        for i in range(begin, end):
            t = place_of(members, i)
            weight = material.lam[t * material.stride] * rest_volume(elements, t)
            theta += weight * shared[t][0]
            change += weight * shared[t][1]
            total += weight
        value = law(mean_of(theta, total), mean_of(change, total))
        for i in range(begin, end):
            shared[place_of(members, i)] = value

    return share_in_groups


# --- the third pass ---------------------------------------------------------------------------------------------------


@wp.func
def scatter(elements: Any, targets: wp.vec4i, t: int, stress: wp.mat33, f: wp.array[wp.vec4]):
    add_nodal_forces(elements, t, in_local_frame(elements, t, stress), targets, f)


@OF_ELEMENTS.member
def scatter_pressures(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add forces."""
    pressure_stress = pressure_stress_of(of)

    @OF_ELEMENTS.kernel()
    def scatter_pressures(
        # In
        elements: Elements,
        places: wp.array[wp.int32],
        live: wp.array[wp.int32],
        material: IsotropicMaterial,
        u: wp.array[wp.vec4],
        shared: wp.array[wp.vec4],
        # Out
        f: wp.array[wp.vec4],
    ):
        if not is_live(live, wp.tid()):
            return
        t = place_of(places, wp.tid())
        lam = material.lam[t * material.stride]
        stress = pressure_stress(own_gradient(elements, t, u), shared[t][1], lam)
        scatter(elements, elements.targets[t], t, stress, f)

    return scatter_pressures


@wp.struct
class DilatedMaterial:
    """Lamé's parameters, and the numbers (w, w', …) of the dilatation that each element shares."""

    isotropic: IsotropicMaterial
    shared: wp.array[wp.vec4]
    turning: float  # 0: without the change of d theta / dF, which leaves what is positive semidefinite; 1: with it


@functools.cache
def own_differential(of: Dilatation) -> wp.Function:
    """The differential of an element's stress for ``forces``, the shared dilatation held fixed."""
    measure, turning_of, holding = of.measure, of.turning, of.holding

    @wp.func
    def own_differential(elements: Any, t: int, material: DilatedMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        a = own_gradient(elements, t, u)
        theta, slope = measure(a)
        held = holding(theta)
        d = to_own_frame(elements, t, dg)
        pressure = material.turning * (material.shared[t][1] + held[1])
        stress = (held[2] * wp.ddot(slope, d)) * slope + pressure * turning_of(a, d)
        return material.isotropic.lam[t * material.isotropic.stride] * in_local_frame(elements, t, stress)

    return own_differential


@functools.cache
def shared_density(of: Dilatation) -> wp.Function:
    """An element's share of the energy density for ``forces``."""
    measure, holding = of.measure, of.holding

    @wp.func
    def shared_density(elements: Any, t: int, material: DilatedMaterial, u: wp.array[wp.vec4]):
        theta, _slope = measure(own_gradient(elements, t, u))
        lam = material.isotropic.lam[t * material.isotropic.stride]
        return lam * (material.shared[t][0] + holding(theta)[0])

    return shared_density


@functools.cache
def unshared_stress(of: Dilatation) -> wp.Function:
    """The stress for ``forces`` by which a dilatation of each element's own differs from the shared one."""
    measure, slope_of = of.measure, of.slope

    @wp.func
    def unshared_stress(elements: Any, t: int, material: DilatedMaterial, u: wp.array[wp.vec4]):
        theta, slope = measure(own_gradient(elements, t, u))
        lam = material.isotropic.lam[t * material.isotropic.stride]
        return in_local_frame(elements, t, (lam * (slope_of(theta) - material.shared[t][1])) * slope)

    return unshared_stress


@OF_ELEMENTS.member
def add_energies(Elements: type, of: Dilatation) -> wp.Kernel:
    """Add each element's share of the energy [J]."""
    return element_energies(Elements, DilatedMaterial, shared_density(of), OF_ELEMENTS.kernel, adds=True)


@OF_ELEMENTS.member
def unshare(Elements: type, of: Dilatation) -> wp.Kernel:
    """Change forces to those of separate dilatations."""
    return scatter_forces(Elements, DilatedMaterial, unshared_stress(of), OF_ELEMENTS.kernel)
