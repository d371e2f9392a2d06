"""The nodes of one body that obstacles hold in an implicit step; see ``kernels.contact.active``."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from warp_corot.kernels.contact import active as kernels
from warp_corot.kernels.contact import span_places as spans
from warp_corot.kernels.contact.meetings import find_meetings
from warp_corot.kernels.implicit.assembled import Couplings

from .spans import Spans

if TYPE_CHECKING:
    from .contacts import Contacts


class ActiveSet:
    """Contact of a body with obstacles in implicit steps.

    Args:
        contacts: The contact of the system.
        k: The number of the body.
    """

    #: Springs are not in the preconditioner: most contact here holds nodes.
    springs = None

    def __init__(self, contacts: Contacts, k: int):
        assert contacts.rigid is not None
        self._contacts, self._rigid, self._k = contacts, contacts.rigid, k
        self.body, self.device = contacts.system.bodies[k], contacts.device
        self._thickness = contacts.obstacles.shapes.thickness
        self._rounds = wp.zeros(1, dtype=wp.int32, device=self.device)
        #: Whether other nodes are held than in the last round, int32 [1].
        self.changed = wp.zeros(1, dtype=wp.int32, device=self.device)
        #: Obstacles between the nodes; None if there are none, or with ranks.
        self._spans: Spans | None = None
        if contacts.rigid.have_edges and contacts.system.ranks.is_alone:
            pace = contacts.system.pace.arrays
            self._spans = Spans(contacts.rigid, k, self._thickness, contacts.law, pace)
        self._forces = wp.zeros_like(self.body.state.displacements)
        self.prepare()

    def prepare(self) -> None:
        """Update to the present surface; not while launches are recorded."""
        rigid, holding = self._rigid, kernels.Holding()
        holding.kinds, holding.forces = rigid.kinds, rigid.forces
        shape, device = rigid.kinds.shape, self.device
        holding.released = wp.zeros(shape, dtype=wp.int32, device=device)
        holding.normals, holding.multipliers = (wp.zeros(shape, dtype=wp.vec3, device=device) for _ in range(2))
        holding.least, holding.most = (wp.zeros(shape, dtype=wp.float32, device=device) for _ in range(2))
        holding.touched = wp.zeros(shape[1], dtype=wp.int32, device=device)
        holding.stiffness = wp.zeros(shape[1], dtype=wp.float32, device=device)
        holding.projectors, holding.drag = (wp.zeros(shape[1], dtype=wp.mat33, device=device) for _ in range(2))
        holding.given = wp.zeros(shape[1], dtype=wp.vec3, device=device)
        self._holding = holding
        if self._spans is not None:
            self._spans.prepare()

    # --- launches ----------------------------------------------------------------------------------------------------

    def launch_begin(self, u: wp.array, d: wp.array, blocks: wp.array) -> None:
        """Launch the beginning of a step: nodes are held as at the end of the last one.

        Args:
            u: Displacements at the beginning of the step [m], vec4.
            d: A guess [m], vec4.
            blocks: The blocks on the diagonal of the matrix, mat33.
        """
        state, conditions = self.body.state, self.body.conditions
        inputs = [conditions.inverse_mass, state.rest, u, blocks, self._surface, self._holding]
        self._launch(kernels.begin_places, inputs)
        self._rounds.zero_()
        self._find_bounds(d, int(kernels.THOSE_TOUCHED), at_end=False)
        self._hold()
        if self._spans is not None:
            self._spans.launch_begin(blocks, d)
            self._locate(spans.FIRST, d)

    @property
    def nodes(self) -> ActiveSet:
        """Itself: it holds nodes."""
        return self

    def launch_again(self) -> None:
        """Launch the beginning of another linearisation of the same step."""
        self._rounds.zero_()
        self._holding.released.zero_()

    def launch_yielding(self, v: wp.array) -> None:
        """Launch v = S T v, with directions in which friction is stiff made small."""
        self._launch(kernels.leave_yielding, [self._surface, self._holding, v])

    def launch_imposed(self, d: wp.array) -> None:
        """Launch the beginning of a solve: the assignment of the given motion to d in these directions."""
        self._launch(kernels.impose, [self._surface, self._holding, d])
        if self._spans is not None:
            self._locate(spans.AGAIN, d)

    def launch_drag(self, x: wp.array, y: wp.array) -> None:
        """Launch y = S (y + D x) with the drag D of friction and of obstacles between nodes, x in the range of S."""
        if self._spans is not None:
            self._spans.add_products(x, y)
        self._launch(kernels.add_drag, [self._surface, self._holding, x, y])

    def launch_friction(self, d: wp.array, r: wp.array) -> None:
        """Launch r = S (r + friction and forces of obstacles between nodes) for the motion d."""
        if self._spans is not None:
            self._spans.update(d)
            self._spans.add_forces(r)
        motions = self._contacts.obstacles.motions
        self._launch(kernels.add_friction, [motions, self._surface, self._holding, d, r])

    def launch_couplings(self, couplings: Couplings) -> None:
        """Launch the addition of S, D and obstacles between nodes to an assembled matrix."""
        if self._spans is not None:
            self._spans.add_couplings(couplings)
        self._launch(kernels.couple_places, [self._surface, self._holding, couplings])

    @property
    def count(self) -> int:
        """Number of surface places of one world."""
        return self._contacts.surface.parts[self._k].nodes

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: bool = False
    ) -> None:
        """Launch the power of friction along a change; see ``solvers.implicit.conjugate_gradients``. If there is only
        one slope, it is that of all worlds together. With ``apart`` there is one for each place, [worlds * count]."""
        motions = self._contacts.obstacles.motions
        inputs = [int(len(search) == 1), int(apart), motions, self._surface, self._holding, d, change, search]
        self._launch(kernels.add_slopes, [*inputs, slopes])
        if self._spans is not None:
            self._spans.add_slopes(d, change, search, slopes)

    def launch_judgement(self, b: wp.array, q: wp.array, d: wp.array) -> None:
        """Launch the choice of the nodes that are held from now on, and ``changed``.

        Args:
            b: Forces at the beginning of the step without contact [N].
            q: A d [N].
            d: The motion [m].
        """
        contacts = self._contacts
        self.changed.zero_()
        if self._spans is not None:
            wp.copy(self._forces, b)
            self._spans.update(d, is_solved=True)
            self._spans.add_forces(self._forces)
            b = self._forces
        self._find_bounds(d, int(kernels.THOSE_APART), at_end=True)
        inputs = [contacts.obstacles.shapes, contacts.obstacles.motions, contacts.law, self._surface]
        self._launch(kernels.judge_places, [*inputs, b, q, d, self._rounds, self._holding, self.changed])
        wp.launch(kernels.count_round, 1, [self._rounds], device=self.device)
        self._find_bounds(d, int(kernels.THOSE_TOUCHED), at_end=True)
        self._hold()

    def launch_going(self, d: wp.array, locates: wp.array, rounds: wp.array, most: int, going: wp.array) -> None:
        """Launch the decision whether obstacles between nodes are looked for again, and another solve follows for that.

        Args:
            d: The motion [m].
            locates: Whether contacts are to be located again, int32 [1].
            rounds, most: The number of solves in the step, int32 [1], and its maximum.
            going: Whether another solve follows, int32 [1].
        """
        if self._spans is not None:
            self._spans.launch_judgement(d, self.changed, locates, rounds, most, going)

    def launch_end(self, d: wp.array) -> None:
        """Launch the results of contact for users."""
        self._launch(kernels.end_places, [d, self._holding, self._surface, self.body.state.contact_forces])
        if self._spans is not None:
            self._spans.update(d)
            self._spans.launch_end(d)

    def launch_meetings(self, met: wp.array, begins: wp.array) -> None:
        """Launch the test whether contact has changed in the last step, or nodes will meet an obstacle in this one.

        Args:
            met: A number for the obstacles that each node touched when the last step began; then for those that it
                touches now, int32 [worlds * nodes].
            begins: Nonzero afterwards if so, int32 [1].
        """
        state, obstacles, pace = self.body.state, self._contacts.obstacles, self._contacts.system.pace.arrays
        inputs = [self.body.conditions.inverse_mass, state.rest, state.displacements, state.velocities, pace]
        inputs += [obstacles.shapes, obstacles.motions, self._contacts.law, self._surface, self._rigid.kinds]
        self._launch(find_meetings, [*inputs, met, begins])

    # --- pieces ------------------------------------------------------------------------------------------------------

    @property
    def _surface(self) -> object:
        return self._contacts.surface.arrays

    def _find_bounds(self, d: wp.array, which: int, *, at_end: bool) -> None:
        contacts = self._contacts
        obstacles, pace = contacts.obstacles, contacts.system.pace.arrays
        inputs = [int(at_end), which, obstacles.shapes, self._thickness, obstacles.motions, contacts.law, pace]
        self._launch(kernels.find_bounds, [*inputs, self._rounds, self._surface, d, self._holding])

    def _locate(self, which: int, d: wp.array) -> None:
        assert self._spans is not None
        self._spans.launch_located(which, d, self.changed)

    def _hold(self) -> None:
        self._launch(kernels.hold_places, [self._contacts.obstacles.motions, self._surface, self._holding])

    def _launch(self, kernel: wp.Kernel, inputs: list) -> None:
        part = self._contacts.surface.parts[self._k]
        wp.launch(kernel, self._contacts.system.worlds * part.nodes, [part.start, *inputs], device=self.device)
