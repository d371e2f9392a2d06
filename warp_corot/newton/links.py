"""Contacts and attachments of implicit steps; see ``kernels.newton.implicit_rows``."""

from __future__ import annotations

import warp as wp

from warp_corot.kernels.implicit.assembled import Couplings
from warp_corot.kernels.newton import implicit_rows as kernels
from warp_corot.solvers.implicit.operator import Springs

from .arguments import Step
from .contact import Contacts
from .library import newton
from .unknowns import Unknowns

#: Fields of a row.
FIELDS = {"nodes": wp.vec4i, "weights": wp.vec4, "body": wp.int32, "law": wp.vec4, "stiffness": wp.mat33}
FIELDS |= {"most": wp.float32, **dict.fromkeys(("arm", "normal", "gap", "slide", "force"), wp.vec3)}


class RowForces:
    """Forces and stiffness of rows as functions of the motions in a step: an ``ObstacleContact`` of springs only.

    Args:
        model: The model.
        contacts: Its contacts.
        unknowns: The entries of vectors.
        free: Whether an entry is free, float32 [entries].

    Attributes:
        springs: What the preconditioner takes into account.
    """

    #: No node is held.
    nodes = None

    def __init__(self, model: newton.Model, contacts: Contacts, unknowns: Unknowns, free: wp.array):
        self.device, self._contacts, self._unknowns = model.device, contacts, unknowns
        self._no_wrenches = wp.empty(0, dtype=wp.spatial_vectorf, device=self.device)
        self._rows, self._room = kernels.RowSprings(), -1
        self._rows.free = free
        #: Nothing changes besides forces.
        self.changed, self._rows.solves = (wp.zeros(1, dtype=wp.int32, device=self.device) for _ in range(2))
        self._make_room()

    @property
    def solves(self) -> wp.array:
        """Number of linear solves of the last step, int32 [1]."""
        return self._rows.solves

    @property
    def count(self) -> int:
        return self._contacts.count

    def begin(self, step: Step, of_bodies: newton.State) -> bool:
        """Launch the rows of a step from its first state; return whether their arrays are new."""
        contacts, state = self._contacts, step.state_in
        self._law = [step.dt, contacts.law.adhesion]
        is_new = self.count != self._room
        if is_new:
            self._make_room()
        inputs = [step.dt, contacts.law, contacts.rows, contacts.count_loads(state, of_bodies), state.particle_q]
        inputs += [contacts.bodies(of_bodies), self._unknowns.particle, self._unknowns.body]
        self._launch(kernels.begin_springs, inputs, [self._rows])
        return is_new

    def report(self, step: Step, share: float) -> None:
        """Launch the wrenches on bodies [N, N m], and add those of contacts, times ``share``, to the reported ones."""
        contacts = self._contacts
        contacts.reactions.zero_()
        first = 0 if step.contacts is None else step.contacts.rigid_contact_max
        inputs = [self._rows, contacts.contact_count, self._unknowns.owner, share, first]
        reported = self._no_wrenches if step.reported is None else step.reported
        self._launch(kernels.report_rows, inputs, [contacts.reactions, reported])

    def add_blocks(self, blocks: wp.array) -> None:
        self._launch(kernels.add_row_blocks, [self._rows], [blocks])

    # --- as a contact of solves, see ``ObstacleContact`` -------------------------------------------------------------

    def prepare(self) -> None:
        pass

    def launch_begin(self, u: wp.array, d: wp.array, blocks: wp.array) -> None:
        pass

    def launch_imposed(self, d: wp.array) -> None:
        pass

    def launch_drag(self, x: wp.array, y: wp.array) -> None:
        self._launch(kernels.add_row_products, [self._rows, x], [y])

    def launch_friction(self, d: wp.array, r: wp.array) -> None:
        self._update(d, is_solved=False)
        self._launch(kernels.add_row_forces, [self._rows], [r])

    def launch_couplings(self, couplings: Couplings) -> None:
        raise NotImplementedError

    def add_slopes(
        self, d: wp.array, change: wp.array, search: wp.array, slopes: wp.array, *, apart: bool = False
    ) -> None:
        inputs = [*self._law, self._rows, self._unknowns.count, d, change, search]
        self._launch(kernels.add_row_slopes, inputs, [slopes])

    def launch_judgement(self, b: wp.array, q: wp.array, d: wp.array) -> None:
        self._update(d, is_solved=True)

    def launch_going(self, d: wp.array, locates: wp.array, rounds: wp.array, most: int, going: wp.array) -> None:
        wp.copy(self._rows.solves, rounds)

    def launch_end(self, d: wp.array) -> None:
        self._update(d, is_solved=True)

    def launch_meetings(self, met: wp.array, begins: wp.array) -> None:
        pass

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _update(self, d: wp.array, *, is_solved: bool) -> None:
        self._launch(kernels.update_springs, [*self._law, int(is_solved), d], [self._rows])

    def _make_room(self) -> None:
        self._room, rows = self.count, self._rows
        for name, dtype in FIELDS.items():
            setattr(rows, name, wp.zeros(self.count, dtype=dtype, device=self.device))
        self.springs = Springs(rows.nodes, rows.weights, rows.stiffness, update=lambda: None)

    def _launch(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        if self.count:
            wp.launch(kernel, dim=self.count, inputs=inputs, outputs=outputs, device=self.device)
