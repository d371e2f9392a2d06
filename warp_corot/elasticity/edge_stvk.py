"""St. Venant-Kirchhoff elasticity as springs on the edges of each tetrahedron."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from ..errors import InputError
from ..kernels.constitutive import stvk_cauchy
from ..kernels.forces import element_von_mises
from ..kernels.springs import edge_stvk_energies, scatter_edge_stvk
from .model import ForceField, Model

if TYPE_CHECKING:
    from ..body import SoftBody


@dataclass(frozen=True)
class EdgeStVK(Model):
    """W = D^T K D / 2 over an element's six edges (Delingette 2008; Kikuuwe, Tabuchi and Yamamoto 2009).

    Attributes:
        springs: "biquadratic": D = l^2 - L^2, equal to ``StVenantKirchhoff``; "quadratic": D = 2 L (l - L), its
            small-strain form.
    """

    springs: str = "biquadratic"

    def __post_init__(self) -> None:
        if self.springs not in ("biquadratic", "quadratic"):
            raise InputError(f"springs is {self.springs!r}; it must be 'biquadratic' or 'quadratic'")

    def bind(self, body: SoftBody) -> ForceField:
        return EdgeStVKField(body, biquadratic=self.springs == "biquadratic")


class EdgeStVKField(ForceField):
    def __init__(self, body: SoftBody, *, biquadratic: bool):
        super().__init__(body)
        self._forces = scatter_edge_stvk(body.element_kind, biquadratic)
        self._energies = edge_stvk_energies(body.element_kind, biquadratic)
        self._von_mises = element_von_mises(body.element_kind, stvk_cauchy)

    def add_forces(self, u: wp.array, f: wp.array) -> None:
        self.launch(self._forces, self.element_count, [self.elements, *self.material_inputs, u], [f])

    def write_energies(self, u: wp.array, energies: wp.array) -> None:
        self.launch(self._energies, self.element_count, [self.elements, *self.material_inputs, u], [energies])

    def write_von_mises(self, u: wp.array, stress: wp.array) -> None:
        self.launch(self._von_mises, self.element_count, [self.elements, *self.material_inputs, u], [stress])
