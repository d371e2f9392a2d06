"""The operator of implicit steps and static answers, and the state at which steps with one linearisation take it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from warp_corot.elasticity import ForceField
from warp_corot.kernels.implicit import increments as kernels
from warp_corot.kernels.implicit.tangent import finish_blocks, finish_rows
from warp_corot.solvers.halo import ALONE, Halo

from .conjugate_gradients import WorldSums
from .tension import Tension

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.elasticity.added_stress import Viscosity


class TangentOperator:
    """A symmetric matrix A = a M + b D + c K at one state of a body: mass, damping and stiffness.

    Rows of nodes that are not free are those of the identity, and their diagonal blocks too.

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
        tangent: The elastic K, without tension's part if there is a ``tension``.
        tension: The rest of the elastic K, or None.
        scales: a [1/s^2], b [1/s] and c, float32 [3] on the device, so that recorded launches stay valid.
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
        self.tangent = field.tangent(exact=True) if exact else field.definite_tangent()
        self.frame: wp.array | None = None
        self.scales = wp.array([0.0, 0.0, 1.0], dtype=wp.float32, device=self.device)
        self.tension = None if exact else Tension.of(field, self.tangent, body.conditions.mass, self.scales)
        self._none = wp.zeros(1, dtype=wp.vec4, device=self.device)
        self._no_blocks = wp.zeros(1, dtype=wp.mat33, device=self.device)
        self._blocks = wp.zeros(0, dtype=wp.mat33, device=self.device)
        self.prepare()

    def prepare(self) -> None:
        """Make room for the body's present nodes; not while launches are recorded."""
        u = self.body.state.displacements
        self.tangent.prepare(u)
        if self.tension is not None:
            self.tension.prepare()
        if len(self._blocks) != len(u):
            self._damped = self._none if self.viscosity is None else wp.zeros_like(u)
            self._blocks = wp.zeros(len(u), dtype=wp.mat33, device=self.device)

    @property
    def node_count(self) -> int:
        return self.body.sizes.launch_nodes // self.worlds

    @property
    def inverse_mass(self) -> wp.array:
        """Zero at nodes that are not free, float32 [worlds * nodes] [1/kg]."""
        return self.body.conditions.inverse_mass

    @property
    def displacements(self) -> wp.array:
        """Those of the linearisation, vec4 [worlds * nodes] [m]; they change with each one."""
        return self.tangent.displacements

    @property
    def revision(self) -> int:
        """Changes whenever launches do, so that they must be recorded again: other arrays, other elements."""
        return self.body.launch_revision

    def set_scales(self, mass: float, damping: float, stiffness: float) -> None:
        """Set a [1/s^2], b [1/s] and c; not while launches are recorded."""
        self.scales.assign([mass, damping, stiffness])

    def take(self, u: wp.array) -> None:
        """Launch the linearisation at displacements u [m], vec4 [worlds * nodes]."""
        self.tangent.take(u)
        if self.tension is not None:
            self.tension.take(u)

    def add_elastic_product(self, p: wp.array, y: wp.array) -> None:
        """Launch y += K p [N], of elastic forces; both vec4 [worlds * nodes]."""
        self.tangent.add_product(p, y)
        if self.tension is not None:
            self.tension.add_product(p, y)

    def apply(self, x: wp.array, y: wp.array) -> None:
        y.zero_()
        everywhere = self.ranks.exchange(self.number, x, copies=True)
        self.add_elastic_product(everywhere, y)
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
        """Launch the 3x3 blocks on the diagonal of A, and return their array, mat33 [worlds * nodes]."""
        blocks, conditions = self._blocks, self.body.conditions
        blocks.zero_()
        self.tangent.add_diagonal(blocks)
        if self.tension is not None:
            self.tension.add_diagonal(blocks)
        for forces in self.stiff_forces:
            forces.add_diagonal(self.body, blocks)
        stiffening = 0.0 if self.viscosity is None else self.viscosity.seconds
        self._launch(finish_blocks, [self.scales, conditions.mass, conditions.inverse_mass, stiffening], [blocks])
        return blocks

    def other_blocks(self) -> wp.array:
        """Launch those of K of forces besides elasticity, and give their array, which may be that of
        ``diagonal_blocks``; an array of one entry if there are none."""
        if not self.stiff_forces:
            return self._no_blocks
        self._blocks.zero_()
        for forces in self.stiff_forces:
            forces.add_diagonal(self.body, self._blocks)
        return self._blocks

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        wp.launch(kernel, self.body.sizes.launch_nodes, inputs, outputs, device=self.device)


class TurnedState:
    """A body turned as a whole as it will turn in a step of backward Euler; see ``kernels.implicit.increments``.

    Elastic forces are linearised there, and then taken back to where the step begins: f(x) = f(x + w) + K w with the
    way w of the turn. Bodies with held nodes are not turned.

    Args:
        operator: The operator of the body, whose derivative is taken there.
        dt: The step [s].

    Attributes:
        displacements: Those of the turned body [m], vec4.
    """

    def __init__(self, operator: TangentOperator, dt: float):
        self._operator, self._dt, self.body = operator, wp.float64(dt), operator.body
        worlds, device = operator.worlds, operator.device
        self.displacements, self._way = (wp.zeros_like(self.body.state.displacements) for _ in range(2))
        self._sums = WorldSums(worlds, operator.node_count, kernels.MOTION_COLUMNS, device, operator.ranks)
        self._centres = wp.zeros(worlds, dtype=wp.vec3, device=device)
        self._turns = wp.zeros(worlds, dtype=wp.mat33, device=device)
        self._any_turns = wp.zeros(1, dtype=wp.int32, device=device)

    def launch_forces(self, forces: wp.array) -> None:
        """Launch the linearisation, and the addition of its elastic forces in the present state [N], vec4."""
        body, sums, operator = self.body, self._sums, self._operator
        state, conditions = body.state, body.conditions
        self._any_turns.zero_()
        inputs = [conditions.mass, conditions.inverse_mass, state.rest, state.displacements, state.velocities]
        sums.launch(kernels.sum_motion, inputs, *range(kernels.MOTION_COLUMNS))
        outputs = [self._centres, self._turns, self._any_turns]
        sums.launch_scalars(kernels.find_turns, [self._dt], outputs)
        inputs = [operator.node_count, state.rest, state.displacements, self._centres, self._turns]
        outputs = [self.displacements, self._way]
        wp.launch(kernels.turn_nodes, body.sizes.launch_nodes, inputs, outputs, device=operator.device)
        operator.field.add_forces(self.displacements, forces)
        operator.take(self.displacements)
        if operator.device.is_cpu:
            wp.capture_if(self._any_turns, self._go_back, forces=forces)
        else:
            # A condition would take longer.
            self._go_back(forces)

    def _go_back(self, forces: wp.array) -> None:
        self._operator.add_elastic_product(self._way, forces)
