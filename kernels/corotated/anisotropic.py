"""Corotated forces of orthotropic materials, and active stress along their first axis.

The law works in the material's axes: with M their rotation into rest space, F M and its rotation R M take the place of
the local frame's F Q and R Q, and the stiffness is nine numbers. With S = R^T F and s = C : (S - I), the energy density
(S - I) : s / 2 has the derivative R (s + [a]x), where (tr(S) I - S) a is the axial vector of S s - s S. The vector a
appears because R turns as F changes. It is zero for isotropic materials, and it keeps other materials free of torque.

tr(S) I - S is singular where F has no definite rotation: flat in two directions, or inverted by as much in one as is
left in another. Near there the law goes over smoothly to the nearest isotropic one, which needs no a: the energy is
W_iso + b (W - W_iso), where b falls from one to zero with det(tr(S) I - S) / |S|^3, and the force its derivative.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.corotated.tangent import rotation_differential, stretch_turning
from warp_corot.kernels.elements.constitutive import corotated_strain, hooke, stretch_strain, symmetric
from warp_corot.kernels.elements.cpu import rest_inverse_of
from warp_corot.kernels.elements.elements import ForestElements, GeneralElements, frame, local_gradient, rest_volume
from warp_corot.kernels.elements.simd8 import headers, scatter_simd8
from warp_corot.kernels.math.matrices import axial, cofactor, cofactor_differential, column, identity3, largest_entry
from warp_corot.kernels.math.rotation import cofactor, column, identity3, largest_entry
from warp_corot.kernels.modules import unique_kernel

wp.set_module_options({"enable_backward": False})

vec9 = wp.types.vector(length=9, dtype=wp.float32)

#: det(tr(S) I - S) / |S|^3 below which a law turns isotropic: 1.54 at rest, 0.4 flattened to 16 % in two directions, as
#: fibres are that stretch 3.4 times, or inverted to -0.22 in one. With less, the transition is so steep that crushed
#: bodies gain energy in explicit steps.
INDEFINITE = wp.constant(0.4)


@wp.struct
class OrthotropicMaterial:
    """Axes and stiffness of each element, arrays of one entry (stride 0) or one per element (stride 1)."""

    axes: wp.array[wp.mat33]  # in rest space, the columns of a rotation
    axes_stride: int
    stiffness: wp.array[vec9]  # C_11, C_22, C_33, C_12, C_13, C_23, G_12, G_13, G_23 [Pa]
    mu: wp.array[wp.float32]  # of the nearest isotropic material [Pa]
    lam: wp.array[wp.float32]
    stride: int  # of the last three
    fill: wp.array[wp.float32]  # share of an element's volume that the body takes
    fill_stride: int


@wp.struct
class FibreMaterial:
    """An orthotropic material, and the active stress of each element."""

    passive: OrthotropicMaterial
    is_active: int
    activation: wp.array[wp.float32]


@wp.func
def axes_of(material: OrthotropicMaterial, t: int):
    return material.axes[t * material.axes_stride]


@wp.func
def filled(material: OrthotropicMaterial, t: int):
    return material.fill[t * material.fill_stride]


@wp.func
def orthotropic_stress(strain: wp.mat33, c: vec9):
    s01 = 2.0 * c[6] * strain[0, 1]
    s02 = 2.0 * c[7] * strain[0, 2]
    s12 = 2.0 * c[8] * strain[1, 2]
    e0 = strain[0, 0]
    e1 = strain[1, 1]
    e2 = strain[2, 2]
    return wp.mat33(
        c[0] * e0 + c[3] * e1 + c[4] * e2, s01, s02,
        s01, c[3] * e0 + c[1] * e1 + c[5] * e2, s12,
        s02, s12, c[4] * e0 + c[5] * e1 + c[2] * e2,
    )  # fmt: skip


@wp.func
def definiteness(strain: wp.mat33):
    """How definite the rotation is, from S scaled to order one, so that no power of it is out of range.

    Returns:
        b, its derivative with respect to the scaled S, the scale, and adjugate and determinant of tr(S) I - S.
    """
    s = strain + identity3()
    scale = 1.0 / wp.max(largest_entry(s), 1.0e-30)
    s = s * scale
    h = wp.trace(s) * identity3() - s
    adjugate = cofactor(h)
    det = wp.dot(column(h, 0), column(adjugate, 0))
    n2 = wp.max(wp.ddot(s, s), 1.0e-12)
    n3 = n2 * wp.sqrt(n2)
    x = det / n3
    share = float(1.0)
    slope = wp.mat33()
    if x < INDEFINITE:
        y = wp.clamp(x / INDEFINITE, 0.0, 1.0)
        share = y * y * (3.0 - 2.0 * y)
        of_x = (wp.trace(adjugate) * identity3() - adjugate) / n3 - (3.0 * x / n2) * s
        slope = (6.0 * y * (1.0 - y) / INDEFINITE) * of_x
    return share, slope, scale, adjugate, det


@wp.func
def turned_stress(strain: wp.mat33, material: OrthotropicMaterial, t: int):
    """R^T P: its symmetric part, and the axial vector of its skew part."""
    i = t * material.stride
    stress, a = turned_stress_of(strain, material.stiffness[i], material.mu[i], material.lam[i])
    return stress, a


@wp.func
def turned_stress_of(strain: wp.mat33, c: vec9, mu: float, lam: float):
    """The same, from a stiffness and the nearest isotropic material."""
    stress = orthotropic_stress(strain, c)
    share, slope, scale, adjugate, det = definiteness(strain)
    e = strain * scale
    turning = stress
    if share < 1.0:
        isotropic = hooke(strain, mu, lam)
        excess = stress - isotropic
        turning = share * excess
        stress = isotropic + turning + (0.5 * wp.ddot(e, excess)) * slope
    w = e * turning
    axial = wp.vec3(w[2, 1] - w[1, 2], w[0, 2] - w[2, 0], w[1, 0] - w[0, 1])
    return stress, adjugate * axial / wp.max(det, 1.0e-20)


@wp.func
def energy_density(strain: wp.mat33, material: OrthotropicMaterial, t: int):
    i = t * material.stride
    stress = orthotropic_stress(strain, material.stiffness[i])
    share, _slope, _scale, _adjugate, _det = definiteness(strain)
    if share < 1.0:
        isotropic = hooke(strain, material.mu[i], material.lam[i])
        stress = isotropic + share * (stress - isotropic)
    return 0.5 * wp.ddot(strain, stress)


@wp.func
def material_gradient(elements: Any, t: int, m: wp.mat33, u: wp.array[wp.vec4]):
    """(du/dX) M, and Q^T M, which turns the local frame's columns into the material's."""
    turn = wp.transpose(frame(elements, t)) * m
    return local_gradient(elements, t, u) * turn, turn


@wp.func
def material_strain(g: wp.mat33, m: wp.mat33, r: wp.mat33):
    """e = S - I in the material's axes; r is the rotation of m + g."""
    return stretch_strain(corotated_strain(g, m, r), wp.transpose(m) * g)


@functools.cache
def listed_stress(rotation: wp.Function) -> wp.Function:
    """Stress of element k of a list that has the material and activation of the mesh's element t, each with its own
    rotation; elastic and active stress together."""

    @wp.func
    def listed_stress(elements: Any, k: int, material: FibreMaterial, t: int, u: wp.array[wp.vec4]):
        m = axes_of(material.passive, t)
        g, turn = material_gradient(elements, k, m, u)
        r = rotation(m + g)
        stress, a = turned_stress(material_strain(g, m, r), material.passive, t)
        p = r * (stress + wp.skew(a))
        if material.is_active != 0:
            # s (F d) d^T, and d is the first axis.
            pull = material.activation[t] * column(m + g, 0)
            p += wp.outer(pull, wp.vec3(1.0, 0.0, 0.0))
        return (filled(material.passive, t) * p) * wp.transpose(turn)

    return listed_stress


# --- the law, for the kernels of ``elements.forces`` ------------------------------------------------------------------


@functools.cache
def fibre_stress(rotation: wp.Function) -> wp.Function:
    """Elastic and active stress, with the element's own rotation."""
    stress = listed_stress(rotation)

    @wp.func
    def fibre_stress(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        return stress(elements, t, material, t, u)

    return fibre_stress


@functools.cache
def own_strain(rotation: wp.Function) -> wp.Function:
    """The strain in the material's axes."""

    @wp.func
    def own_strain(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        m = axes_of(material.passive, t)
        g, _turn = material_gradient(elements, t, m, u)
        return material_strain(g, m, rotation(m + g))

    return own_strain


@functools.cache
def fibre_density(rotation: wp.Function) -> wp.Function:
    """Energy density; active stress has none."""
    strain = own_strain(rotation)

    @wp.func
    def fibre_density(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        passive = material.passive
        return filled(passive, t) * energy_density(strain(elements, t, material, u), passive, t)

    return fibre_density


@functools.cache
def fibre_cauchy(rotation: wp.Function) -> wp.Function:
    """Elastic and active stress together, in the frame that turns with the element."""
    strain = own_strain(rotation)

    @wp.func
    def fibre_cauchy(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        stress, _a = turned_stress(strain(elements, t, material, u), material.passive, t)
        if material.is_active != 0:
            stress[0, 0] += material.activation[t]
        return stress

    return fibre_cauchy


@wp.func
def active_density(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
    """Energy density that an element's active stress s would have if s stayed constant: s (|F d|^2 - 1) / 2."""
    m = axes_of(material.passive, t)
    g, _turn = material_gradient(elements, t, m, u)
    d = column(g, 0)
    return filled(material.passive, t) * material.activation[t] * wp.dot(column(m, 0) + 0.5 * d, d)


# --- the differential ------------------------------------------------------------------------------------------------
#
# The exact differential of the anisotropic corotated law, for ``elements.forces``.
#
# In the material's axes P = R (s + [a]x), where s is the derivative of the energy density with respect to S, H a =
# axial(S s), and H = tr(S) I - S (see ``anisotropic``). With b = R^T dF, H w = axial(b) and dS = sym(b - [w]x S),
#     dP = R ([w]x (s + [a]x) + ds + [da]x),  H da = axial(dS s + S ds) - dH a.
# The isotropic part of s adds nothing to axial(S s). The change of the rotation is bounded as in ``tangent``.
#
# Active stress s (F d) d^T is linear in F; its s is held fixed.


@wp.func
def share_differential(strain: wp.mat33, d_strain: wp.mat33):
    """The share b of the law that is not isotropic (``anisotropic.definiteness``), db, and the derivative of b with
    respect to S and its differential."""
    scale = 1.0 / wp.max(largest_entry(strain + identity3()), 1.0e-30)
    s = scale * (strain + identity3())
    ds = scale * d_strain
    h = wp.trace(s) * identity3() - s
    adjugate = cofactor(h)
    n2 = wp.max(wp.ddot(s, s), 1.0e-12)
    n3 = n2 * wp.sqrt(n2)
    x = wp.dot(column(h, 0), column(adjugate, 0)) / n3
    share = float(1.0)
    d_share = float(0.0)
    slope = wp.mat33()
    d_slope = wp.mat33()
    if x < INDEFINITE:
        y = wp.clamp(x / INDEFINITE, 0.0, 1.0)
        share = y * y * (3.0 - 2.0 * y)
        first = 6.0 * y * (1.0 - y) / INDEFINITE
        second = (6.0 - 12.0 * y) / (INDEFINITE * INDEFINITE)
        of_det = (wp.trace(adjugate) * identity3() - adjugate) / n3
        of_x = of_det - (3.0 * x / n2) * s
        dx = wp.ddot(of_x, ds)
        d_adjugate = cofactor_differential(h, wp.trace(ds) * identity3() - ds)
        growth = wp.ddot(s, ds) / n2
        d_of_x = (wp.trace(d_adjugate) * identity3() - d_adjugate) / n3 - (3.0 * growth) * of_det
        d_of_x += ((6.0 * x * growth - 3.0 * dx) / n2) * s - (3.0 * x / n2) * ds
        d_share = first * dx
        slope = (scale * first) * of_x
        d_slope = scale * ((second * dx) * of_x + first * d_of_x)
    return share, d_share, slope, d_slope


@wp.func
def stress_differential(strain: wp.mat33, d_strain: wp.mat33, c: vec9, mu: float, lam: float):
    """ds, and the part of s that is not isotropic with its differential."""
    stress = orthotropic_stress(strain, c)
    d_stress = orthotropic_stress(d_strain, c)
    share, d_share, slope, d_slope = share_differential(strain, d_strain)
    turning = stress
    d_turning = d_stress
    if share < 1.0:
        excess = stress - hooke(strain, mu, lam)
        isotropic = hooke(d_strain, mu, lam)
        turning = share * excess
        d_turning = share * (d_stress - isotropic) + d_share * excess
        d_stress = isotropic + d_turning
        d_stress += wp.ddot(excess, d_strain) * slope + (0.5 * wp.ddot(strain, excess)) * d_slope
    return d_stress, turning, d_turning


@functools.cache
def anisotropic_differential(rotation: wp.Function) -> wp.Function:
    """With the element's own rotation and its turning, and its active stress."""

    @wp.func
    def anisotropic_differential(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        passive = material.passive
        i = t * passive.stride
        m = axes_of(passive, t)
        g, turn = material_gradient(elements, t, m, u)
        df = dg * turn
        r = rotation(m + g)
        strain = material_strain(g, m, r)
        stress, a = turned_stress(strain, passive, t)
        b = wp.transpose(r) * df
        w = wp.skew(rotation_differential(strain, b))
        d_strain = symmetric(b - w * strain)
        c = passive.stiffness[i]
        d_stress, turning, d_turning = stress_differential(strain, d_strain, c, passive.mu[i], passive.lam[i])
        adjugate, det, scale = stretch_turning(strain)
        of_a = axial(d_strain * turning + strain * d_turning) - (wp.trace(d_strain) * a - d_strain * a)
        da = (scale / det) * (adjugate * of_a)
        p = r * (w * (stress + wp.skew(a)) + d_stress + wp.skew(da))
        if material.is_active != 0:
            p += wp.outer(material.activation[t] * column(df, 0), wp.vec3(1.0, 0.0, 0.0))
        return (filled(passive, t) * p) * wp.transpose(turn)

    return anisotropic_differential


# --- on the CPU, eight elements at a time ----------------------------------------------------------------------------
#
# Corotated forces of orthotropic elements on the CPU, eight to the lanes of vector registers; see ``elements.simd8``.
#
# Both kinds of elements come as general ones, with M multiplied into their rest matrix: F M = M + (d1 d2 d3) B. An
# element of which no rotation is found adds nothing and is put on a list, which ``forces.repair_forces`` goes
# through. Elements whose rotation is nearly indefinite are left out, too (see ``anisotropic``): det(tr(S) I - S) = q
# / 2 below ``NEARLY_INDEFINITE`` |S|^3.

#: Corotated forces of orthotropic elements, whose inverse rest matrix is Dm^-1 M, and forces of their active stress.
scatter_anisotropic_simd8 = scatter_simd8(
    "corot::scatter_orthotropic(units, block, count, material, u, f, missed)",
    GeneralElements,
    FibreMaterial,
    wp.int32,
    headers("law_orthotropic"),
)


@wp.func
def turn_element(
    elements: Any,
    material: OrthotropicMaterial,
    t: int,
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    rest_inverse[t] = rest_inverse_of(elements, t, wp.transpose(frame(elements, t)) * axes_of(material, t))
    volume[t] = filled(material, t) * rest_volume(elements, t)


@functools.cache
def turn_elements(Elements: type) -> wp.Kernel:
    """Elements of either kind as ``scatter_anisotropic_simd8`` wants them: Dm^-1 M, and the filled volume."""

    @unique_kernel()
    def turn_elements(
        # In
        elements: Elements,
        material: OrthotropicMaterial,
        # Out
        rest_inverse: wp.array[wp.mat33],
        volume: wp.array[wp.float32],
    ):
        turn_element(elements, material, wp.tid(), rest_inverse, volume)

    return turn_elements


@unique_kernel()
def turn_changed(
    # In
    threads: int,
    goes: wp.array[wp.int32],
    now: wp.array[wp.int32],
    before: wp.array[wp.int32],
    elements: ForestElements,
    material: OrthotropicMaterial,
    # Out
    rest_inverse: wp.array[wp.mat33],
    volume: wp.array[wp.float32],
):
    """The same for leaves that have changed, and for the padding in their places; nothing if ``goes`` is 0."""
    count = wp.max(now[0], before[0])
    if goes[0] == 0:
        count = 0
    for t in range(wp.tid(), count, threads):
        turn_element(elements, material, t, rest_inverse, volume)
