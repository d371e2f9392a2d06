"""Compressible neo-Hookean material."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from ..kernels.constitutive import neo_hookean_cauchy, neo_hookean_energy, neo_hookean_stress
from .law_lanes import law_field
from .model import ForceField, Model

if TYPE_CHECKING:
    from ..body import SoftBody


@dataclass(frozen=True)
class NeoHookean(Model):
    """W = V (mu/2 (tr F^T F - 3) - mu ln J + lambda/2 (ln J)^2), P = mu (F - F^-T) + lambda ln J F^-T.

    Below J = 0.1 the logarithm is continued by its second-order Taylor expansion about 0.1, so that energy and force
    are defined and continuous for every F and push an inverted element back. Total-Lagrangian too: with explicit
    central differences, TLED (Miller et al. 2007).
    """

    def bind(self, body: SoftBody, *, deterministic: bool = False) -> ForceField:
        return law_field(body, "neo-hookean")(
            body,
            stress=neo_hookean_stress,
            energy=neo_hookean_energy,
            cauchy=neo_hookean_cauchy,
            deterministic=deterministic,
        )
