"""St. Venant-Kirchhoff: Hooke's law between Green strain and second Piola-Kirchhoff stress."""

from __future__ import annotations

from dataclasses import dataclass

from warp_corot.elasticity.model import Law
from warp_corot.kernels.elements.constitutive import stvk_differential, stvk_energy, stvk_stress
from warp_corot.kernels.elements.dilatation import GREEN

from .law_model import LawModel


@dataclass(frozen=True)
class StVenantKirchhoff(LawModel):
    """W = V (mu E:E + lambda/2 tr(E)^2) with E = (F^T F - I)/2, in total-Lagrangian form.

    Stepped by explicit central differences (symplectic Euler is their leapfrog form) this is what the literature calls
    TLED (Miller et al. 2007). Softens when compressed and lets elements invert at large strain; the paper's reference.

    Attributes:
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element, and the material is isotropic.
    """

    law = Law(stvk_stress, stvk_differential, stvk_energy, "stvk")
    shared = GREEN
