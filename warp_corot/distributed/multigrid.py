"""Multigrid on several ranks: the finest level in parts, and the coarser ones on every rank.

Every rank holds the pattern of the whole hierarchy. It computes its own nodes' rows of the finest matrix, smooths these
and needs other ranks' nodes before each product. All ranks get the whole matrix of the finest level after a set-up and
its whole residual in each cycle, and then do the same with the coarser levels. So the number of ranks changes no bit.
"""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.body.soft_body import SoftBody
from warp_corot.discretization.groups import Members
from warp_corot.kernels.distributed.multigrid import add_correction
from warp_corot.kernels.implicit.multigrid import values
from warp_corot.mesh import TetForest
from warp_corot.solvers.implicit.multigrid import Multigrid
from warp_corot.solvers.implicit.multigrid.level import Level, SmoothedLevel
from warp_corot.solvers.implicit.multigrid.multigrid import MOST_DENSE
from warp_corot.solvers.implicit.preconditioners import Seen
from warp_corot.solvers.implicit.tangent import TangentOperator

from .divided_mesh import DividedMesh
from .exchange import ExchangeLists, Places, in_worlds
from .part import Part
from .partition import sharing_groups

if TYPE_CHECKING:
    from .halo import MpiHalo

Ints = npt.NDArray[np.int32]
Complete = Callable[[wp.array], None]

#: The tags of messages, after those of bodies and their surfaces.
TAGS = 1000


class HaloLevel(Level):
    """The finest level of a part. Rows of nodes that other ranks move are incomplete, and their values are replaced."""

    def __init__(self, *given: Any, complete: Complete):
        super().__init__(*given)
        self._complete = complete

    def find_residual(self) -> None:
        self._complete(self.z)
        super().find_residual()

    def _make_step(self, step: int, *, is_first: bool) -> None:
        self._complete(self.z)
        super()._make_step(step, is_first=is_first)


class FinestPart(Multigrid):
    """The finest level of a part, without coarser ones.

    Args:
        part: The part.
        nodes: Its nodes in the order of their ranks in the whole hierarchy, int32 [n].
        complete: Gives the level's vectors the values of other ranks' nodes.
        options: As for ``Multigrid``.
    """

    def __init__(self, part: Part, nodes: Ints, complete: Complete, **options: Any):
        self._order, self._complete = nodes, complete
        super().__init__(part, **options)
        self._coarsest = None

    def _find_levels(self) -> Any:
        count, device = len(self._order), self.device
        nodes = wp.array(self._order, dtype=wp.int32, device=device)
        ends = wp.full(count, wp.vec2i(-1, -1), dtype=wp.vec2i, device=device)
        return SimpleNamespace(node_count=count, mesh_nodes=count, nodes=nodes, ends=ends, depth=0, starts=(0, count))

    def _level(self, found: Any, counts: list[int]) -> Level:
        worlds = self.discretization.worlds
        return HaloLevel(found, worlds, self.count, self._free, self.degree, complete=self._complete)


class GatheredLevel(Level):
    """The finest level of the whole mesh, of which each rank smooths its part."""

    here: HaloLevel

    def connect(
        self, here: HaloLevel, ends: wp.array, rows: Places, entries: Places, everywhere: Complete, matrix: Complete
    ) -> None:
        """Take this rank's part.

        Args:
            here: The part's level.
            ends: The coarser nodes between which each node of the part is, vec2i [n].
            rows, entries: The places of own nodes, and of entries of the matrix in their rows.
            everywhere, matrix: Exchanges after which every rank has all of a vector, or of the matrix.
        """
        self.here, self._ends, self._everywhere, self._matrix = here, ends, everywhere, matrix
        self._own_rows, self._own_entries = rows, entries
        shape = 3 * len(self.blocks)
        self._columns = wp.array(ptr=self.blocks.ptr, dtype=wp.vec3, shape=shape, device=self.device)

    def gather_blocks(self) -> None:
        """Launch the copy of all ranks' rows into the whole matrix."""
        self._own_entries.to_whole(self.here.blocks, self.blocks)
        self._matrix(self._columns)

    def smooth_before(self) -> None:
        self.here.smooth_before()

    def smooth_after(self) -> None:
        self.here.smooth_after()

    def find_residual(self) -> None:
        self.here.find_residual()
        self._own_rows.to_whole(self.here.other, self.other)
        self._everywhere(self.other)

    def take_correction(self, coarse: SmoothedLevel, ends: wp.array) -> None:
        inputs = [coarse.count, self.here.count, self.here.free, self._ends, coarse.z]
        self.here.launch(add_correction, self.here.count, inputs, [self.here.z])


class MultigridOfParts(Multigrid):
    """A cycle over a body whose parts several ranks hold; all ranks must call its methods.

    Args:
        ranks: The ranks.
        k: The number of the body.
        part: This rank's part.
        degree: The degree of the smoother on the finest level.
        members: As for ``Multigrid``, of the part's elements.
        options: As for ``Multigrid``, whose sweeps smooth only the coarser levels.
    """

    def __init__(
        self,
        ranks: MpiHalo,
        k: int,
        part: Part,
        *,
        degree: int,
        members: Callable[[int], Members] | None = None,
        **options: Any,
    ):
        self._ranks, self._k, self._part = ranks, k, part
        self._options = options | {"degree": degree, "sweeps": 0, "members": members}
        everywhere = None if members is None else self._members_everywhere
        super().__init__(ranks.owned(part).whole, degree=degree, members=everywhere, **options)

    def update_finest(self, operator: TangentOperator) -> None:
        ranks, k = self._ranks, self._k
        wp.copy(self._inverse_mass, operator.inverse_mass)
        ranks.exchange(k, self._inverse_mass)
        self._own_nodes.to_whole(self._inverse_mass, self._everywhere_mass)
        self._everywhere(self._everywhere_mass)
        inputs = [self.count, self.count, self._numbers, self._everywhere_mass]
        self.levels[0].launch(values.find_free, self.count, inputs, [self._free])
        u = ranks.exchange(k, operator.displacements, copies=True)
        self._here.update_finest(Seen(operator, inverse_mass=self._inverse_mass, displacements=u))  # type: ignore[arg-type]
        self._finest.gather_blocks()

    def take_in(self, r: wp.array) -> None:
        self._here.take_in(r)

    def hand_out(self, r: wp.array, z: wp.array) -> None:
        self._here.hand_out(r, z)
        self._ranks.owned(self._part).clear_ghosts(z)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _level(self, found: Any, counts: list[int]) -> Level:
        if found.count < counts[0]:
            return super()._level(found, counts)
        self._finest = GatheredLevel(found, self.discretization.worlds, self.count, self._free, degree=1)
        return self._finest

    def _members_everywhere(self, below: int) -> Members:
        """The groups of the whole mesh's elements that share their dilatation."""
        whole, own = self._ranks.owned(self._part).whole, self._options["members"]
        numbers = sharing_groups(whole.mesh, True)
        order = np.argsort(numbers, kind="stable")
        sizes = np.unique(numbers, return_counts=True)[1]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        ints = [wp.array(each, dtype=wp.int32, device=self.device) for each in (starts, order, np.zeros(0, np.int32))]
        batch = (ints[0], ints[1], ints[2], len(sizes))
        law = own(self._part.discretization.sizes.world_elements).law
        return Members.of(law, [batch], whole.discretization.elements.nodes, below)

    def _build(self, levels: Any) -> None:
        super()._build(levels)
        part, ranks, tag = self._part, self._ranks, TAGS + self._k
        rank = np.empty(self.count, np.int32)
        rank[self._nodes.numpy()] = np.arange(self.count, dtype=np.int32)
        order = np.argsort(rank[part.numbers.nodes]).astype(np.int32)
        everywhere, owner = rank[part.numbers.nodes[order]], part.numbers.owner[order]
        halo = ExchangeLists.of(everywhere, owner, part.worlds, ranks.comm)
        self._here = FinestPart(part, order, ranks.exchange_of(halo, tag).launch, **self._options)
        own = np.flatnonzero(owner == ranks.comm.rank).astype(np.int32)
        self._connect(everywhere, own)
        count = len(order)
        self._own_nodes = self._places((everywhere[own], self.count), (order[own], count))
        self._inverse_mass = wp.zeros(part.worlds * count, dtype=wp.float32, device=self.device)
        # Nodes of no leaf count as free.
        self._everywhere_mass = wp.ones(part.worlds * self.count, dtype=wp.float32, device=self.device)
        self._numbers = wp.array(np.arange(self.count, dtype=np.int32), dtype=wp.int32, device=self.device)

    def _connect(self, everywhere: Ints, own: Ints) -> None:
        """Give the finest level this rank's part.

        Args:
            everywhere: The ranks of the part's nodes in the whole hierarchy, ascending, int32 [n].
            own: Which of these nodes this rank moves, int32.
        """
        level, whole = self._here.levels[0], self._finest.pattern
        assert isinstance(level, HaloLevel)
        rows = everywhere[own]
        entries = _ranges(whole.starts.numpy(), rows)
        entries_here = _ranges(level.pattern.starts.numpy(), own)
        ends = self._ends.numpy()[everywhere]
        is_coarse = everywhere < self.levels[1].count
        ends[is_coarse] = everywhere[is_coarse, None]
        self._everywhere = self._to_all(rows, self.count)
        # Matrices travel as three vectors each.
        columns = (3 * entries[:, None] + np.arange(3)).ravel().astype(np.int32)
        self._finest.connect(
            level,
            wp.array(ends, dtype=wp.vec2i, device=self.device),
            self._places((rows, self.count), (own, level.count)),
            self._places((entries, whole.entries), (entries_here, level.pattern.entries)),
            self._everywhere,
            self._to_all(columns, 3 * whole.entries, kinds=(wp.vec3,)),
        )

    def _places(self, whole: tuple[Ints, int], here: tuple[Ints, int]) -> Places:
        """Places in one world of a whole array and of one of the part, each with the length of a world."""
        (there, length), (own, own_length) = whole, here
        worlds = self._part.worlds
        return Places(in_worlds(there, worlds, length), in_worlds(own, worlds, own_length), self.device, self.device)

    def _to_all(self, own: Ints, length: int, **options: Any) -> Complete:
        """The exchange after which every rank has all values of an array, [worlds * length].

        Args:
            own: The places of this rank's values in one world.
            length: The number of values of a world.
            options: As for ``MpiHalo.exchange_of``.
        """
        ranks = self._ranks
        halo = ExchangeLists.to_all(in_worlds(own, self._part.worlds, length), ranks.comm)
        return ranks.exchange_of(halo, TAGS + self._k, **options).launch


def has_multigrid(whole: SoftBody, part: Part) -> bool:
    """Whether multigrid can precondition the solves of a body, given this rank's part of it: every rank holds the whole
    forest on the same device, and it has enough nodes for two levels."""
    mesh = whole.mesh
    is_whole = isinstance(mesh, TetForest) and not isinstance(mesh, DividedMesh)
    return is_whole and whole.device == part.device and whole.world_node_count > MOST_DENSE


def _ranges(starts: Ints, rows: Ints) -> Ints:
    """The places of the entries of some rows, one row after another."""
    sizes = starts[rows + 1] - starts[rows]
    first = np.cumsum(sizes) - sizes
    return (np.repeat(starts[rows] - first, sizes) + np.arange(sizes.sum())).astype(np.int32)
