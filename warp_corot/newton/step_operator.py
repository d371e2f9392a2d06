"""The matrix of an implicit step of a Newton model, and its preconditioner; see ``kernels.newton.implicit``."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.implicit.tangent import apply_blocks, invert_blocks
from warp_corot.kernels.newton import implicit as kernels
from warp_corot.solvers.implicit.operator import LinearOperator

from .library import newton
from .links import LinkForces
from .tetrahedra import Tetrahedra
from .unknowns import Unknowns


class StepOperator:
    """M (1/dt^2 + damping/dt) + K + D/dt and the stiffness of links, for conjugate gradients.

    The preconditioner is the inverses of the 3x3 blocks on its diagonal.

    Args:
        model: The model.
        tetrahedra: Its elements.
        unknowns: The entries of vectors.
        links: Contacts and attachments.

    Attributes:
        free: Whether an entry is free, float32 [entries].
        inertia: The first term, mat33 [entries].
    """

    def __init__(self, model: newton.Model, tetrahedra: Tetrahedra, unknowns: Unknowns, links: LinkForces):
        self.device, self.worlds, self.node_count = model.device, unknowns.worlds, unknowns.count
        self._tetrahedra, self._links, self._count = tetrahedra, links, len(unknowns)
        self._elements = int(model.tet_count)
        self.free = wp.zeros(self._count, dtype=wp.float32, device=self.device)
        self.inertia, self._of_elements, self._inverses = (
            wp.zeros(self._count, dtype=wp.mat33, device=self.device) for _ in range(3)
        )
        self._made = made = kernels.Linearised()
        entries = unknowns.particle.numpy()[tetrahedra.tets]
        made.nodes = wp.array(entries, dtype=wp.vec4i, device=self.device)
        made.rest_inverse = tetrahedra.elements.rest_inverse
        made.rotation = wp.zeros(self._elements, dtype=wp.mat33, device=self.device)
        made.mu, made.lam = (wp.zeros(self._elements, dtype=wp.float32, device=self.device) for _ in range(2))
        self._make_room_for_viscosity(0)

    def take(self, q: wp.array, turned: wp.array, dt: float) -> None:
        """Launch the linearisation where positions q are turned, after ``inertia`` and ``free``."""
        tets = self._tetrahedra
        if tets.damped and not len(self._made.viscosity):
            self._make_room_for_viscosity(self._elements)
        inputs = [tets.elements, tets.mu, tets.lam, tets.k_damp, dt, q, turned]
        self._launch(kernels.linearise, self._elements, inputs, [self._made])
        self._of_elements.zero_()
        self._launch(kernels.add_element_blocks, self._elements, [self._made], [self._of_elements])

    def update(self) -> None:
        """Launch the preconditioner for the links as they are."""
        wp.copy(self._inverses, self._of_elements)
        self._links.add_blocks(self._inverses)
        self._launch(kernels.finish_blocks, self._count, [self.free, self.inertia], [self._inverses])
        self._launch(invert_blocks, self._count, [self._inverses], [self._inverses])

    def apply(self, x: wp.array, y: wp.array, *, linked: bool = True) -> None:
        """Launch y = A x, with or without the links."""
        y.zero_()
        self.add_product(x, y)
        if linked:
            self._links.add_products(x, y)
        self._launch(kernels.finish_rows, self._count, [self.free, self.inertia, x], [y])

    def add_product(self, x: wp.array, y: wp.array) -> None:
        """Launch y += (K + D/dt) x."""
        self._launch(kernels.add_element_products, self._elements, [self._made, x], [y])

    @property
    def preconditioner(self) -> BlockInverses:
        return BlockInverses(self)

    def apply_inverses(self, r: wp.array, z: wp.array) -> None:
        self._launch(apply_blocks, self._count, [self._inverses, r], [z])

    def _make_room_for_viscosity(self, count: int) -> None:
        self._made.gradient = wp.zeros(count, dtype=wp.mat33, device=self.device)
        self._made.viscosity = wp.zeros(count, dtype=wp.float32, device=self.device)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


class BlockInverses:
    """The preconditioner of an operator, which keeps it up to date itself."""

    def __init__(self, operator: StepOperator):
        self._operator = operator

    def update(self, operator: LinearOperator) -> None:
        pass

    def apply(self, r: wp.array, z: wp.array) -> None:
        self._operator.apply_inverses(r, z)
