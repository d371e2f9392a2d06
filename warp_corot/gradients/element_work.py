"""Sums over adjoint motions of the work of elements' forces, and derivatives of these sums."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.elasticity.dilatation import DilatationField
from warp_corot.elasticity.model import StressLaw, isotropic_material
from warp_corot.errors import InputError
from warp_corot.kernels.corotated.anisotropic import FibreMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.gradients import elements as kernels

if TYPE_CHECKING:
    from warp_corot.discretization.elements import Elements


class ElementWork:
    """Derivatives of a . f(u), summed over pairs of displacements u and adjoint motions a; see
    ``kernels.gradients.elements``.

    Args:
        field: The forces f.
        names: The sums of ``add``: "lame", "rest" and "activation".

    Raises:
        InputError: The forces have no such derivative.
    """

    def __init__(self, field: ForceField, names: set[str]):
        self.field, self.names, self.device = field, names, field.device
        self._shared = field if isinstance(field, DilatationField) else None
        law = (self._shared.shear if self._shared else field).stress_law
        missing = names if law is None else {"rest"} & names if law.sees_shape else set()
        if missing:
            said = _listed(missing)
            raise InputError(f"the model's forces have no derivative with respect to {said}; leave it out of wrt")
        if "lame" in names and law is not None and law.Material is not IsotropicMaterial:
            raise InputError("the material is anisotropic; derivatives with respect to its moduli do not exist yet")
        if "activation" in names and law is not None and law.Material is not FibreMaterial:
            raise InputError("wrt has 'activation', but only anisotropic materials with Corotated have this derivative")
        count, nodes = field.element_count, field.discretization.sizes.launch_nodes
        self._of_mu, self._of_lam, self._of_activation = (
            wp.zeros(count if name in names else 0, dtype=wp.float64, device=self.device)
            for name in ("lame", "lame", "activation")
        )
        self._of_rest = wp.zeros(nodes if "rest" in names else 0, dtype=wp.vec4, device=self.device)
        self._unit_mu, self._unit_lam = (self._lame(*pair) for pair in ((1.0, 0.0), (0.0, 1.0)))

    def add(self, u: wp.array, adjoint: wp.array, scale: float = 1.0) -> None:
        """Launch the sums of one pair; both vec4 [worlds * N]. ``scale`` multiplies all sums except "rest"."""
        if "lame" in self.names:
            self._add_lame(u, adjoint, scale)
        if "activation" in self.names:
            kernel = kernels.add_fibre_work(self._kind)
            self._launch(kernel, [self._law.material, u, adjoint, scale], self._of_activation)
        if "rest" in self.names:
            self._add_rest(u, adjoint)

    def clear(self) -> None:
        """Begin the sums again."""
        for array in (self._of_mu, self._of_lam, self._of_activation, self._of_rest):
            array.zero_()

    def of_lame(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """The derivatives with respect to mu and lambda of forces, float64 [worlds * T]."""
        return self._of_mu.numpy(), self._of_lam.numpy()

    def of_activation(self) -> npt.NDArray[np.float64]:
        """The derivative with respect to active stress, float64 [worlds * T]."""
        return np.asarray(self._of_activation.numpy())

    def of_rest(self) -> npt.NDArray[np.float64]:
        """The derivative with respect to rest positions, float64 [worlds * N, 3]."""
        return np.asarray(self._of_rest.numpy()[: self.field.discretization.sizes.nodes, :3], np.float64)

    def of_weights(self, densities: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """The derivative with respect to rest positions of the work of weights, float64 [worlds * N, 3].

        Args:
            densities: Density of that work in elements [J/m^3], [worlds * T].
        """
        discretization = self.field.discretization
        rest = wp.zeros(discretization.sizes.launch_nodes, dtype=wp.vec4, device=self.device)
        on_device = wp.array(densities, dtype=wp.float32, device=self.device)
        self._launch(kernels.add_rest_weight(self._kind), [on_device], rest)
        return np.asarray(rest.numpy()[: discretization.sizes.nodes, :3], np.float64)

    def _add_lame(self, u: wp.array, adjoint: wp.array, scale: float) -> None:
        kernel = kernels.add_stress_work(self._kind, IsotropicMaterial, self._law.stress)
        self._launch(kernel, [self._unit_mu, u, adjoint, scale], self._of_mu)
        if self._shared is None:
            self._launch(kernel, [self._unit_lam, u, adjoint, scale], self._of_lam)
        else:
            shared = self._shared.share_weights(u, adjoint)
            kernel = kernels.add_dilatation_work(self._kind, self._shared.of)
            self._launch(kernel, [shared, u, adjoint, scale], self._of_lam)

    def _add_rest(self, u: wp.array, adjoint: wp.array) -> None:
        law = self._law
        kernel = kernels.add_rest_work(self._kind, law.Material, law.stress, law.differential)
        self._launch(kernel, [law.material, u, adjoint], self._of_rest)
        if self._shared is not None:
            shared = self._shared.share_weights(u, adjoint)
            kernel = kernels.add_dilatation_rest_work(self._kind, self._shared.of)
            self._launch(kernel, [self._shared.isotropic, shared, u, adjoint], self._of_rest)

    @property
    def _law(self) -> StressLaw:
        law = (self._shared.shear if self._shared else self.field).stress_law
        assert law is not None
        return law

    @property
    def _kind(self) -> type:
        return self.field.discretization.element_kind

    def _lame(self, mu: float, lam: float) -> IsotropicMaterial:
        return isotropic_material([*(wp.full(1, v, dtype=wp.float32, device=self.device) for v in (mu, lam)), 0])

    def _launch(self, kernel: wp.Kernel, inputs: list, output: wp.array) -> None:
        elements: Elements = self.field.discretization.elements
        wp.launch(kernel, self.field.element_count, [elements, *inputs], [output], device=self.device)


def _listed(names: set[str]) -> str:
    words = {"lame": "moduli", "rest": "the rest shape", "activation": "active stress"}
    return " and ".join(words[name] for name in sorted(names))
