"""The linear system of implicit steps and static answers: its interface for iterative solvers, and a body's tangent.

Vectors over nodes are ``wp.vec4`` arrays like those of ``body.state.State``: [worlds * nodes], world after world, the
fourth lane zero. Vectors that A and preconditioners are applied to are zero at nodes that are not free. All methods
that take vectors launch kernels and do not wait for the device, so that a solve can be recorded.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.kernels.implicit.tangent import finish_blocks, finish_rows
from warp_corot.solvers.halo import ALONE, Halo

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity.added_stress import Viscosity


class Product(Protocol):
    """A symmetric matrix A as what it does to vectors.

    Attributes:
        device: The device of the arrays.
        worlds: Number of copies of the body, which do not interact.
        node_count: Number of nodes of one world; vectors have ``worlds * node_count`` entries or more.
    """

    @property
    def device(self) -> wp.Device: ...

    @property
    def worlds(self) -> int: ...

    @property
    def node_count(self) -> int: ...

    def apply(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x; both vec4 [worlds * nodes], different arrays."""
        ...


class LinearOperator(Product, Protocol):
    """A symmetric matrix A = a M + b D + c K at one state of a body: mass, damping and stiffness.

    Rows of nodes that are not free are those of the identity, and their diagonal blocks too.

    Attributes:
        inverse_mass: Zero at nodes that are not free, float32 [worlds * nodes] [1/kg].
        displacements: The displacements of the linearisation, vec4 [worlds * nodes] [m]; they change with each one.
        scales: a [1/s^2], b [1/s] and c, float32 [3] on the device, so that recorded launches stay valid.
        revision: Changes whenever launches do, so that they must be recorded again: other arrays, other elements. A
            new linearisation or new scales do not change it.
    """

    @property
    def inverse_mass(self) -> wp.array: ...

    @property
    def displacements(self) -> wp.array: ...

    @property
    def scales(self) -> wp.array: ...

    @property
    def revision(self) -> int: ...

    def diagonal_blocks(self) -> wp.array:
        """Launch the 3x3 blocks on the diagonal of A, and return their array, mat33 [worlds * nodes]."""
        ...

    def other_blocks(self) -> wp.array:
        """Launch the 3x3 blocks on K's diagonal of forces besides elasticity, and give their array, mat33
        [worlds * nodes], which ``diagonal_blocks`` may use, too; an array of one entry if there are none."""
        ...


class Preconditioner(Protocol):
    """An approximate inverse B of an operator: linear, symmetric and positive definite.

    At nodes that are not free, B keeps the zeros of r.
    """

    def update(self, operator: LinearOperator) -> None:
        """Launch the update after a new linearisation or new scales of the operator."""
        ...

    def apply(self, r: wp.array, z: wp.array) -> None:
        """Launch z = B r; both vec4 [worlds * nodes], different arrays."""
        ...


@dataclass(frozen=True, eq=False)
class Springs:
    """Places between nodes where springs may be, besides an operator.

    Attributes:
        nodes: The nodes that bear each place, numbered in all worlds, -1 for none, vec4i [S].
        weights: Their shares, vec4 [S].
        stiffness: Of the springs there, zero where there is none, mat33 [S] [N/m].
        update: Launches the stiffness of the present springs.
    """

    nodes: wp.array
    weights: wp.array
    stiffness: wp.array
    update: Callable[[], None]


class TangentOperator:
    """A = a M + b D + c K of a body, a ``LinearOperator``.

    Args:
        body: The body.
        field: Its elastic forces.
        viscosity: Its viscous forces, D, or None.
        stiff_forces: Other forces that have a stiffness: ``add_stiffness(body, p, y)`` and
            ``add_diagonal(body, blocks)``, as ``ForceField`` but at the body's present state. Those that couple no two
            nodes have a true ``is_diagonal``.
        exact: Whether K is the exact derivative, which may be indefinite, if the law has two.
        ranks: The ranks with other nodes of the body.
        number: The number of the body.

    Attributes:
        tangent: The elastic K.
        frame: Displacements whose rotations turn viscous forces [m], vec4; None: those of the linearisation.
    """

    def __init__(
        self,
        body: SoftBody,
        field: ForceField,
        *,
        viscosity: Viscosity | None = None,
        stiff_forces: Sequence[Any] = (),
        exact: bool = False,
        ranks: Halo = ALONE,
        number: int = 0,
    ):
        self.body, self.field, self.viscosity = body, field, viscosity
        self.ranks, self.number = ranks, number
        self.stiff_forces = tuple(stiff_forces)
        self.device, self.worlds = body.device, body.worlds
        self.tangent = field.tangent(exact=exact)
        self.frame: wp.array | None = None
        self.scales = wp.array([0.0, 0.0, 1.0], dtype=wp.float32, device=self.device)
        self._none = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self._no_blocks = wp.zeros(1, dtype=wp.mat33, device=self.device)
        self._blocks = wp.zeros(0, dtype=wp.mat33, device=self.device)
        self.prepare()

    def prepare(self) -> None:
        """Make room for the body's present nodes; not while launches are recorded."""
        u = self.body.state.displacements
        self.tangent.prepare(u)
        if len(self._blocks) != len(u):
            self._damped = self._none if self.viscosity is None else wp.zeros_like(u)
            self._blocks = wp.zeros(len(u), dtype=wp.mat33, device=self.device)

    @property
    def node_count(self) -> int:
        return self.body.sizes.launch_nodes // self.worlds

    @property
    def inverse_mass(self) -> wp.array:
        return self.body.conditions.inverse_mass

    @property
    def displacements(self) -> wp.array:
        return self.tangent.displacements

    @property
    def revision(self) -> int:
        return self.body.launch_revision

    def set_scales(self, mass: float, damping: float, stiffness: float) -> None:
        """Set a [1/s^2], b [1/s] and c; not while launches are recorded."""
        self.scales.assign([mass, damping, stiffness])

    def take(self, u: wp.array) -> None:
        """Launch the linearisation at displacements u [m], vec4 [worlds * nodes]."""
        self.tangent.take(u)

    def apply(self, x: wp.array, y: wp.array) -> None:
        y.zero_()
        everywhere = self.ranks.exchange(self.number, x, copies=True)
        self.tangent.add_product(everywhere, y)
        for forces in self.stiff_forces:
            forces.add_stiffness(self.body, x, y)
        if self.viscosity is not None:
            self._damped.zero_()
            frame = self.displacements if self.frame is None else self.frame
            self.viscosity.scatter(frame, everywhere, self._damped)
        conditions = self.body.conditions
        inputs = [self.scales, conditions.mass, conditions.inverse_mass, x, self._damped]
        self._launch(finish_rows, inputs, [y])

    def diagonal_blocks(self) -> wp.array:
        blocks, conditions = self._blocks, self.body.conditions
        blocks.zero_()
        self.tangent.add_diagonal(blocks)
        for forces in self.stiff_forces:
            forces.add_diagonal(self.body, blocks)
        stiffening = 0.0 if self.viscosity is None else self.viscosity.seconds
        self._launch(finish_blocks, [self.scales, conditions.mass, conditions.inverse_mass, stiffening], [blocks])
        return blocks

    def other_blocks(self) -> wp.array:
        if not self.stiff_forces:
            return self._no_blocks
        self._blocks.zero_()
        for forces in self.stiff_forces:
            forces.add_diagonal(self.body, self._blocks)
        return self._blocks

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.body.sizes.launch_nodes, inputs, outputs, device=self.device)
