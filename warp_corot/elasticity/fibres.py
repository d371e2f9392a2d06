"""The law of Holzapfel, Gasser and Ogden, for tissue with families of fibres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.discretization.plan import Plan
from warp_corot.elasticity.structs import Kept
from warp_corot.errors import InputError
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import reinforced_law
from warp_corot.kernels.corotated.anisotropic import OrthotropicMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import LOG_VOLUME
from warp_corot.kernels.elements.fibres import (
    ReinforcedMaterial,
    reinforced_cauchy,
    reinforced_density,
    reinforced_differential,
    reinforced_stress,
)
from warp_corot.kernels.elements.native_laws import FIBRES
from warp_corot.materials.reinforced import FibreReinforced

from .backends.clusters import divided
from .backends.elements import ByElements
from .corotated.anisotropic import FibreField
from .dilatation import AUTO, bind_law, check_dilatation
from .model import ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized


@dataclass(frozen=True)
class HolzapfelGasserOgden(Model):
    """W = V (W_neo-Hookean + sum over families of k1 / (2 k2) (exp(k2 e^2) - 1)) for tissue with fibres.

    The body's material must be ``FibreReinforced``: it has Young's modulus and Poisson's ratio of the matrix, and k1,
    k2, the dispersion kappa and the directions a of the fibres. e = kappa (tr C - 3) + (1 - 3 kappa) (a . C a - 1), C =
    F^T F; families with e < 0 carry no stress (Gasser, Ogden and Holzapfel 2006; with the whole C, so that fibres
    respond to changes of volume, as Nolan et al. 2014 recommend). The matrix is ``NeoHookean``, which bounds the
    stiffness of crushed and inverted elements; the stiffness of fibres is bounded at a thousand times k1 by a parabola
    beyond e = sqrt(4.6 / k2).

    Attributes:
        dilatation: Dilatation of the matrix: "element", "shared" or "auto", as for ``NeoHookean``.
    """

    dilatation: str = AUTO

    def __post_init__(self) -> None:
        check_dilatation(self.dilatation)

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        if not isinstance(discretization.material, FibreReinforced):
            name = type(discretization.material).__name__
            raise InputError(f"the material is {name}; for HolzapfelGasserOgden it must be FibreReinforced")
        return bind_law(ReinforcedField, LOG_VOLUME, self.dilatation, discretization, deterministic)


class ReinforcedField(FibreField):
    """The forces of ``HolzapfelGasserOgden``; on the CPU of eight subtrees or elements at a time."""

    def __init__(self, discretization: Discretization, deterministic: bool):
        super().__init__(
            discretization,
            stress=reinforced_stress,
            differential=reinforced_differential,
            density=reinforced_density,
            cauchy=reinforced_cauchy,
            Material=ReinforcedMaterial,
            deterministic=deterministic,
        )
        _, self._clusters = divided(discretization, self.plan, reinforced_law, ReinforcedMaterial)
        self._by_elements = ByElements(discretization, self.plan, ReinforcedMaterial, reinforced_stress, FIBRES)
        self._made = Kept(_material)

    def plan_of(self, discretization: Discretization) -> Plan:
        return discretization.plan(subtrees=self.device.is_cpu, deterministic=self.deterministic)

    @property
    def _force_kernels(self) -> list[LoadedKernel]:
        return self._by_elements.kernels if self._clusters is None else [self._clusters.kernel]

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        if self._clusters is not None:
            self._clusters(self.material, u, f)
        else:
            self._by_elements(self.element_count, self.material, u, f)

    @property
    def material(self) -> ReinforcedMaterial:
        """The material with the present active stress."""
        return self._made(self.isotropic, self.passive, *self._activation)

    @property
    def material_shown(self) -> ReinforcedMaterial:
        return _material(self.isotropic_shown, self.passive, *self._activation)


def _material(
    matrix: IsotropicMaterial, fibres: OrthotropicMaterial, is_active: int, activation: wp.array
) -> ReinforcedMaterial:
    material = ReinforcedMaterial()
    material.matrix, material.fibres = matrix, fibres
    material.is_active, material.activation = is_active, activation
    return material
