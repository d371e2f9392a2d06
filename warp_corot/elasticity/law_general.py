"""General tetrahedra on CUDA, one thread an element; see ``kernels.general_cuda``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.general_cpu import rest_matrices
from ..kernels.general_cuda import BLOCK, PosedElements, corotated_law, scatter_general
from .corotated_field import LeafField
from .lanes import as_general
from .model import LawField

if TYPE_CHECKING:
    from ..body import SoftBody
    from .corotated import Corotated


class LawGeneralField(LawField):
    """A law on single elements whose forces need no settled order.

    Args:
        body: A general mesh's, or of a forest that has few groups of subtrees.
        stress, energy, cauchy: The law, functions of ``kernels.constitutive``.
        deterministic: False; slots of elements are not shared, so there is nothing to add up.
    """

    def __init__(
        self,
        body: SoftBody,
        *,
        stress: wp.Function,
        energy: wp.Function,
        cauchy: wp.Function,
        deterministic: bool = False,
    ):
        super().__init__(body, stress=stress, energy=energy, cauchy=cauchy, deterministic=deterministic)
        self._scatter = GeneralScatter(self.elements, stress)

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._scatter(self.material_inputs, u, f)


class CorotatedGeneralField(LeafField):
    """The corotated law with own rotations on general elements whose forces need no settled order."""

    def __init__(self, body: SoftBody, model: Corotated):
        super().__init__(body, model, deterministic=False)
        self._scatter = GeneralScatter(self.elements, corotated_law(model.own_rotation))

    def scatter_forces(self, u: wp.array, f: wp.array) -> None:
        self._scatter(self.material_inputs, u, f)


class GeneralScatter:
    """The launch that adds the forces of general elements under a law.

    Args:
        elements: ``kernels.elements.GeneralElements``.
        stress: The law, a function of ``kernels.constitutive``.
    """

    def __init__(self, elements: Any, stress: wp.Function):
        self._elements = posed_elements(elements)
        self._kernel = scatter_general(stress)

    def __call__(self, material: list, u: wp.array, f: wp.array) -> None:
        """Add the forces [N] of displacements u to f, both vec4 [N]; ``material``: mu, lam and their stride."""
        nodes = self._elements.nodes
        inputs = [self._elements, *material, u]
        wp.launch(self._kernel, len(nodes), inputs=inputs, outputs=[f], device=nodes.device, block_dim=BLOCK)


def posed_elements(elements: Any) -> Any:
    """Elements of either kind as ``kernels.general_cuda`` takes them."""
    general = elements if hasattr(elements, "rest_inverse") else as_general(elements, rest_matrices, [elements])
    posed = PosedElements()
    posed.nodes, posed.volume = general.nodes, general.volume
    rows = np.ascontiguousarray(general.rest_inverse.numpy().reshape(-1, 9).T)
    posed.rest_inverse = wp.array(rows, dtype=wp.float32, device=elements.nodes.device)
    return posed
