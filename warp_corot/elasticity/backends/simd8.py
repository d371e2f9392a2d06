"""Elements on the CPU, eight at a time in the lanes of its vector registers; see ``kernels.elements.simd8``."""

from __future__ import annotations

import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.inputs.cpu_threads import launch, part_of
from warp_corot.kernels.corotated.anisotropic import FibreMaterial
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.simd8 import LANES


class Lanes:
    """Launches that add the forces of elements: first eight at a time, then those left out one by one.

    Args:
        elements: The elements, of either kind.
        general: The same elements as general ones.
        scatter: Kernel that computes the general ones eight at a time and lists those that it leaves out.
        repair: Kernel that computes the listed ones among ``elements``; None if none are left out or listed.
    """

    def __init__(self, elements: Elements, general: Elements, *, scatter: wp.Kernel, repair: wp.Kernel | None = None):
        self.count = len(elements.nodes)
        self.elements = elements
        self._general = general
        self._scatter = scatter
        self._repair = repair
        #: Which of the material's values are those of the elements; None: all.
        self._bounds: tuple[int, int] | None = None
        #: How many, then which.
        self._degenerate = wp.zeros(self.count + 1 if repair else 0, dtype=wp.int32, device="cpu")

    def scatter_forces(self, material: IsotropicMaterial | FibreMaterial, u: wp.array, f: wp.array) -> None:
        """Add the forces of displacements u to f, both vec4 [N]; ``material`` is the struct of all elements that
        kernels read."""
        if self._bounds is not None:
            material = part_of(material, *self._bounds)
        inputs = [self._general, self.count, material, u]
        launch(self._scatter, -(-self.count // LANES), inputs, [f, self._degenerate], device="cpu")
        if self._repair is not None:
            launch(self._repair, 1, [self.elements, material, u], [self._degenerate, f], device="cpu")

    def part(self, begin: int, end: int) -> Lanes:
        """The launches of some of the elements."""
        elements, general = (part_of(each, begin, end) for each in (self.elements, self._general))
        part = Lanes(elements, general, scatter=self._scatter, repair=self._repair)
        part._bounds = begin, end
        return part


def as_general(elements: Elements, kernel: wp.Kernel, inputs: list) -> GeneralElements:
    """Elements of either kind as general ones; ``kernel`` finds their rest matrices and volumes from ``inputs``."""
    count, device, general = len(elements.nodes), elements.nodes.device, GeneralElements()
    general.nodes = general.targets = elements.nodes
    general.rest_inverse = wp.empty(count, dtype=wp.mat33, device=device)
    general.volume = wp.empty(count, dtype=wp.float32, device=device)
    wp.launch(kernel, count, inputs, [general.rest_inverse, general.volume], device=device)
    return general
