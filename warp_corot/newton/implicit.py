"""Implicit steps of a Newton model; see ``kernels.newton.implicit``."""

from __future__ import annotations

import math
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import warp as wp

from warp_corot.elasticity.model import isotropic_material
from warp_corot.errors import InputError
from warp_corot.kernels.corotated.tangent import PLACES, KeptGradients, add_kept_product
from warp_corot.kernels.elements.elements import GeneralElements
from warp_corot.kernels.elements.forces import add_stiffness_product
from warp_corot.kernels.elements.simd8 import LANES
from warp_corot.kernels.implicit import conjugate_gradients, increments
from warp_corot.kernels.implicit.steps import count_solves
from warp_corot.kernels.implicit.tangent import finish_blocks, finish_rows
from warp_corot.kernels.newton import implicit as kernels
from warp_corot.kernels.newton.particles import Particles
from warp_corot.kernels.stepping.stability import add_scaled
from warp_corot.mesh.topology import connected
from warp_corot.solvers.implicit.block_system import BlockSystem
from warp_corot.solvers.implicit.conjugate_gradients import WorldSums
from warp_corot.solvers.implicit.contact_solve import ContactSolve
from warp_corot.solvers.implicit.operator import SolvedContact
from warp_corot.solvers.implicit.preconditioners import BlockDiagonal
from warp_corot.solvers.recorded import Replays

from .contact import Contacts
from .library import Step, newton
from .steps import Steps
from .tetrahedra import Tetrahedra

#: Residual of the linear solves over their right side.
TOLERANCE = 1e-4
#: The most iterations of a linear solve.
ITERATIONS = 1000
#: The longest step of Newton's semi-implicit solver of rigid bodies [s].
RIGID_STEP = 5e-4
#: Worlds are solved side by side if their vectors, all as long as the longest, have at most this many times as many
#: entries as are needed.
PADDING = 2


def unknowns_of(model: newton.Model) -> tuple[int, kernels.Unknowns]:
    """The entries of vectors, without a right side and motions, and in how many worlds they are solved for side by
    side.

    Each world is solved by itself if everything that moves is in a world; otherwise all worlds are solved together.
    """
    particles, bodies, made = model.particle_count, model.body_count, kernels.Unknowns()
    worlds = model.particle_world.numpy()
    if bodies:
        worlds = np.concatenate([worlds, np.repeat(model.body_world.numpy(), 2)])
    if worlds.min() < 0:
        worlds = np.zeros_like(worlds)
    worlds, size = np.unique(worlds, return_inverse=True, return_counts=True)[1:]
    if len(size) * size.max() > PADDING * size.sum():
        worlds, size = np.zeros_like(worlds), np.array([len(worlds)])
    made.count = count = int(size.max())
    entry = np.empty(len(worlds), np.int32)
    starts = count * np.arange(len(size)) - np.cumsum(size) + size
    entry[np.argsort(worlds, kind="stable")] = np.arange(len(worlds)) + np.repeat(starts, size)
    owner = np.full(len(size) * count, -1, np.int32)
    owner[entry[particles::2]] = np.arange(bodies)
    made.particle, made.body, made.owner = (
        wp.array(values, dtype=wp.int32, device=model.device)
        for values in (entry[:particles], np.ascontiguousarray(entry[particles::2]), owner)
    )
    made.mass = wp.zeros(len(owner), dtype=wp.float32, device=model.device)
    made.roots = wp.zeros(bodies, dtype=wp.mat33, device=model.device)
    made.way, made.fall = (wp.zeros(len(owner), dtype=wp.vec4, device=model.device) for _ in range(2))
    return len(size), made


class TurnedPieces:
    """A model whose free pieces are turned as they will turn in a step; see ``solvers.implicit.body_steps``.

    Pieces with held particles are not turned.

    Args:
        model: The model.
        tetrahedra: Its elements.
        unknowns: The entries of vectors.

    Attributes:
        positions: Those of the turned particles [m], vec3 [P].
    """

    def __init__(self, model: newton.Model, tetrahedra: Tetrahedra, unknowns: kernels.Unknowns):
        self._tetrahedra, self._unknowns, device = tetrahedra, unknowns, model.device
        piece = np.full(model.particle_count, -1, np.int32)
        piece[tetrahedra.tets] = connected(tetrahedra.tets)[:, None]
        members = np.argsort(piece, kind="stable")[np.count_nonzero(piece < 0) :]
        first = np.cumsum(np.bincount(piece + 1))
        first -= first[0]
        count = len(first) - 1
        self._sums = WorldSums(count, int(np.diff(first).max(initial=0)), increments.MOTION_COLUMNS, device)
        self._piece, self._members, self._first = (
            wp.array(values, dtype=wp.int32, device=device) for values in (piece, members, first)
        )
        self._centres = wp.zeros(count, dtype=wp.vec3, device=device)
        self._turns = wp.zeros(count, dtype=wp.mat33, device=device)
        self._any_turns = wp.zeros(1, dtype=wp.int32, device=device)
        self.positions = wp.zeros(model.particle_count, dtype=wp.vec3, device=device)

    def launch(self, particles: Particles, dt: float) -> None:
        """Launch the turn in a step of dt [s], and the way there; the elements' gathered positions are turned, too."""
        sums = self._sums
        sums.launch(kernels.sum_motion, [self._first, self._members, particles])
        outputs = [self._centres, self._turns, self._any_turns]
        sums.launch_scalars(increments.find_turns, [wp.float64(dt)], outputs)
        inputs = [self._piece, self._centres, self._turns, particles, self._unknowns, self._tetrahedra.u]
        wp.launch(kernels.turn_particles, len(self.positions), inputs, [self.positions], device=sums.device)


class RowForces(SolvedContact):
    """Forces and stiffness of rows as functions of the motions in a step. They have nothing to locate or to list.

    Args:
        contacts: The model's contacts.
        unknowns: The entries of vectors.

    Attributes:
        solves: Number of linear solves of the last step, int32 [1].
    """

    def __init__(self, contacts: Contacts, unknowns: kernels.Unknowns):
        self.device, self._contacts, self._unknowns = contacts.device, contacts, unknowns
        empty = (wp.spatial_vector, wp.vec4)
        self._no_wrenches, self._no_motion = (wp.empty(0, dtype=dtype, device=self.device) for dtype in empty)
        #: Nothing changes besides forces.
        self.changed, self.solves = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))
        self._make_room()

    @property
    def count(self) -> int:
        return self._contacts.count

    def begin(self, step: Step, of_bodies: newton.State) -> bool:
        """Launch the rows of a step from its first state; return whether their arrays are new."""
        contacts, is_new = self._contacts, self.count != len(self._rows.nodes)
        if is_new:
            self._make_room()
        self._rows.dt, self._rows.adhesion = step.dt, contacts.law.adhesion
        given = [contacts.law, contacts.particles(step.state_in), contacts.bodies(of_bodies), self._unknowns]
        self._launch(kernels.begin_springs, *given, contacts.rows, self._rows)
        return is_new

    def report(self, step: Step, share: float) -> None:
        """Launch the wrenches on bodies [N, N m], and add those of contacts, times ``share``, to the reported ones."""
        contacts = self._contacts
        contacts.reactions.zero_()
        reported = self._no_wrenches if step.reported is None else step.reported
        given = [self._rows, self._unknowns, contacts.contact_count, share, step.first_contact]
        self._launch(kernels.report_rows, *given, contacts.reactions, reported)

    def add_blocks(self, blocks: wp.array) -> None:
        self._launch(kernels.add_row_blocks, self._rows, blocks)

    # --- as a contact of solves, see ``SolvedContact`` ---------------------------------------------------------------

    def update(self, d: wp.array, *, is_solved: bool = False) -> None:
        self._launch(kernels.update_springs, int(is_solved), d, self._rows)

    def add_forces(self, y: wp.array) -> None:
        self.add_products(self._no_motion, y)

    def add_products(self, x: wp.array, y: wp.array) -> None:
        self._launch(kernels.add_row_forces, self._unknowns, self._rows, x, y)

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: int | None = None
    ) -> None:
        self._launch(kernels.add_row_slopes, self._unknowns, self._rows, d, change, search, slopes)

    def launch_going(self, d: wp.array, rounds: wp.array, most: int, going: wp.array) -> None:
        wp.copy(self.solves, rounds)

    def launch_end(self, d: wp.array) -> None:
        self.update(d, is_solved=True)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _make_room(self) -> None:
        self._rows = made = kernels.RowSprings()
        made.solves = self.solves
        fields: Any = kernels.RowSprings
        for name, variable in fields.vars.items():
            if name not in ("dt", "adhesion", "solves"):
                setattr(made, name, wp.zeros(self.count, dtype=variable.type.dtype, device=self.device))

    def _launch(self, kernel: wp.Kernel, *arguments: Any) -> None:
        if self.count:
            wp.launch(kernel, self.count, arguments, device=self.device)


class StepOperator:
    """M (1/dt^2 + damping/dt) + K + D/dt, of a system whose contact adds the stiffness of rows.

    Rows of entries that are not free are those of the identity.

    Args:
        model: The model.
        tetrahedra: Its elements.
        worlds, unknowns: Number of worlds, and the entries of vectors.
        rows: Contacts and attachments, which are part of the blocks on the diagonal.

    Attributes:
        inverse_mass: Positive if an entry is free, float32 [entries].
    """

    def __init__(
        self, model: newton.Model, tetrahedra: Tetrahedra, worlds: int, unknowns: kernels.Unknowns, rows: RowForces
    ):
        self.device, self.worlds, self.node_count = model.device, worlds, unknowns.count
        self._launch = partial(wp.launch, device=self.device)
        self._tetrahedra, self._rows, self._count = tetrahedra, rows, int(model.tet_count)
        self.inverse_mass = unknowns.mass
        self._of_elements, self._blocks = (
            wp.zeros(len(unknowns.mass), dtype=wp.mat33, device=self.device) for _ in range(2)
        )
        scales = wp.array([1.0, 0.0, 1.0], dtype=wp.float32, device=self.device)
        self._masses = [scales, unknowns.mass, unknowns.mass]
        self._none, self._no_list = (wp.zeros(0, dtype=dtype, device=self.device) for dtype in (wp.vec4, wp.int32))
        own, self._elements = tetrahedra.elements, GeneralElements()
        self._elements.nodes = wp.array(unknowns.particle.numpy()[tetrahedra.tets], dtype=wp.vec4i, device=self.device)
        self._elements.targets = self._elements.nodes
        self._elements.rest_inverse, self._elements.volume = own.rest_inverse, own.volume
        #: Eight elements each on the CPU.
        self._lanes = -(-self._count // LANES) if self.device.is_cpu else 0
        self._made = made = kernels.Linearised()
        made.mu, made.lam = (wp.zeros(self._count, dtype=wp.float32, device=self.device) for _ in range(2))
        made.rotation = wp.zeros(self._count, dtype=wp.mat33, device=self.device)
        made.kept = wp.zeros(PLACES * self._lanes, dtype=wp.vec4, device=self.device)
        self._kept = KeptGradients()
        self._kept.isotropic, self._kept.gradients = isotropic_material([made.mu, made.lam, 1]), made.kept

    def take(self, turned: wp.array, dt: float) -> None:
        """Launch the linearisation at turned positions, of a step of dt [s]."""
        tets = self._tetrahedra
        inputs = [tets.elements, tets.mu, tets.lam, tets.k_damp, dt, turned]
        self._launch(kernels.linearise, self._count, inputs, [self._made])

    def take_diagonal(self) -> None:
        """Launch the blocks of elements on the diagonal."""
        self._of_elements.zero_()
        self._launch(kernels.add_element_blocks, self._count, [self._elements, self._made], [self._of_elements])

    def diagonal_blocks(self) -> wp.array:
        """Launch the blocks on the diagonal, with those of rows, mat33 [entries]."""
        wp.copy(self._blocks, self._of_elements)
        self._rows.add_blocks(self._blocks)
        self._launch(finish_blocks, len(self._blocks), [*self._masses, 0.0], [self._blocks])
        return self._blocks

    def apply(self, x: wp.array, y: wp.array) -> None:
        """Launch y = A x."""
        y.zero_()
        self.add_product(x, y)
        self._launch(finish_rows, len(y), [*self._masses, x, self._none], [y])

    def add_product(self, x: wp.array, y: wp.array) -> None:
        """Launch y += (K + D/dt) x."""
        if self._lanes:
            inputs = [self._elements, self._count, self._kept, x]
            self._launch(add_kept_product(), self._lanes, inputs, [y, self._no_list])
            return
        kernel = add_stiffness_product(GeneralElements, kernels.Linearised, kernels.linearised)
        self._launch(kernel, self._count, [self._elements, self._made, self._none, x], [y])


class RowBlocks(BlockDiagonal):
    """The inverses of the blocks on the diagonal of a step's matrix, with those of the rows that act."""

    def take_springs(self) -> None:
        """Launch the update to the rows as they are now."""
        self.update(self._operator)


class ImplicitSteps(Steps):
    """Backward Euler for the tetrahedra of a model, with one linearisation of elastic forces a step.

    Contacts, attachments and the bodies that they act on are solved for together with the tetrahedra. In these solves
    only soft bodies, gravity and forces in the state act on rigid bodies; their own solver then moves them.

    Args:
        model, parts: As for ``Steps``.

    Raises:
        InputError: The model has something that only explicit steps support.
    """

    def __init__(self, model: newton.Model, *parts: Any):
        super().__init__(model, *parts)
        if self.others.has_particles:
            raise InputError(
                "the model has springs, cloth or bending edges with stiffness, or particle_contact is given; "
                "integrator='implicit' steps only tetrahedra: use integrator='explicit'"
            )
        worlds, self._unknowns = unknowns_of(model)
        self._rows = RowForces(self.contacts, self._unknowns)
        self._turned = TurnedPieces(model, self.tetrahedra, self._unknowns)
        operator: Any = StepOperator(model, self.tetrahedra, worlds, self._unknowns, self._rows)
        contact: Any = self._rows
        self._operator = operator
        self._system = BlockSystem([operator], [RowBlocks(operator)], contact=contact, most=ITERATIONS)
        self._system.solver.tolerance.fill_(TOLERANCE)
        self._unknowns.b, self._unknowns.d = self._system.b, self._system.x
        self._solve = ContactSolve(self._system, [])
        self._motions = [self._unknowns.particle, self._system.x]
        #: Number of linear solves, which is that of all worlds.
        self._rounds = wp.zeros(worlds, dtype=wp.int32, device=self.device)
        # Viscous forces are those of the velocities after the step, which the solve finds.
        still = wp.zeros(model.particle_count, dtype=wp.vec3, device=self.device)
        self._turned_state: Any = SimpleNamespace(particle_q=self._turned.positions, particle_qd=still)
        self._replays = Replays(self.device, loops=True)
        self._can_replay = False

    def _launch_forces(self, substep: Step, given: newton.State, share: float, done: float) -> None:
        dt, contacts, of_bodies = substep.dt, self.contacts, self._bodies_after(done, substep, given)
        particles, system, unknowns = contacts.particles(substep.state_in), self._system, self._unknowns
        self._turned.launch(particles, dt)
        self.tetrahedra.add_forces(self._turned_state, self._activation, self._f)
        self._operator.take(self._turned.positions, dt)
        system.b.zero_()
        self._operator.add_product(unknowns.way, system.b)
        inputs = [dt, self.damping, particles, self._f, unknowns]
        self._launch(kernels.begin_particles, self.model.particle_count, inputs)
        if self.model.body_count:
            inputs = [dt, contacts.bodies(of_bodies), given.body_f, int(self.others.has_bodies), unknowns]
            self._launch(kernels.begin_bodies, self.model.body_count, inputs)
        if self._rows.begin(substep, of_bodies):
            self._replays.forget()
        self._replays.launch((dt, contacts.law.adhesion), self._launch_solve)
        self._rows.report(substep, share)
        self._launch_reactions(given, share)

    def _launch_solve(self) -> None:
        """Launch the solve for the motions, with contact until the right ones act."""
        system, rows, solve, fall = self._system, self._rows, self._solve, self._unknowns.fall
        self._operator.take_diagonal()
        linear, status = solve.iterations, system.solver.status
        if rows.count:
            rows.update(system.x, is_solved=True)
            solve.launch(fall)
            rows.launch_end(system.x)
            wp.copy(self._rounds, rows.solves, count=1)
        else:
            system.update()
            self._launch(add_scaled, len(system.x), [1.0, fall], [system.x])
            system.solve(guessed=True)
            linear = system.solver.iterations
            self._rounds.fill_(1)
        self._launch(count_solves, 1, [self._rounds, linear, status, int(conjugate_gradients.CONVERGED)], [self.totals])

    def _steps_of_others(self, dt: float) -> int:
        return math.ceil(dt / RIGID_STEP) if self.others.is_own else 1
