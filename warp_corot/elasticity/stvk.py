"""St. Venant-Kirchhoff: Hooke's law between Green strain and second Piola-Kirchhoff stress."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from warp_corot.discretization.discretization import discretization_of
from warp_corot.elasticity.paths.laws import law_field
from warp_corot.kernels.elements.constitutive import (
    stvk_cauchy,
    stvk_differential,
    stvk_energy,
    stvk_stress,
)

from .model import ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class StVenantKirchhoff(Model):
    """W = V (mu E:E + lambda/2 tr(E)^2) with E = (F^T F - I)/2, in total-Lagrangian form.

    Stepped by explicit central differences (symplectic Euler is their leapfrog form) this is what the literature calls
    TLED (Miller et al. 2007). Softens when compressed and lets elements invert at large strain; the paper's reference.
    """

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return law_field(
            "stvk",
            discretization,
            stress=stvk_stress,
            differential=stvk_differential,
            energy=stvk_energy,
            cauchy=stvk_cauchy,
            deterministic=deterministic,
        )
