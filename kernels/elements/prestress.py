"""Stress that a body has at rest: a constant second Piola-Kirchhoff stress S of each element.

P = F S is the derivative of the energy density S : E with Green's strain E; it turns with the body.
"""

from typing import Any

import warp as wp

from .constitutive import green_strain
from .elements import frame
from .prony import rest_gradient

wp.set_module_options({"enable_backward": False})


@wp.struct
class Prestress:
    """S in the axes of rest space, one entry (stride 0) or one per element (stride 1)."""

    stress: wp.array[wp.mat33]
    stride: int


@wp.func
def prestress_stress(elements: Any, t: int, material: Prestress, u: wp.array[wp.vec4]):
    s = material.stress[t * material.stride]
    return (s + rest_gradient(elements, t, u) * s) * frame(elements, t)


@wp.func
def prestress_differential(elements: Any, t: int, material: Prestress, u: wp.array[wp.vec4], dg: wp.mat33):
    q = frame(elements, t)
    return dg * wp.transpose(q) * material.stress[t * material.stride] * q


@wp.func
def prestress_density(elements: Any, t: int, material: Prestress, u: wp.array[wp.vec4]):
    return wp.ddot(material.stress[t * material.stride], green_strain(rest_gradient(elements, t, u)))
