"""Kernels of a dilatation that elements share; see ``dilatation``.

There are three passes. The first measures elements: theta, and its change along a direction if there is one. The second
replaces these by the law's values for the shared ones of groups. The third, a thread an element again,
adds forces, products or energies. Between them stands one vec4 an element: (theta, change, 0, 0) and then (w, w', w''
change, w''), at the elements' places in the mesh.

Launches may be larger than the mesh: ``live`` has the current number of elements; without it, all count.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.modules import Family, unique_kernel

from .constitutive import IsotropicMaterial
from .dilatation import Dilatation, mean_of, pressure_stress_of
from .elements import add_nodal_forces, rest_volume
from .forces import element_energies, in_local_frame, own_gradient, scatter_forces, to_own_frame

wp.set_module_options({"enable_backward": False})

OF_ELEMENTS = Family(__name__)


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
        t = wp.tid()
        if not is_live(live, t):
            return
        theta, slope = measure(own_gradient(elements, t, u))
        change = float(0.0)
        if p.shape[0] > 0:
            change = wp.ddot(slope, own_gradient(elements, t, p))
        shared[place_of(places, t)] = wp.vec4(theta, change, 0.0, 0.0)

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

    @unique_kernel()
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
        t = wp.tid()
        if not is_live(live, t):
            return
        place = place_of(places, t)
        lam = material.lam[place * material.stride]
        stress = pressure_stress(own_gradient(elements, t, u), shared[place][1], lam)
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
    """The differential of an element's stress for ``stiffness_products``, the shared dilatation held fixed."""
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
