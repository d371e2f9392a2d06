"""The device functions of a field's law, for derivatives."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeAlias

import warp as wp

from warp_corot.kernels.corotated.anisotropic import FibreMaterial
from warp_corot.kernels.corotated.tangent import KeptStrains
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.fibres import ReinforcedMaterial
from warp_corot.kernels.elements.mean_dilatation import DilatedMaterial
from warp_corot.kernels.elements.prestress import Prestress
from warp_corot.kernels.elements.prony import PronyMaterial

#: Structs of materials.
ElementMaterial: TypeAlias = (
    "IsotropicMaterial | RotatedMaterial | KeptStrains | FibreMaterial | ReinforcedMaterial | PronyMaterial "
    "| Prestress | DilatedMaterial"
)


@dataclass(frozen=True)
class StressLaw:
    """First Piola-Kirchhoff stress of a law in each element.

    Attributes:
        stress: Device function (elements, t, material, u) -> P, see ``kernels.elements.forces``.
        differential: Its exact derivative (elements, t, material, u, dg) -> dP, as
            ``kernels.elements.stiffness_products`` takes it.
        material: The struct that both read.
        Material: Its type; for ``IsotropicMaterial`` the stress is linear in Lamé's parameters.
        sees_shape: Whether the stress depends on an element's rest shape besides its deformation gradient.
    """

    stress: wp.Function
    differential: wp.Function
    material: ElementMaterial
    Material: type = IsotropicMaterial
    sees_shape: bool = False
