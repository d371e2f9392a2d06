"""St. Venant-Kirchhoff elasticity as springs on the edges of each tetrahedron."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from warp_corot.inputs.checks import checked_choice
from warp_corot.kernels.elements.constitutive import stvk_stress
from warp_corot.kernels.elements.forces import law_cauchy
from warp_corot.kernels.elements.springs import spring_density, spring_differential, spring_stress

from .dilatation import ELEMENT, refuse_shared
from .model import ElementField, ForceField, Model
from .stress_law import StressLaw
from .stvk import StVenantKirchhoff

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


class SpringField(ElementField):
    """Force field of quadratic springs, whose stress depends on where an element has its edges."""

    @property
    def stress_law(self) -> StressLaw:
        return replace(super().stress_law, sees_shape=True)


@dataclass(frozen=True)
class EdgeStVK(Model):
    """W = D^T K D / 2 over an element's six edges (Delingette 2008; Kikuuwe, Tabuchi and Yamamoto 2009).

    Attributes:
        springs: "biquadratic": D = l^2 - L^2, which is ``StVenantKirchhoff``, whose forces it has; "quadratic": D = 2 L
            (l - L), its small-strain form.
        dilatation: "element", the only value for springs.
    """

    springs: str = "biquadratic"
    dilatation: str = ELEMENT

    def __post_init__(self) -> None:
        checked_choice(self.springs, "springs", ("biquadratic", "quadratic"))
        refuse_shared(self.dilatation, "EdgeStVK")

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        if self.springs == "biquadratic":
            return StVenantKirchhoff(ELEMENT).bind(body, deterministic=deterministic)
        return SpringField(
            body,
            stress=spring_stress,
            differential=spring_differential,
            density=spring_density,
            cauchy=law_cauchy(stvk_stress),
            deterministic=deterministic,
        )
