"""Bodies with stress in their undeformed shape."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, discretization_of
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_numbers, shown
from warp_corot.kernels.elements import prestress as kernels
from warp_corot.kernels.elements.native_laws import PRESTRESS

from .added_stress import AddedStressField
from .corotated.model import Corotated
from .model import ForceField, Model

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretized


@dataclass(frozen=True)
class Prestressed(Model):
    """A law with an initial stress: W = V (W_law + S : E) with Green's strain E, P = P_law + F S.

    S is a second Piola-Kirchhoff stress, which is the Cauchy stress of the body in its rest shape, positive in tension.
    It rotates with the body and does not change otherwise. If S is not in equilibrium, the body moves from rest: a free
    bar contracts by S / E. The stress that is shown is that of ``model``.

    Attributes:
        stress: S [Pa], symmetric: [3, 3] or [T, 3, 3], one for each element, the same in all worlds.
        model: The elastic law, or ``Prony``.

    Raises:
        InputError: No such numbers, or a tensor that is not symmetric.
    """

    stress: Any
    model: Model = field(default_factory=Corotated)

    def __post_init__(self) -> None:
        given = checked_numbers(self.stress, "stress", "[3, 3] or [T, 3, 3] [Pa]")
        if given.ndim not in (2, 3) or given.shape[-2:] != (3, 3) or not np.isfinite(given).all():
            raise InputError(f"stress has shape {given.shape}; it must be finite numbers [3, 3] or [T, 3, 3] [Pa]")
        largest = np.abs(given).max(initial=0.0)
        if np.abs(given - np.swapaxes(given, -1, -2)).max(initial=0.0) > 1e-6 * largest:
            raise InputError("stress is not symmetric; each tensor must be equal to its transpose")
        if not isinstance(self.model, Model) or isinstance(self.model, Prestressed):
            raise InputError(f"model is {shown(self.model)}; it must be an elastic model such as Corotated()")
        # Plain values can be compared and saved.
        object.__setattr__(self, "stress", _tuples(given.tolist()))

    @property
    def dilatation(self) -> str:
        """That of the elastic law."""
        return getattr(self.model, "dilatation", "element")

    @property
    def kept_of_elements(self) -> str | None:
        return "Prestressed keeps the stress of each element"

    def bind(self, body: Discretized | Discretization, *, deterministic: bool = False) -> ForceField:
        discretization = discretization_of(body)
        return PrestressedField(discretization, self, self.model.bind(discretization, deterministic=deterministic))


class PrestressedField(AddedStressField):
    """The forces of an elastic law and of an initial stress.

    Args:
        discretization: The mesh and the material.
        model: The initial stress.
        law: The elastic law's field.
    """

    def __init__(self, discretization: Discretization, model: Prestressed, law: ForceField):
        functions = (kernels.prestress_stress, kernels.prestress_differential, kernels.prestress_density)
        super().__init__(discretization, law, kernels.Prestress, *functions, lanes=PRESTRESS)
        stress, count = np.array(model.stress), len(discretization.mesh.tets)
        if stress.ndim == 3 and len(stress) != count:
            raise InputError(f"stress has {len(stress)} tensors; the mesh has {count} elements")
        if discretization.fill is not None:
            stress = discretization.fill[:, None, None] * stress
        self._material = kernels.Prestress()
        self._material.stride = int(stress.ndim == 3)
        every = np.tile(stress, (discretization.worlds, 1, 1)) if stress.ndim == 3 else stress[None]
        self._material.stress = wp.array(every.astype(np.float32), dtype=wp.mat33, device=self.device)

    @property
    def material(self) -> kernels.Prestress:
        return self._material


def _tuples(values: Sequence[Any]) -> tuple[Any, ...]:
    return tuple(_tuples(value) if isinstance(value, list) else value for value in values)
