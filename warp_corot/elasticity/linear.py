"""Linear elasticity: small strain of the whole displacement. Right for small rotations, swells in large ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from warp_corot.discretization.discretization import discretization_of
from warp_corot.elasticity.paths.laws import law_field
from warp_corot.kernels.elements.constitutive import (
    linear_cauchy,
    linear_differential,
    linear_energy,
    linear_stress,
)

from .model import ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class Linear(Model):
    """W = V (mu e:e + lambda/2 tr(e)^2) with e = sym(F) - I. Conserves linear but not angular momentum."""

    strained_safety: ClassVar[float] = 0.9  # its stiffness never changes

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return law_field(
            "linear",
            discretization,
            stress=linear_stress,
            differential=linear_differential,
            energy=linear_energy,
            cauchy=linear_cauchy,
            deterministic=deterministic,
        )
