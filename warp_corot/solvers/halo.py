"""What steps ask of the other processes ("ranks"), which hold the other parts of the bodies; alone there are none."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt
import warp as wp

if TYPE_CHECKING:
    from warp_corot.body.soft_body import SoftBody

Floats = npt.NDArray[np.float64]
V = TypeVar("V", float, int, npt.NDArray[Any], wp.array)


class Owned:
    """What of a body this process moves and counts: all of it, if it is alone.

    Attributes:
        whole: The body to which this part belongs, as far as this process holds it.
        numbers: The numbers of the nodes among those of all worlds of the whole mesh, int64 [worlds * n]; None: alone.
        node_count: The number of nodes of all worlds of the whole mesh.
        places: The places of the nodes in ``whole``, in all worlds, int32 [worlds * n].
        nodes: Whether this process moves each node, bool [worlds * n].
        has_multigrid: Whether multigrid can precondition solves.
        multigrid: Makes the multigrid cycle over all ranks from the options of ``Multigrid``; None: alone.
    """

    numbers: npt.NDArray[np.int64] | None = None
    node_count: int
    places: npt.NDArray[np.int32]
    nodes: npt.NDArray[np.bool_]
    has_multigrid = True
    multigrid: Callable[[dict[str, Any]], Any] | None = None

    def __init__(self, body: SoftBody):
        self.whole = body

    def clear_ghosts(self, vectors: wp.array) -> None:
        """Launch the reset to zero of a nodal array, vec4, at nodes that other ranks move."""

    def clear_copies(self, energies: wp.array) -> None:
        """Launch the reset to zero of the energies of elements that other ranks count."""

    @property
    def counted(self) -> wp.array:
        """Which elements it counts, int32 [worlds * T], nonzero; empty: all."""
        return wp.empty(0, dtype=wp.int32, device=self.whole.device)

    @property
    def bounds(self) -> Floats:
        """The lowest and the highest rest coordinates of the whole body [m], float64 [2, 3]."""
        points = self.whole.mesh.points
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def bulk(self) -> tuple[float, float]:
        """The mean of 2 mu + lambda over the elements of the whole body [Pa], and its volume [m^3]."""
        found = self.whole.discretization
        stiffness = 2.0 * float(found.mu.numpy().mean()) + float(found.lam.numpy().mean())
        return stiffness, float(np.sum(self.whole.mesh.volumes))


class Halo:
    """The exchange with the ranks that hold the other parts of the bodies.

    This is that of a process that holds everything: nothing is launched, and every number is what it was.
    ``warp_corot.distributed`` has another one, whose methods all ranks must call in the same order.

    Every node is moved by one rank. Where other ranks need its displacement they hold a *ghost* of it, a node without
    mass that never moves by itself.
    """

    is_alone = True
    #: Whether sums must be the same bit by bit for any number of ranks.
    is_reproducible = False

    def owned(self, body: SoftBody) -> Owned:
        """What of a body this rank moves and counts."""
        return Owned(body)

    def exchange(self, k: int, vectors: wp.array, *, copies: bool = False, overlaps: bool = False) -> wp.array:
        """Launch the exchange that gives the ghosts of the k-th body their values in a nodal array, vec4; returns it.

        Args:
            k: The number of the body.
            vectors: The array.
            copies: Whether the array stays as it is, and a copy with the values is returned if there are ghosts.
            overlaps: Whether other launches may follow meanwhile; ``wait`` must be called before anything but elastic
                forces reads ghosts.
        """
        return vectors

    def wait(self) -> None:
        """Launch a wait for the exchange that overlaps with other launches: later ones come after it."""

    def connect(self, numbers: npt.NDArray[np.integer], own: npt.NDArray[np.bool_]) -> Callable[[wp.array], None]:
        """Make another exchange, between places of arrays that have the same number; it launches for an array of
        float32, vec3 or vec4.

        Args:
            numbers: A number for each place [n].
            own: The places whose values this rank gives to others, bool [n]; no other rank gives those of their number.
                Places whose number no rank gives stay as they are.
        """
        return lambda values: None

    def max(self, value: V) -> V:
        """The largest value of all ranks, entry by entry; of an array on a device by a launch, in place."""
        return value

    def sum(self, value: V, addends: npt.NDArray[np.float64] | None = None) -> V:
        """The sum over all ranks, entry by entry; of an array on a device by a launch, in place.

        Args:
            value: This rank's sums.
            addends: Their addends [n, ...] of a host's array or number; given only if sums are reproducible.
        """
        return value


#: A process that holds everything.
ALONE = Halo()
