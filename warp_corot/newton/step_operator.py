"""The matrix of an implicit step of a Newton model, and its preconditioner; see ``kernels.newton.implicit``."""

from __future__ import annotations

import warp as wp

from warp_corot.elasticity.model import isotropic_material
from warp_corot.kernels.corotated.tangent import PLACES, KeptGradients, add_kept_product
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.elements.stiffness_products import add_stiffness_product
from warp_corot.kernels.newton import implicit as kernels
from warp_corot.solvers.implicit.block_diagonal import BlockDiagonal

from .library import newton
from .links import RowForces
from .tetrahedra import Tetrahedra
from .unknowns import Unknowns


class StepOperator:
    """M (1/dt^2 + damping/dt) + K + D/dt, of a system whose contact adds the stiffness of rows.

    Rows of entries that are not free are zero, so that the others see how these move.

    Args:
        model: The model.
        tetrahedra: Its elements.
        unknowns: The entries of vectors.
        free: Whether an entry is free, float32 [entries].
        rows: Contacts and attachments, which are part of the blocks on the diagonal.

    Attributes:
        inverse_mass: ``free``.
        inertia: The first term, mat33 [entries].
        damped: Whether elements are viscous.
    """

    def __init__(
        self, model: newton.Model, tetrahedra: Tetrahedra, unknowns: Unknowns, free: wp.array, rows: RowForces
    ):
        self.device, self.worlds, self.node_count = model.device, unknowns.worlds, unknowns.count
        self._tetrahedra, self._rows, self._count = tetrahedra, rows, int(model.tet_count)
        self.inverse_mass, self.damped = free, False
        self.inertia, self._of_elements, self._blocks = (
            wp.zeros(len(free), dtype=wp.mat33, device=self.device) for _ in range(3)
        )
        self._none, self._no_list = (wp.zeros(0, dtype=dtype, device=self.device) for dtype in (wp.vec4, wp.int32))
        own, self._elements = tetrahedra.elements, GeneralElements()
        self._elements.nodes = wp.array(unknowns.particle.numpy()[tetrahedra.tets], dtype=wp.vec4i, device=self.device)
        self._elements.targets = self._elements.nodes
        self._elements.rest_inverse, self._elements.volume = own.rest_inverse, own.volume
        #: Eight elements each on the CPU.
        self._lanes = -(-self._count // LANES) if self.device.is_cpu else 0
        self._made = made = kernels.Linearised()
        made.mu, made.lam = tetrahedra.mu, tetrahedra.lam
        made.rotation = wp.zeros(self._count, dtype=wp.mat33, device=self.device)
        self._make_room_for_viscosity(0)
        made.kept = wp.zeros(PLACES * self._lanes, dtype=wp.vec4, device=self.device)
        self._kept = KeptGradients()
        self._kept.isotropic, self._kept.gradients = isotropic_material([made.mu, made.lam, 1]), made.kept

    def take(self, q: wp.array, turned: wp.array, dt: float) -> None:
        """Launch the linearisation where positions q are turned."""
        tets, made = self._tetrahedra, self._made
        self.damped = tets.damped
        if self.damped and not len(made.viscosity):
            self._make_room_for_viscosity(self._count)
        inputs = [tets.elements, tets.k_damp, dt, q, turned]
        self._launch(kernels.linearise, self._count, inputs, [made])

    def take_diagonal(self) -> None:
        """Launch the blocks of elements on the diagonal."""
        self._of_elements.zero_()
        self._launch(kernels.add_element_blocks, self._count, [self._elements, self._made], [self._of_elements])

    def diagonal_blocks(self) -> wp.array:
        """Launch the blocks on the diagonal, with those of rows, mat33 [entries]."""
        wp.copy(self._blocks, self._of_elements)
        self._rows.add_blocks(self._blocks)
        self._launch(kernels.finish_blocks, len(self._blocks), [self.inverse_mass, self.inertia], [self._blocks])
        return self._blocks

    def apply(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x."""
        y.zero_()
        self.add_product(x, y)
        self._launch(kernels.finish_rows, len(y), [self.inverse_mass, self.inertia, x], [y])

    def add_product(self, x: wp.array, y: wp.array) -> None:
        """Launch y += (K + D/dt) x."""
        if self._lanes and not self.damped:
            inputs = [self._elements, self._count, self._kept, x]
            self._launch(add_kept_product(), self._lanes, inputs, [y, self._no_list])
            return
        kernel = add_stiffness_product(GeneralElements, kernels.Linearised, kernels.linearised(self.damped))
        self._launch(kernel, self._count, [self._elements, self._made, self._none, x], [y])

    def _make_room_for_viscosity(self, count: int) -> None:
        self._made.gradient = wp.zeros(count, dtype=wp.mat33, device=self.device)
        self._made.viscosity = wp.zeros(count, dtype=wp.float32, device=self.device)

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list, outputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, outputs=outputs, device=self.device)


class RowBlocks(BlockDiagonal):
    """The inverses of the blocks on the diagonal of a step's matrix, with those of the rows that act."""

    def take_springs(self) -> None:
        """Launch the update to the rows as they are now."""
        self.update(self._operator)
