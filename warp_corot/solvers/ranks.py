"""The other processes, each with a part of the same bodies, that make the same steps; alone there are none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.kernels.stepping.pace import Pace
    from warp_corot.solvers.implicit.multigrid import Multigrid


Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]


class Ranks:
    """What steps and checks ask of the processes ("ranks") that hold the other parts of the bodies.

    This is the answer of a process that holds everything: nothing is launched, and every number is what it was.
    ``warp_corot.distributed`` has another one, whose methods all ranks must call in the same order.

    Every node is moved by one rank. Where other ranks need its displacement they hold a *ghost* of it, a node without
    mass that never moves by itself.
    """

    is_alone = True
    #: Whether exchanges can be recorded with the launches around them.
    can_record = True
    #: Whether sums must be the same bit by bit for any number of ranks.
    is_settled = False
    #: Whether this is the rank that prints and writes.
    speaks = True

    # --- launches --------------------------------------------------------------------------------------------------

    def take_graph(self, graph: wp.Graph) -> None:
        """Prepare a graph of steps that was just recorded."""

    def complete(self, k: int, vectors: wp.array) -> None:
        """Launch the exchange that gives the ghosts of the k-th body their values in a nodal array, vec4."""

    def begin_completion(self, k: int, vectors: wp.array) -> None:
        """Begin the same exchange and let other launches follow meanwhile; ``end_completion`` must be called before
        anything but elastic forces reads ghosts."""

    def end_completion(self) -> None:
        """Launch a wait for the exchange that ``begin_completion`` has begun: later launches come after it."""

    def completed(self, k: int, vectors: wp.array) -> wp.array:
        """The array after the same exchange, as a copy if there are ghosts; the array itself stays as it is."""
        return vectors

    def take_most(self, values: wp.array) -> None:
        """Launch the replacement of each value of an array by the largest of all ranks."""

    def agree_on_changes(self, changed: wp.array, clock: Pace) -> None:
        """Launch the exchange after which every rank knows whether the state has changed on any of them; after
        ``Copies.launch_take_over``."""

    def leave_own(self, k: int, energies: wp.array) -> None:
        """Launch the reset to zero of the energies of elements that other ranks count."""

    def number_directions(self, k: int, directions: wp.array) -> None:
        """Give every node of the k-th body, in a nodal array vec4, a direction that does not depend on how many ranks
        there are."""

    def number_motion(self, k: int, inverse_mass: wp.array, motion: wp.array) -> None:
        """The same with normally distributed numbers at free nodes, and zero at others."""

    def add_up(self, parts: wp.array, sums: wp.array) -> None:
        """Launch the replacement of this rank's sums by those over all ranks; both arrays float64.

        Args:
            parts: Addends of this rank; if sums are settled, one for each node.
            sums: Sums of this rank's addends before, of all ranks' after.
        """

    # --- implicit steps --------------------------------------------------------------------------------------------

    def take_in_parts(self, parts: wp.array, columns: Sequence[int], most: bool) -> None:
        """Launch the replacement of columns of partial sums, float64 [worlds, parts, columns], by those of all ranks:
        their sums, or the largest values with ``most``."""

    def has_multigrid(self, k: int) -> bool:
        """Whether multigrid can precondition the solves of the k-th body."""
        return True

    def multigrid(self, k: int, options: dict[str, Any]) -> Multigrid | None:
        """The multigrid cycle of the k-th body over all ranks, with the options of ``Multigrid``; None: this process
        holds all nodes."""
        return None

    def clear_ghosts(self, k: int, vectors: wp.array) -> None:
        """Launch the reset to zero of a nodal array of the k-th body, vec4, at ghosts."""

    # --- contact ---------------------------------------------------------------------------------------------------

    def take_surface(self, nodes: wp.array, places: Sequence[slice]) -> None:
        """Take the surfaces of the bodies, on which the following act.

        Args:
            nodes: The node of its body at each place, in all worlds, int32; -1 at places that are not in use.
            places: The places of each body.
        """

    def take_whole_surface(self, own: Ints, bearers: Ints) -> None:
        """Take the whole surfaces of the bodies, whose places and bearers all ranks number alike.

        Args:
            own: The places of nodes that this rank moves, int32.
            bearers: The bearers that this rank moves, int32.
        """

    def complete_whole_surface(self, of_places: Sequence[wp.array], of_bearers: Sequence[wp.array]) -> None:
        """Launch the exchange that gives every rank the values of all places at nodes, and of all bearers; arrays of
        float32 or vec3."""

    def numbers(self, k: int) -> tuple[Ints, npt.NDArray[np.bool_]]:
        """The number in the k-th whole body of each node that this rank holds, in all worlds, int32; and whether this
        rank moves it."""
        raise NotImplementedError

    def complete_surface(self, values: wp.array) -> None:
        """Launch the exchange that gives ghosts their values in an array over the surface's places, float32 or vec3."""

    def completed_yielding(self, yielding: wp.array) -> wp.array:
        """How surface nodes yield, with the values of ghosts, which this rank holds fixed; a copy if there are
        ghosts."""
        return yielding

    def clear_surface(self, forces: wp.array) -> None:
        """Launch the reset to zero of forces on ghosts, vec3 over the surface's places: their own ranks add them."""

    def add_up_wrenches(self, parts: wp.array) -> None:
        """Launch the replacement of partial wrenches on obstacles by those of all ranks."""

    def counted(self, k: int) -> wp.array | None:
        """Elements of the k-th body that this rank counts, int32 [worlds * T], nonzero; None: all."""
        return None

    # --- numbers ---------------------------------------------------------------------------------------------------

    def most(self, value: float) -> float:
        """The largest value of all ranks."""
        return value

    def least(self, value: int) -> int:
        """The smallest value of all ranks."""
        return value

    def anywhere(self, mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
        """Where any rank has true."""
        return mask

    def together(self, value: float) -> float:
        """The sum over all ranks."""
        return value

    def totals(self, totals: Floats, addends: Floats | None) -> Floats:
        """Sums of the columns of ``kernels.stepping.balance`` over all ranks, float64 [worlds, COLUMNS].

        Args:
            totals: The sums of this rank.
            addends: Their addends [worlds, n, COLUMNS]; given only if sums are settled.
        """
        return totals

    def whole(self, body: SoftBody) -> SoftBody:
        """The body to which this part belongs, as far as this rank holds it."""
        return body

    def bounds(self, body: SoftBody) -> Floats:
        """The lowest and the highest rest coordinates of the whole body [m], float64 [2, 3]."""
        points = body.mesh.points
        return np.stack([points.min(axis=0), points.max(axis=0)])

    def bulk(self, body: SoftBody) -> tuple[float, float]:
        """The mean of 2 mu + lambda over the elements of the whole body [Pa], and its volume [m^3]."""
        stiffness = 2.0 * float(body.discretization.mu.numpy().mean()) + float(body.discretization.lam.numpy().mean())
        return stiffness, float(np.sum(body.mesh.volumes))


#: A process that holds everything.
ALONE = Ranks()
