"""Corotated forces of orthotropic materials, and active stress along their first axis.

The law works in the material's axes: with M their rotation into rest space, F M and its rotation R M take the place of
the local frame's F Q and R Q, and the stiffness is nine numbers. With S = R^T F and s = C : (S - I), the energy density
(S - I) : s / 2 has the derivative R (s + [a]x), where (tr(S) I - S) a is the axial vector of S s - s S. The vector a
appears because R turns as F changes. It is zero for isotropic materials, and it keeps other materials free of torque.

tr(S) I - S is singular where F has no definite rotation: flat in two directions, or inverted by as much in one as is
left in another. Near there the law goes over smoothly to the nearest isotropic one, which needs no a: the energy is
W_iso + b (W - W_iso), where b falls from one to zero with det(tr(S) I - S) / |S|^3, and the force its derivative. See
``native/law_anisotropic.h``.
"""

import functools
from typing import Any

import warp as wp

from warp_corot.kernels.elements.constitutive import IsotropicMaterial, push_forward
from warp_corot.kernels.elements.elements import frame, local_gradient
from warp_corot.kernels.elements.forces import element_law
from warp_corot.kernels.elements.simd8 import FIBRES
from warp_corot.kernels.math.matrices import column

wp.set_module_options({"enable_backward": False})

vec9 = wp.types.vector(length=9, dtype=wp.float32)


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
def material_gradient(elements: Any, t: int, m: wp.mat33, u: wp.array[wp.vec4]):
    """(du/dX) M, and Q^T M, which turns the local frame's columns into the material's."""
    turn = wp.transpose(frame(elements, t)) * m
    return local_gradient(elements, t, u) * turn, turn


_LAW = "corot::Orthotropic{&c[0], mu, lam}"


@wp.func_native(f"return corot::orthotropic_stress({_LAW}, g, m, r);")
def orthotropic_stress(g: wp.mat33, m: wp.mat33, r: wp.mat33, c: vec9, mu: float, lam: float) -> wp.mat33:
    """P M of G M, the axes M, R M, the stiffness and the nearest isotropic material."""
    ...


@wp.func_native(f"return corot::orthotropic_differential({_LAW}, g, m, r, dg);")
def orthotropic_differential(
    g: wp.mat33, m: wp.mat33, r: wp.mat33, dg: wp.mat33, c: vec9, mu: float, lam: float
) -> wp.mat33: ...


@wp.func_native(f"return corot::orthotropic_energy({_LAW}, g, m, r);")
def orthotropic_energy(g: wp.mat33, m: wp.mat33, r: wp.mat33, c: vec9, mu: float, lam: float) -> float: ...


@wp.func_native(f"return corot::orthotropic_cauchy({_LAW}, g, m, r);")
def orthotropic_cauchy(g: wp.mat33, m: wp.mat33, r: wp.mat33, c: vec9, mu: float, lam: float) -> wp.mat33:
    """The symmetric part of R^T P, in the axes."""
    ...


# --- the law, for the kernels of ``elements.forces`` ------------------------------------------------------------------


@functools.cache
def fibre_stress(rotation: wp.Function) -> wp.Function:
    """Elastic and active stress, with the element's own rotation."""

    @wp.func
    def fibre_stress(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        passive = material.passive
        i = t * passive.stride
        m = axes_of(passive, t)
        g, turn = material_gradient(elements, t, m, u)
        p = orthotropic_stress(g, m, rotation(m + g), passive.stiffness[i], passive.mu[i], passive.lam[i])
        if material.is_active != 0:
            # s (F d) d^T, and d is the first axis.
            pull = material.activation[t] * column(m + g, 0)
            p += wp.outer(pull, wp.vec3(1.0, 0.0, 0.0))
        return (filled(passive, t) * p) * wp.transpose(turn)

    return fibre_stress


@functools.cache
def fibre_differential(rotation: wp.Function) -> wp.Function:
    """The exact differential, with the element's own rotation and its turning; its active stress is held fixed."""

    @wp.func
    def fibre_differential(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
        passive = material.passive
        i = t * passive.stride
        m = axes_of(passive, t)
        g, turn = material_gradient(elements, t, m, u)
        df = dg * turn
        p = orthotropic_differential(g, m, rotation(m + g), df, passive.stiffness[i], passive.mu[i], passive.lam[i])
        if material.is_active != 0:
            p += wp.outer(material.activation[t] * column(df, 0), wp.vec3(1.0, 0.0, 0.0))
        return (filled(passive, t) * p) * wp.transpose(turn)

    return fibre_differential


@functools.cache
def fibre_density(rotation: wp.Function) -> wp.Function:
    """Energy density; active stress has none."""

    @wp.func
    def fibre_density(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        passive = material.passive
        i = t * passive.stride
        m = axes_of(passive, t)
        g, _turn = material_gradient(elements, t, m, u)
        c = passive.stiffness[i]
        return filled(passive, t) * orthotropic_energy(g, m, rotation(m + g), c, passive.mu[i], passive.lam[i])

    return fibre_density


@functools.cache
def fibre_cauchy(rotation: wp.Function) -> wp.Function:
    """Elastic and active stress together, in the frame that turns with the element."""

    @wp.func
    def fibre_cauchy(elements: Any, t: int, material: FibreMaterial, u: wp.array[wp.vec4]):
        passive = material.passive
        i = t * passive.stride
        m = axes_of(passive, t)
        g, _turn = material_gradient(elements, t, m, u)
        stress = orthotropic_cauchy(g, m, rotation(m + g), passive.stiffness[i], passive.mu[i], passive.lam[i])
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


# --- fibres that bear tension ----------------------------------------------------------------------------------------
#
# The law of Holzapfel, Gasser and Ogden: a neo-Hookean matrix with one or two families of fibres that bear tension.
#
# In the material's axes a family has the direction a = (cos angle, +-sin angle, 0), a dispersion kappa and the strain
#     e = kappa (tr C - 3) + (1 - 3 kappa) (a . C a - 1) = 2 B : E,  B = kappa I + (1 - 3 kappa) a a^T,
# with C = F^T F and Green's strain E. Its energy density is phi(e) = k1 / (2 k2) (exp(k2 e^2) - 1) where e > 0, and
# zero elsewhere: P = F S with S = 2 phi'(e) B. Beyond e = sqrt(ln(100) / k2), where phi'' is a thousand times k1, phi
# is its own Taylor polynomial of second order, so that the stiffness stays bounded. The law is in
# ``native/law_fibres.h``.


@wp.struct
class ReinforcedMaterial:
    """Lamé's parameters of the matrix, the fibres, and their active stress [Pa].

    The nine numbers of ``fibres.stiffness`` are k1 [Pa], k2, kappa and the angle [rad] of each element; others are not
    read. An angle of zero means one family.
    """

    matrix: IsotropicMaterial
    fibres: OrthotropicMaterial
    is_active: int
    activation: wp.array[wp.float32]


#: Matrix, fibres and active stress together.
REINFORCED = element_law(FIBRES.code, ReinforcedMaterial)
_IN_TISSUE = element_law("corot::fibres<false>(material)", ReinforcedMaterial)
_stress_in_tissue = _IN_TISSUE.stress


@wp.func
def reinforced_cauchy(elements: Any, t: int, material: ReinforcedMaterial, u: wp.array[wp.vec4]):
    """Elastic and active stress together, in the tissue itself, also where an element is only partly filled."""
    f = frame(elements, t) + local_gradient(elements, t, u)
    return push_forward(f, _stress_in_tissue(elements, t, material, u))
