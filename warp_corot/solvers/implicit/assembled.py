"""Linear solves of one body with its matrix assembled, each in one launch; see ``kernels.implicit.assembled``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.elasticity.corotated.elements import CorotatedField
from warp_corot.elasticity.dilatation.field import DilatationField
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.implicit import assembled as kernels
from warp_corot.kernels.implicit.multigrid import values
from warp_corot.kernels.implicit.multigrid.cycle import Rows
from warp_corot.materials.directional import Directional

from .multigrid.leaf_matrix import LeafMatrix
from .multigrid.pattern import PatternFinder
from .operator import LinearOperator, Preconditioner
from .tangent import TangentOperator

if TYPE_CHECKING:
    from .conjugate_gradients import ConjugateGradients
    from .touching import Held

#: Threads of a block on CUDA, and the lanes that share a row: as many as leave no thread idle, within these bounds.
THREADS, FEWEST_LANES, MOST_LANES = 512, 4, 16
#: Numbers between the barriers of two teams of blocks, so that these lie in lines of their own.
STRIDE = 32
#: Room for the products that contacts add: so many a node, and at least this many.
ROOM, LEAST_ROOM = 2, 4096


def suits(operator: TangentOperator) -> bool:
    """Whether an operator's matrix can be assembled: corotated elements of a forest, each with its own rotation."""
    field = operator.field.shear if isinstance(operator.field, DilatationField) else operator.field
    return (
        isinstance(field, CorotatedField)
        and field.model.rotation_level is None
        and operator.body.discretization.element_kind is ForestElements
        and not isinstance(operator.body.material, Directional)
        and operator.viscosity is None
        and operator.ranks.is_alone
        and all(getattr(forces, "is_diagonal", False) for forces in operator.stiff_forces)
    )


class AssembledSolve:
    """The matrix of an operator, and conjugate gradients with it in one launch.

    On the CPU a thread solves a world, with a symmetric sweep over the rows as preconditioner (SSOR); on CUDA resident
    blocks do, with the inverses of diagonal blocks. ``ConjugateGradients`` takes it in place of a preconditioner.

    Args:
        operator: An operator that ``suits``.
        touches: Whether there may be contacts.

    Attributes:
        touches: As given.
        diagonal: The blocks on the diagonal without contacts, mat33 [worlds * nodes + 1].
        couplings: The contacts of the present solve.
    """

    def __init__(self, operator: TangentOperator, *, touches: bool):
        self._operator, self.device, self.touches, self._version = operator, operator.device, touches, -1
        self.follow()

    def follow(self) -> None:
        """Follow the mesh, if it has changed; not while launches are recorded. Waits for the device."""
        operator, device = self._operator, self.device
        sizes = operator.body.discretization.sizes
        count, worlds = operator.node_count, operator.worlds
        if self._version == sizes.version:
            return
        self._version = sizes.version
        self._count, self._worlds, nodes = count, worlds, count * worlds
        members = operator.field.find_members
        self._nodes = wp.array(np.arange(count), dtype=wp.int32, device=device)
        self._free = wp.zeros(nodes, dtype=wp.uint8, device=device)
        finder = PatternFinder(wp.zeros(count, dtype=wp.vec2i, device=device))
        groups = None if members is None else members(sizes.world_elements)
        given = [operator.body.discretization, finder, self._nodes, self._nodes, count, self._free, groups]
        self._leaves = LeafMatrix(*given)
        self._pattern = found = self._leaves.pattern
        # One more, since products read past the last.
        self.diagonal, self._inverses, self._pivots = (
            wp.zeros(nodes + 1, dtype=wp.mat33, device=device) for _ in range(3)
        )
        self._rows = Rows()
        self._rows.starts, self._rows.columns = found.starts, found.columns
        self._rows.blocks = wp.zeros(worlds * found.entries + 1, dtype=wp.mat33, device=device)
        planes = 9 * worlds * found.entries if device.is_cuda else 1
        self._planes = wp.zeros(planes, dtype=wp.float32, device=device)
        self._vectors = [wp.zeros(nodes, dtype=wp.vec4, device=device) for _ in range(5)]
        self._make_couplings(nodes)
        self._find_launch(count, worlds)

    def _make_couplings(self, nodes: int) -> None:
        self.couplings, room = kernels.Couplings(), max(ROOM * nodes, LEAST_ROOM) if self.touches else 1
        for name, dtype, size in (
            ("count", wp.int32, 1),
            ("nodes", wp.int32, (room, kernels.PLACES)),
            ("parts", wp.vec4, (room, kernels.PLACES)),
            ("blocks", wp.mat33, nodes),
            ("projected", wp.int32, nodes),
            ("projectors", wp.mat33, nodes + 1),
            ("drag", wp.mat33, nodes),
        ):
            setattr(self.couplings, name, wp.zeros(size, dtype=dtype, device=self.device))

    def _find_launch(self, count: int, worlds: int) -> None:
        """Find how blocks share the worlds, and threads the rows."""
        if self.device.is_cpu:
            self._dim, self._per_team, self._lanes, self._block, teams = worlds, 1, 1, 256, 1
        else:
            blocks = self.device.sm_count
            # A block with few nodes mostly waits for the others.
            self._per_team = max(min(blocks // worlds, count * MOST_LANES // THREADS), 1)
            teams = min(blocks // self._per_team, worlds)
            own = -(-count // self._per_team)
            # Long rows are shared by more lanes.
            long = self._pattern.entries > MOST_LANES * count
            self._lanes, self._block = 2 * FEWEST_LANES if long else FEWEST_LANES, THREADS
            while self._lanes < MOST_LANES and 2 * self._lanes * own <= THREADS:
                self._lanes *= 2
            self._dim = teams * self._per_team * THREADS
        self._parts = wp.zeros(3 * teams * self._per_team, dtype=wp.float64, device=self.device)
        self._barriers = wp.zeros(STRIDE * teams, dtype=wp.uint32, device=self.device)

    @property
    def kernels(self) -> list[wp.Kernel]:
        """Kernels of factories that it launches."""
        return self._leaves.kernels

    # --- launches ----------------------------------------------------------------------------------------------------

    def update(self, operator: LinearOperator) -> None:
        """Launch the computation of the matrix at the operator's displacements and scales, without contacts."""
        found, count, blocks = self._pattern, self._count, self._rows.blocks
        self._launch(values.find_free, count, [count, count, self._nodes, operator.inverse_mass], [self._free])
        self._leaves.gather(operator, blocks, self._inverses, holds=True)
        self._launch(kernels.keep_diagonal, count, [count, found.entries, found.diagonal, blocks], [self.diagonal])
        if self.device.is_cuda:
            self._launch(kernels.lay_out, found.entries, [found.entries, blocks], [self._planes])
        self._empty()
        self._finish()

    def take_contact(self, held: Held) -> None:
        """Launch the exchange of the contacts in the matrix for the present ones."""
        self._empty()
        held.launch_couplings(self.couplings)
        self._finish()

    def iterate(self, solver: ConjugateGradients, preconditioner: Preconditioner, x: wp.array, r: wp.array) -> None:
        found = self._pattern
        if self._per_team > 1:
            self._barriers.zero_()
        inputs = [self._worlds, self._count, found.entries, self._per_team, self._lanes, solver.most, self._rows]
        inputs += [self._planes, found.diagonal, self._inverses, self._pivots, self.couplings]
        outputs = [x, r, solver.scalars, solver.status, solver.iterations, *self._vectors, self._parts, self._barriers]
        wp.launch(kernels.solve, self._dim, inputs, outputs, device=self.device, block_dim=self._block)

    # --- on the host -------------------------------------------------------------------------------------------------

    def largest_frequency(self) -> float:
        """The largest frequency of a free node among fixed ones at the present displacements [rad/s]; waits for the
        device."""
        operator, nodes = self._operator, self._worlds * self._count
        operator.take(operator.body.state.displacements)
        operator.set_scales(0.0, 0.0, 1.0)
        self.update(operator)
        # The arrays of a mesh that changes have more room.
        mass = operator.inverse_mass.numpy()[:nodes]
        blocks = self.diagonal.numpy()[:nodes].astype(float)
        stiffness = np.nan_to_num(np.trace(blocks, axis1=1, axis2=2) / 3.0, posinf=1e38)
        return float(np.sqrt(max((stiffness * mass).max(initial=0.0), 0.0)))

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _empty(self) -> None:
        self.couplings.count.zero_()
        self.couplings.blocks.zero_()
        self.couplings.projected.zero_()

    def _finish(self) -> None:
        found = self._pattern
        inputs = [self._count, found.entries, found.diagonal, self.diagonal, self.couplings]
        outputs = [self._rows.blocks, self._pivots, self._inverses, self._planes]
        self._launch(kernels.finish_matrix, self._count, inputs, outputs)

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel with ``count`` threads for each world."""
        wp.launch(kernel, (self._worlds, count), inputs, outputs, device=self.device)
