"""The common part of models of one constitutive law: the option ``dilatation`` and the choice of kernels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

from warp_corot.elasticity.backends.laws import law_field
from warp_corot.kernels.elements.dilatation import Dilatation

from .dilatation import AUTO, bind_law, check_dilatation
from .model import ForceField, Law, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization, Discretized


@dataclass(frozen=True)
class LawModel(Model):
    """A constitutive law of the package, whose elements can share their dilatation.

    Class attributes:
        law: The law.
        shared: The dilatation that elements of this law share.
    """

    law: ClassVar[Law]
    shared: ClassVar[Dilatation]

    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        return bind_law(self._field, self.shared, self.dilatation, body, deterministic)

    def _field(self, discretization: Discretization, deterministic: bool) -> ForceField:
        return law_field(self.law, discretization, deterministic)
