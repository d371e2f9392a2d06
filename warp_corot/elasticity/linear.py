"""Linear elasticity: small strain of the whole displacement. Right for small rotations, swells in large ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from warp_corot.elasticity.paths.laws import law_field
from warp_corot.kernels.elements.constitutive import (
    linear_cauchy,
    linear_differential,
    linear_energy,
    linear_stress,
)
from warp_corot.kernels.elements.dilatation import SMALL

from .dilatation import AUTO, bind_law, check_dilatation
from .model import ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class Linear(Model):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(F) - I. Conserves linear but not angular momentum.

    Attributes:
        dilatation: "element": each element has its own, and nearly incompressible tissue is too stiff. "shared":
            elements share it, see ``elasticity.dilatation``; slower. "auto": they do where Poisson's ratio is 0.45 or
            more in any element, and the material is isotropic.
    """

    strained_safety: ClassVar[float] = 0.9  # its stiffness never changes

    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        field = bind_law(_bind, SMALL, self.dilatation, body, deterministic)
        field.is_linear = True
        return field


def _bind(discretization: Discretization, deterministic: bool) -> ForceField:
    return law_field(
        "linear",
        discretization,
        stress=linear_stress,
        differential=linear_differential,
        energy=linear_energy,
        cauchy=linear_cauchy,
        deterministic=deterministic,
    )
