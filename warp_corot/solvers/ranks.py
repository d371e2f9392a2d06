"""The other processes, each with a part of the same bodies, that make the same steps; alone there are none."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody
    from warp_corot.kernels.stepping.pace import Pace


Floats = npt.NDArray[np.float64]


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
        """Launch that ghosts of the k-th body get their values, in a nodal array vec4."""

    def begin_completion(self, k: int, vectors: wp.array) -> None:
        """The same, but launches may go on before; ``end_completion`` must follow before any but forces read ghosts."""

    def end_completion(self) -> None:
        """Launch that everything that follows waits for what ``begin_completion`` has begun."""

    def completed(self, k: int, vectors: wp.array) -> wp.array:
        """The same in another array, if there are ghosts; the array itself stays as it is."""
        return vectors

    def take_most(self, values: wp.array) -> None:
        """Launch that an array holds the largest values of all ranks, in place."""

    def agree_on_changes(self, changed: wp.array, clock: Pace) -> None:
        """Launch that all ranks know whether the state has changed on any; after ``Copies.launch_take_over``."""

    def leave_own(self, k: int, energies: wp.array) -> None:
        """Launch that energies of elements that other ranks count are zero."""

    def number_directions(self, k: int, directions: wp.array) -> None:
        """Give every node of the k-th body, in a nodal array vec4, a direction that does not depend on how many ranks
        there are."""

    def number_motion(self, k: int, inverse_mass: wp.array, motion: wp.array) -> None:
        """The same with normally distributed numbers at free nodes, zero at others."""

    def add_up(self, parts: wp.array, sums: wp.array) -> None:
        """Let an array, whose sum is that of this rank's parts, have the sum over all ranks; both float64.

        Args:
            parts: Addends of this rank; if sums are settled, one for each node.
            sums: Their sums.
        """

    # --- implicit steps --------------------------------------------------------------------------------------------

    def take_in_parts(self, parts: wp.array, columns: Sequence[int], most: bool) -> None:
        """Let columns of parts of sums, float64 [worlds, parts, columns], be those of all ranks: what they add up to,
        or the largest."""

    def clear_ghosts(self, k: int, vectors: wp.array) -> None:
        """Launch that a nodal array of the k-th body, vec4, is zero at ghosts."""

    # --- contact ---------------------------------------------------------------------------------------------------

    def take_surface(self, nodes: wp.array, places: Sequence[slice]) -> None:
        """Take the surfaces of the bodies, on which the following act.

        Args:
            nodes: The node of its body at each place, in all worlds, int32; -1 at places that are not in use.
            places: Those of each body.
        """

    def complete_surface(self, values: wp.array) -> None:
        """Launch that places of ghosts get their values, in an array of float32 or vec3 over the surface's places."""

    def completed_yielding(self, yielding: wp.array) -> wp.array:
        """How surface nodes yield, also ghosts, which are held here; in another array, if there are ghosts."""
        return yielding

    def clear_surface(self, forces: wp.array) -> None:
        """Launch that forces on ghosts are zero, vec3 over the surface's places: their ranks have them."""

    def add_up_wrenches(self, parts: wp.array) -> None:
        """Launch that parts of wrenches on obstacles are those of all ranks, in place."""

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
            totals: Those of this rank.
            addends: What they are sums of [worlds, n, COLUMNS]; only if sums are settled.
        """
        return totals

    def whole(self, body: SoftBody) -> SoftBody:
        """The body, as far as this rank holds it, of which another is this rank's part."""
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
