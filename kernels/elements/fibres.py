"""The law of Holzapfel, Gasser and Ogden: a neo-Hookean matrix with one or two families of fibres that bear tension.

In the material's axes a family has the direction a = (cos angle, +-sin angle, 0), a dispersion kappa and the strain
    e = kappa (tr C - 3) + (1 - 3 kappa) (a . C a - 1) = 2 B : E,  B = kappa I + (1 - 3 kappa) a a^T,
with C = F^T F and Green's strain E. Its energy density is phi(e) = k1 / (2 k2) (exp(k2 e^2) - 1) where e > 0, and zero
elsewhere: P = F S with S = 2 phi'(e) B. Beyond e = sqrt(ln(100) / k2), where phi'' is a thousand times k1, phi is its
own Taylor polynomial of second order, so that the stiffness stays bounded.
"""

from typing import Any

import warp as wp

from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial, axes_of, filled, material_gradient
from warp_corot.kernels.math.matrices import column, identity3

from .constitutive import (
    IsotropicMaterial,
    green_strain,
    neo_hookean_differential,
    neo_hookean_energy,
    neo_hookean_stress,
    push_forward,
    symmetric,
)
from .ogden import power_excess

wp.set_module_options({"enable_backward": False})

#: k2 e^2 beyond which the energy is a parabola: ln(100).
MOST = wp.constant(4.605170)
#: Below this k2, fibres stiffen too little for float32 to see it.
LEAST = wp.constant(1.0e-6)


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


@wp.func
def fibre_energy(e: float, k1: float, k2: float):
    """phi, phi' and phi'' of a fibre strain; padding has zeros for k1 and k2."""
    rate = wp.max(k2, LEAST)
    most = wp.sqrt(MOST / rate)
    inside = wp.clamp(e, 0.0, most)
    x = rate * inside * inside
    first, _second = power_excess(x)
    grown = first + 1.0
    slope = k1 * inside * grown
    curvature = wp.where(e > 0.0, k1 * (1.0 + 2.0 * x) * grown, 0.0)
    value = 0.5 * k1 * first / rate
    beyond = wp.max(e - inside, 0.0)
    return value + beyond * (slope + 0.5 * curvature * beyond), slope + curvature * beyond, curvature


@wp.func
def family(angle: float, sign: float, kappa: float):
    """B of a family."""
    a = wp.vec3(wp.cos(angle), sign * wp.sin(angle), 0.0)
    return kappa * identity3() + (1.0 - 3.0 * kappa) * wp.outer(a, a)


@wp.func
def second_family(angle: float):
    """Whether there is one."""
    return wp.where(angle > 0.0, 1.0, 0.0)


@wp.func
def fibre_stress(material: OrthotropicMaterial, t: int, strain: wp.mat33):
    """S of both families, of Green's strain."""
    c = material.stiffness[t * material.stride]
    b = family(c[3], 1.0, c[2])
    _value, slope, _curvature = fibre_energy(2.0 * wp.ddot(b, strain), c[0], c[1])
    s = 2.0 * slope * b
    if second_family(c[3]) > 0.0:
        b = family(c[3], -1.0, c[2])
        _value2, slope2, _curvature2 = fibre_energy(2.0 * wp.ddot(b, strain), c[0], c[1])
        s += 2.0 * slope2 * b
    return s


@wp.func
def fibre_differential(material: OrthotropicMaterial, t: int, strain: wp.mat33, d_strain: wp.mat33):
    """dS of both families."""
    c = material.stiffness[t * material.stride]
    b = family(c[3], 1.0, c[2])
    _value, _slope, curvature = fibre_energy(2.0 * wp.ddot(b, strain), c[0], c[1])
    s = 4.0 * curvature * wp.ddot(b, d_strain) * b
    if second_family(c[3]) > 0.0:
        b = family(c[3], -1.0, c[2])
        _value2, _slope2, curvature2 = fibre_energy(2.0 * wp.ddot(b, strain), c[0], c[1])
        s += 4.0 * curvature2 * wp.ddot(b, d_strain) * b
    return s


@wp.func
def fibre_density(material: OrthotropicMaterial, t: int, strain: wp.mat33):
    """The energy density of both families."""
    c = material.stiffness[t * material.stride]
    first, _slope, _curvature = fibre_energy(2.0 * wp.ddot(family(c[3], 1.0, c[2]), strain), c[0], c[1])
    second, _slope2, _curvature2 = fibre_energy(2.0 * wp.ddot(family(c[3], -1.0, c[2]), strain), c[0], c[1])
    return first + second_family(c[3]) * second


@wp.func
def active_stress(material: ReinforcedMaterial, t: int, f: wp.mat33):
    """s (F d) d^T of the active stress s along the first axis d."""
    s = float(0.0)
    if material.is_active != 0:
        s = material.activation[t]
    return wp.outer(s * column(f, 0), wp.vec3(1.0, 0.0, 0.0))


# --- the law, for the kernels of ``forces`` and ``forces`` ------------------------------------------------


@wp.func
def stress_in_axes(a: wp.mat33, material: ReinforcedMaterial, t: int):
    """P of the displacement gradient A of element t, both in the material's axes."""
    f = identity3() + a
    i = t * material.matrix.stride
    own = f * fibre_stress(material.fibres, t, green_strain(a)) + active_stress(material, t, f)
    return neo_hookean_stress(a, material.matrix.mu[i], material.matrix.lam[i]) + filled(material.fibres, t) * own


@wp.func
def reinforced_stress(elements: Any, t: int, material: ReinforcedMaterial, u: wp.array[wp.vec4]):
    m = axes_of(material.fibres, t)
    g, turn = material_gradient(elements, t, m, u)
    return m * stress_in_axes(wp.transpose(m) * g, material, t) * wp.transpose(turn)


@wp.func
def reinforced_differential(elements: Any, t: int, material: ReinforcedMaterial, u: wp.array[wp.vec4], dg: wp.mat33):
    m = axes_of(material.fibres, t)
    g, turn = material_gradient(elements, t, m, u)
    a = wp.transpose(m) * g
    da = wp.transpose(m) * dg * turn
    i = t * material.matrix.stride
    strain = green_strain(a)
    own = da * fibre_stress(material.fibres, t, strain) + active_stress(material, t, da)
    d_strain = symmetric(da + wp.transpose(a) * da)
    own += (identity3() + a) * fibre_differential(material.fibres, t, strain, d_strain)
    p = neo_hookean_differential(a, da, material.matrix.mu[i], material.matrix.lam[i])
    return m * (p + filled(material.fibres, t) * own) * wp.transpose(turn)


@wp.func
def reinforced_density(elements: Any, t: int, material: ReinforcedMaterial, u: wp.array[wp.vec4]):
    """Active stress has no energy density."""
    m = axes_of(material.fibres, t)
    g, _turn = material_gradient(elements, t, m, u)
    a = wp.transpose(m) * g
    i = t * material.matrix.stride
    own = fibre_density(material.fibres, t, green_strain(a))
    return neo_hookean_energy(a, material.matrix.mu[i], material.matrix.lam[i]) + filled(material.fibres, t) * own


@wp.func
def reinforced_cauchy(elements: Any, t: int, material: ReinforcedMaterial, u: wp.array[wp.vec4]):
    """Elastic and active stress together, in the tissue itself, also where an element is only partly filled."""
    m = axes_of(material.fibres, t)
    g, _turn = material_gradient(elements, t, m, u)
    a = wp.transpose(m) * g
    f = identity3() + a
    i = t * material.matrix.stride
    own = f * fibre_stress(material.fibres, t, green_strain(a)) + active_stress(material, t, f)
    return push_forward(a, neo_hookean_stress(a, material.matrix.mu[i], material.matrix.lam[i]) + own)
