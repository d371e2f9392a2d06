"""The laws of elements in clusters: stress from displacement gradient, with the material data that each law needs."""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.clusters.pairs import (
    PairClusters,
    add_sum,
    fetch_records,
    first_matrix,
    first_scale,
    half_word,
    number_of,
    record_of,
    scaled_difference,
    second_matrix,
    second_scale,
    shared_quads,
    vector_of,
)
from warp_corot.kernels.corotated.anisotropic import (
    REINFORCED,
    OrthotropicMaterial,
    ReinforcedMaterial,
    axes_of,
    filled,
    orthotropic_stress,
    vec9,
)
from warp_corot.kernels.corotated.well_conditioned import definite_law, definite_strain, is_definite, load_axes
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation, mean_of, pressure_stress_of
from warp_corot.kernels.elements.simd8 import law_kernel
from warp_corot.kernels.math.rotation import ITERATIONS, byers_xu, column, identity3, newton_rotation
from warp_corot.kernels.stepping.block_memory import LOAD, STORE
from warp_corot.kernels.stepping.threads import synchronize_block
from warp_corot.kernels.tables.cluster_layout import QUAD_BYTES, PairLayout

wp.set_module_options({"enable_backward": False})


@wp.struct
class ActiveMaterial:
    """An orthotropic material, its axes also as quaternions, and the active stress of each element."""

    passive: OrthotropicMaterial
    axes: wp.array[wp.quat]
    is_active: int
    activation: wp.array[wp.float32]


@functools.cache
def isotropic_law(stress: wp.Function) -> wp.Function:
    """A law of ``elements.constitutive`` for the i-th element of a list, times ``scale``."""

    @wp.func
    def isotropic_law(material: IsotropicMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
        t = int(0)
        if material.stride != 0:
            t = number_of(listed, i)
        return stress(w, scale * material.mu[t], scale * material.lam[t])

    return isotropic_law


@wp.func(inline=False)
def robust_stress(g: wp.mat33, m: wp.mat33, c: vec9, mu: float, lam: float):
    """P of an F = I + g for which the unscaled iteration finds no rotation, or whose rotation is hardly definite.

    The arguments are the axes, the stiffness in these, and the nearest isotropic material.
    """
    turned_gradient = g * m
    r = byers_xu(m + turned_gradient)
    return orthotropic_stress(turned_gradient, m, r, c, mu, lam) * wp.transpose(m)


@functools.cache
def anisotropic_law(transverse: bool) -> wp.Function:
    """The anisotropic corotated law, for elements whose axes are the axes of rest space."""
    law = definite_law(transverse)

    @wp.func
    def anisotropic_law(material: ActiveMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
        t = number_of(listed, i)
        n = wp.quat_to_matrix(load_axes(material.axes, t * material.passive.axes_stride))
        gradient = identity3() + w
        f0 = column(gradient, 0)
        f1 = column(gradient, 1)
        f2 = column(gradient, 2)
        filled_scale = scale * filled(material.passive, t)
        z0, z1, z2, trusted = newton_rotation(f0, f1, f2, 1.0)
        e = definite_strain(z0, z1, z2, f0, f1, f2, w, w)
        p = wp.mat33()
        k = t * material.passive.stride
        stiffness = material.passive.stiffness[k]
        if trusted and is_definite(e):
            p = wp.matrix_from_cols(z0, z1, z2) * law(e, n, stiffness, wp.static(0.5**ITERATIONS) * filled_scale)
        else:
            m = axes_of(material.passive, t)
            p = filled_scale * robust_stress(w, m, stiffness, material.passive.mu[k], material.passive.lam[k])
        if material.is_active != 0:
            d = column(n, 0)
            p += wp.outer((filled_scale * material.activation[t]) * (gradient * d), d)
        return p

    return anisotropic_law


_reinforced_stress = REINFORCED.in_rest_axes


@wp.func
def reinforced_law(material: ReinforcedMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33):
    """The law of Holzapfel, Gasser and Ogden, for elements whose axes are the axes of rest space."""
    return scale * _reinforced_stress(number_of(listed, i), w, material)


# --- groups that share their dilatation ------------------------------------------------------------------------------
#
# Elements in clusters that share their dilatation in groups (CUDA): sums over groups, and laws that add the pressure.
#
# A launch measures the elements, cluster by cluster, and adds up those of each group. The launch of clusters then
# adds the group's pressure to the stress of the law, so that each element's forces are added up once. See
# ``kernels.elements.dilatation``.

#: Blocks of the launch that measures that a multiprocessor's registers must have room for.
RESIDENT = 10


@wp.struct
class SharingMaterial:
    """The material of a law without lambda's part, and what that part needs."""

    isotropic: IsotropicMaterial  # its lambda is zero
    lam: wp.array[wp.float32]  # as the elements have it
    groups: wp.array[wp.int32]  # the group of each element that clusters list
    sums: wp.array[wp.vec4]  # of each group: lambda V theta, lambda V


@functools.cache
def shared_pressure(of: Dilatation) -> wp.Function:
    """w' of the dilatation that the i-th element of a list shares."""
    slope_of = of.slope

    @wp.func
    def shared_pressure(material: SharingMaterial, i: int):
        sum = vector_of(material.sums, number_of(material.groups, i))
        return slope_of(mean_of(sum[0], sum[1]))

    return shared_pressure


@functools.cache
def sharing_law(law: wp.Function, of: Dilatation) -> wp.Function:
    """A law of ``laws`` with the stress of a dilatation whose w' is given."""
    pressure_stress = pressure_stress_of(of)

    @wp.func
    def sharing_law(
        material: SharingMaterial, listed: wp.array[wp.int32], i: int, scale: float, w: wp.mat33, pressure: float
    ):
        t = int(0)
        if material.isotropic.stride != 0:
            t = number_of(listed, i)
        return law(material.isotropic, listed, i, scale, w) + pressure_stress(w, pressure, scale * material.lam[t])

    return sharing_law


@functools.cache
def pair_dilatations(of: Dilatation) -> wp.Function:
    """The dilatations of both elements of a pair from its five nodes' displacements."""
    measure = of.measure

    @wp.func
    def pair_dilatations(pairs: Any, record: Any, ua: wp.vec3, ub: wp.vec3, uc: wp.vec3, ud: wp.vec3, ue: wp.vec3):
        e1 = scaled_difference(pairs, ub - ua)
        e2 = scaled_difference(pairs, uc - ua)
        e3 = scaled_difference(pairs, ud - ua)
        e4 = scaled_difference(pairs, ue - ua)
        first, _slope = measure(wp.matrix_from_cols(e1, e2, e3) * first_matrix(record))
        second, _slope = measure(wp.matrix_from_cols(e1, e2, e4) * second_matrix(record))
        return first, second

    return pair_dilatations


@wp.func
def add_pair(
    clusters: PairClusters,
    pairs: Any,
    record: Any,
    group: int,
    other: int,
    stride: int,
    lam: wp.array[wp.float32],
    i: int,
    first_theta: float,
    second_theta: float,
    sums: wp.array[wp.vec4],
):
    """Add both elements of the i-th pair to the sums of their groups. An element that is missing has no volume."""
    first = first_scale(pairs, record)
    second = second_scale(pairs, record)
    if stride == 0:
        first *= lam[0]
        second *= lam[0]
    else:
        first *= lam[number_of(clusters.elements, 2 * i)]
        second *= lam[number_of(clusters.elements, 2 * i + 1)]
    sum = wp.vec3(first * first_theta, first, 0.0)
    if second > 0.0:
        others = wp.vec3(second * second_theta, second, 0.0)
        if other == group:
            sum += others
        else:
            add_sum(sums, other, others)
    if first > 0.0:
        add_sum(sums, group, sum)


@functools.cache
def measure_pairs(Pairs: type, of: Dilatation, layout: PairLayout) -> wp.Kernel:
    """Add up lambda V theta and lambda V of each group; launch as ``pairs.scatter_pairs``.

    In a forest volumes are over the edge of a root cube, which means of a group do not show.
    """
    threads, dilatations, fetch = layout.threads, pair_dilatations(of), fetch_records(Pairs)
    displacement = shared_quads(threads, "displacements")

    @law_kernel(grid_stride=False, launch_bounds=(threads, RESIDENT))
    def measure_pairs(
        # In
        clusters: PairClusters,
        pairs: Pairs,
        groups: wp.array[wp.int32],
        stride: int,
        lam: wp.array[wp.float32],
        u: wp.array[wp.vec4],
        # Out
        sums: wp.array[wp.vec4],
    ):
        i = wp.tid()
        node = number_of(clusters.nodes, i)
        record = record_of(pairs, i)
        group = number_of(groups, 2 * i)
        other = number_of(groups, 2 * i + 1)
        if wp.static(layout.ahead > 0):
            fetch(clusters, pairs, i + wp.static(layout.ahead * threads))
        if node >= 0:
            displacement(wp.static(STORE), wp.static(QUAD_BYTES) * (i % wp.static(threads)), vector_of(u, node))
        synchronize_block()
        first, second = dilatations(
            pairs,
            record,
            displacement(wp.static(LOAD), half_word(record, 0), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 1), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 2), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 3), wp.vec3()),
            displacement(wp.static(LOAD), half_word(record, 4), wp.vec3()),
        )
        add_pair(clusters, pairs, record, group, other, stride, lam, i, first, second, sums)

    return measure_pairs
