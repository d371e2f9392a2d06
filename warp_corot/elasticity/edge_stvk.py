"""St. Venant-Kirchhoff elasticity as springs on the edges of each tetrahedron."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_corot.discretization.discretization import discretization_of
from warp_corot.inputs.checks import checked_choice
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, stvk_cauchy, stvk_stress
from warp_corot.kernels.elements.forces import element_von_mises, law_stress, law_value
from warp_corot.kernels.elements.spring_stiffness import edge_stvk_differential
from warp_corot.kernels.elements.springs import edge_stvk_energies, scatter_edge_stvk

from .dilatation import ELEMENT, refuse_shared
from .model import ElementField, ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class EdgeStVK(Model):
    """W = D^T K D / 2 over an element's six edges (Delingette 2008; Kikuuwe, Tabuchi and Yamamoto 2009).

    Attributes:
        springs: "biquadratic": D = l^2 - L^2, equal to ``StVenantKirchhoff``; "quadratic": D = 2 L (l - L), its
            small-strain form.
        dilatation: "element", the only value for springs.
    """

    springs: str = "biquadratic"
    dilatation: str = ELEMENT

    def __post_init__(self) -> None:
        checked_choice(self.springs, "springs", ("biquadratic", "quadratic"))
        refuse_shared(self.dilatation, "EdgeStVK")

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        kind, biquadratic = discretization.element_kind, self.springs == "biquadratic"
        return ElementField(
            discretization,
            forces=scatter_edge_stvk(kind, biquadratic),
            energies=edge_stvk_energies(kind, biquadratic),
            von_mises=element_von_mises(kind, IsotropicMaterial, law_value(stvk_cauchy)),
            differential=edge_stvk_differential(biquadratic),
            stress=law_stress(stvk_stress) if biquadratic else None,
            deterministic=deterministic,
        )
