"""Launches of products with the tangent stiffness, element by element; see ``kernels.elements.stiffness_products``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.kernels.corotated.anisotropic import FibreMaterial
from warp_corot.kernels.corotated.tangent import KeptStrains
from warp_corot.kernels.elements.constitutive import IsotropicMaterial, RotatedMaterial
from warp_corot.kernels.elements.fibres import ReinforcedMaterial
from warp_corot.kernels.elements.prestress import Prestress
from warp_corot.kernels.elements.prony import PronyMaterial
from warp_corot.kernels.elements.stiffness_products import add_stiffness_diagonal, add_stiffness_product

if TYPE_CHECKING:
    from warp_corot.discretization.discretization import Discretization


#: Structs of materials.
ElementMaterial: TypeAlias = (
    "IsotropicMaterial | RotatedMaterial | KeptStrains | FibreMaterial | ReinforcedMaterial | PronyMaterial | Prestress"
)


@dataclass(frozen=True)
class ElementStiffness:
    """The tangent stiffness of a discretization's elements, one thread for each element on every path of forces.

    Attributes:
        discretization: Gives the kind and the number of elements.
        differential: Device function (elements, t, material, u, dg) -> dP.
        Material: The struct that it reads.
    """

    discretization: Discretization
    differential: wp.Function
    Material: type = IsotropicMaterial

    def add_product(self, elements: Elements, material: ElementMaterial, u: wp.array, p: wp.array, y: wp.array) -> None:
        """y += K(u) p."""
        kernel = add_stiffness_product(self.discretization.element_kind, self.Material, self.differential)
        self._launch(kernel, 1, [elements, material, u, p], y)

    def add_diagonal(self, elements: Elements, material: ElementMaterial, u: wp.array, blocks: wp.array) -> None:
        """Add the diagonal blocks of K(u), a mat33 for each node."""
        kernel = add_stiffness_diagonal(self.discretization.element_kind, self.Material, self.differential)
        self._launch(kernel, 4, [elements, material, u], blocks)

    def _launch(self, kernel: wp.Kernel, threads: int, inputs: list, output: wp.array) -> None:
        count = threads * self.discretization.sizes.launch_elements
        wp.launch(kernel, dim=count, inputs=inputs, outputs=[output], device=self.discretization.device)
