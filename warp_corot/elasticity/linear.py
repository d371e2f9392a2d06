"""Linear elasticity: small strain of the whole displacement. Right for small rotations, swells in large ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from warp_corot.elasticity.model import Law
from warp_corot.kernels.elements.constitutive import linear_differential, linear_energy, linear_stress
from warp_corot.kernels.elements.dilatation import SMALL

from .law_model import LawModel
from .model import ForceField

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class Linear(LawModel):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(F) - I. Conserves linear but not angular momentum.

    Attributes:
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element, and the material is isotropic.
    """

    strained_safety: ClassVar[float] = 0.9  # its stiffness never changes
    law = Law(linear_stress, linear_differential, linear_energy, "linear", linear_stress)
    shared = SMALL

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        field = super().bind(body, deterministic=deterministic)
        field.is_linear = True
        return field
