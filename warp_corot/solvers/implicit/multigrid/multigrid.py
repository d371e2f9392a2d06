"""Geometric multigrid on the bisection tree: a symmetric V-cycle with Galerkin matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, Discretized, discretization_of
from warp_corot.discretization.groups import Members
from warp_corot.discretization.levels import Levels
from warp_corot.discretization.plan import Batch
from warp_corot.errors import InputError
from warp_corot.kernels.implicit.multigrid import pattern, values
from warp_corot.kernels.implicit.multigrid import springs as kernels
from warp_corot.solvers.implicit.operator import Springs
from warp_corot.solvers.implicit.tangent import TangentOperator

from .level import DenseInverse, LeafMatrix, Level, SmoothedLevel, SweptLevel
from .pattern import Midpoints, Pattern, PatternFinder
from .subtrees import SubtreeLevel, suitable_batches


class SpringsOnLevels:
    """The springs that come and go while the matrices of multigrid stay.

    Args:
        multigrid: The cycle, with its present levels.
        springs: Where springs may be.
        rank: The rank of each node number, int32.
        ends: The ends of each node by rank, vec2i.
    """

    def __init__(self, multigrid: Multigrid, springs: Springs, rank: wp.array, ends: wp.array):
        self.device, self._count, self._stiffness = multigrid.device, len(springs.nodes), springs.stiffness
        self._kept = wp.zeros(self._count, dtype=wp.mat33, device=self.device)
        sizes = [multigrid.discretization.sizes.world_nodes, multigrid.count]
        self._levels = [self._level(level, springs, sizes, rank, ends) for level in multigrid.levels]

    def keep_plain(self) -> None:
        """Launch the record of matrices without springs, after these were computed."""
        self._kept.zero_()
        for level, _rows, matrix in self._levels:
            if isinstance(level, Level):
                wp.copy(matrix.plain_blocks, level.blocks)
            wp.copy(matrix.plain_inverses, level.inverses)
            matrix.added.zero_()

    def take(self) -> None:
        """Launch the exchange of the springs in the matrices for the present ones."""
        for _level, rows, matrix in self._levels:
            self._launch(kernels.remove_springs, [self._kept, rows, matrix])
        wp.copy(self._kept, self._stiffness)
        for _level, rows, matrix in self._levels:
            self._launch(kernels.add_springs, [self._kept, rows, matrix])
            self._launch(kernels.invert_with_springs, [self._kept, rows, matrix])

    def _level(
        self, level: SmoothedLevel, springs: Springs, sizes: list[int], rank: wp.array, ends: wp.array
    ) -> tuple[SmoothedLevel, kernels.SpringRows, kernels.LevelMatrix]:
        has_matrix, device = isinstance(level, Level), self.device
        rows, matrix = kernels.SpringRows(), kernels.LevelMatrix()
        rows.nodes = wp.zeros(self._count, dtype=wp.vec4i, device=device)
        rows.weights = wp.zeros(self._count, dtype=wp.vec4, device=device)
        rows.entries = wp.zeros((self._count, 16 if has_matrix else 0), dtype=wp.int32, device=device)
        inputs: list[Any] = [*sizes, level.count, springs.nodes, springs.weights, rank, ends]
        self._launch(kernels.find_spring_nodes, [*inputs, rows])
        matrix.inverses, matrix.plain_inverses = level.inverses, wp.zeros_like(level.inverses)
        matrix.added = wp.zeros_like(level.inverses)
        if isinstance(level, Level):
            pattern = level.pattern
            matrix.blocks, matrix.plain_blocks = level.blocks, wp.zeros_like(level.blocks)
            inputs = [level.count, pattern.entries, pattern.starts, pattern.columns, rows]
            self._launch(kernels.find_spring_entries, inputs)
        return level, rows, matrix

    def _launch(self, kernel: wp.Kernel, inputs: list[Any]) -> None:
        wp.launch(kernel, self._count, inputs, device=self.device)


#: The largest coarsest level that is inverted [nodes].
MOST_DENSE = 64
#: The increase of the degree from a level to the next coarser one, which costs little.
RISE = 2
#: By how much degrees are smaller if the second level has more than half as many nodes as the finest one.
STEPS_LESS = 2
#: By how much the degree on the finest level is larger if the level of the roots of subtrees does not smooth.
STEPS_MORE = 2
#: The smoother's degree or sweeps on a coarsest level that is not inverted, for example of a grid of many cubes.
COARSEST_DEGREE, COARSEST_SWEEPS = 24, 8


@dataclass(frozen=True, eq=False)
class Transfer:
    """Transfers between a level and the next coarser one."""

    fine: SmoothedLevel
    coarse: Level
    midpoints: Midpoints


class Multigrid:
    """A preconditioner: one V-cycle over the levels of a forest, for a body's stiffness and mass.

    The finest level's matrix is that of the elements with the present rotations held fixed, R K R^T (or linear
    elasticity), with the mass; every coarser one is P^T A P with linear interpolation P. Held nodes are left out on
    every level. So the cycle is linear, symmetric and positive definite.

    Args:
        body: A body on a forest, or its discretization.
        is_turned: Whether elements turn; False: linear elasticity.
        degree: The degree of the smoother on the finest level, before and after.
        few_nodes: Levels with more nodes than this get a coarser one, if there is one.
        stiffening: Viscous over elastic stress at one strain [s], as in the operator's D.
        most_lambda: Lambda is at most this many times mu.
        most_shared: The same for groups that share their dilatation.
        members: Returns the groups of elements, among those below a number, that share their dilatation; None: none do.
        sweeps: Number of Gauss-Seidel sweeps that smooth, only on the CPU; zero: Chebyshev's iteration.
        assembled: Whether the finest level has its matrix; False: it goes over subtrees if these are all of the mesh.

    Attributes:
        discretization: The body's discretization.
        revision: Changes whenever its launches do, so that they must be recorded again.

    Raises:
        InputError: The mesh is not a forest, or the degree is not positive.
    """

    def __init__(
        self,
        body: Discretized | Discretization,
        *,
        is_turned: bool = True,
        degree: int = 5,
        few_nodes: int = MOST_DENSE,
        stiffening: float = 0.0,
        most_lambda: float = np.inf,
        most_shared: float = np.inf,
        members: Callable[[int], Members] | None = None,
        sweeps: int = 0,
        assembled: bool = True,
    ):
        if degree < 1:
            raise InputError(f"degree is {degree!r}; it must be 1 or more")
        self.discretization = discretization_of(body)
        self.is_turned, self.degree, self.stiffening = is_turned, degree, stiffening
        self.most_shared = min(most_shared, 1e30)
        self.most_lambda, self.few_nodes = most_lambda, few_nodes
        self._find_members = members
        self.sweeps, self._assembled = sweeps, assembled
        self.revision, self._version = -1, -1
        self._springs: SpringsOnLevels | None = None
        self.follow()

    @property
    def device(self) -> wp.Device:
        return self.discretization.device

    def follow(self) -> bool:
        """Follow the mesh, if it has changed; returns whether launches have changed. Waits for the device."""
        if self._version == self.discretization.sizes.version:
            return False
        self._version = self.discretization.sizes.version
        self._build(self._find_levels())
        self.revision += 1
        return True

    def update(self, operator: TangentOperator) -> None:
        """Launch the computation of all matrices at the operator's displacements and scales."""
        self.update_finest(operator)
        self._update_coarser()

    def update_finest(self, operator: TangentOperator) -> None:
        """Launch the computation of the finest level's matrix."""
        finest, inverse_mass = self.levels[0], operator.inverse_mass
        free_inputs = [self.count, self._mesh_nodes, self._nodes, inverse_mass]
        finest.launch(values.find_free, self.count, free_inputs, [self._free])
        if isinstance(finest, SubtreeLevel):
            finest.update(operator, self._mesh_nodes, self._nodes)
        else:
            assert isinstance(finest, Level)
            self._leaves.gather(
                operator,
                finest.blocks,
                finest.inverses,
                stiffening=self.stiffening,
                most_lambda=self.most_lambda,
                most_shared=self.most_shared,
            )

    def _update_coarser(self) -> None:
        for transfer in self._transfers:
            transfer.fine.gather_into(transfer.coarse, transfer.midpoints)
        if self._coarsest is not None:
            self._coarsest.update()
        if self._springs is not None:
            self._springs.keep_plain()

    def follow_springs(self, springs: Springs) -> None:
        """Make room for springs on the present levels; not while launches are recorded. An ``update`` must follow."""
        self._springs = SpringsOnLevels(self, springs, self._rank, self._ends)

    def take_springs(self) -> None:
        """Launch the exchange of the springs in all matrices for the present ones."""
        assert self._springs is not None
        self._springs.take()
        if self._coarsest is not None:
            self._coarsest.update()

    def apply(self, r: wp.array, z: wp.array) -> None:
        """Launch z = B r, one cycle from zero; both vec4 [worlds * nodes]."""
        self.take_in(r)
        for transfer in self._transfers:
            transfer.fine.smooth_before()
            transfer.coarse.restrict_from(transfer.fine, transfer.midpoints)
        if self._coarsest is None:
            self.levels[-1].smooth_before()
        else:
            self._coarsest.solve()
        for transfer in reversed(self._transfers):
            transfer.fine.take_correction(transfer.coarse, self._ends)
            transfer.fine.smooth_after()
        self.hand_out(r, z)

    def take_in(self, r: wp.array) -> None:
        """Launch the finest level's residual and first step from r."""
        self.levels[0].take_in(self._mesh_nodes, self._nodes, r)

    def hand_out(self, r: wp.array, z: wp.array) -> None:
        """Launch z from the finest level's correction; held nodes keep their r."""
        self.levels[0].hand_out(self._mesh_nodes, self._nodes, r, z)

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _find_levels(self) -> Levels:
        return self.discretization.levels()

    def _build(self, levels: Levels) -> None:
        sizes, device = self.discretization.sizes, self.device
        self.count, self._mesh_nodes, self._nodes = levels.node_count, levels.mesh_nodes, levels.nodes
        self._rank = rank = wp.empty(self.count, dtype=wp.int32, device=device)
        wp.launch(pattern.find_ranks, self.count, [levels.nodes], [rank], device=device)
        self._ends = wp.empty(self.count, dtype=wp.vec2i, device=device)
        wp.launch(pattern.rank_ends, self.count, [levels.ends, rank], [self._ends], device=device)
        self._free = wp.zeros(sizes.worlds * self.count, dtype=wp.uint8, device=device)
        self._springs = None
        finder = PatternFinder(self._ends)
        members = self._members = self._find_members and self._find_members(sizes.world_elements)
        batches = self._subtrees(members)
        counts = self._counts(levels, on_roots=batches is not None)
        self._degrees = self._find_degrees(counts, None if batches is None else levels.depth - 3)
        if batches is None:
            # Sweeps need no bound on eigenvalues.
            bounded = members is not None and not self.sweeps
            given = [self.discretization, finder, self._nodes, rank, self._mesh_nodes, self._free, members]
            self._leaves = LeafMatrix(*given, is_turned=self.is_turned, is_bounded=bounded)
            fine: SmoothedLevel = self._level(self._leaves.pattern, counts)
        else:
            fine = SubtreeLevel(self, batches, rank, self._free, self._degrees[0], members)
        self.levels, self._transfers = [fine], []
        for count in counts[1:]:
            coarse = self._level(fine.coarser_pattern(finder, count), counts)
            self._transfers.append(Transfer(fine, coarse, finder.midpoints(count, fine.count)))
            self.levels.append(fine := coarse)
        self._coarsest = DenseInverse(cast("Level", fine)) if counts[-1] <= MOST_DENSE else None

    def _subtrees(self, members: Members | None) -> tuple[Batch, ...] | None:
        """The subtrees of which the finest level consists, if it goes without its matrix."""
        if self._assembled or self.sweeps or self.count <= self.few_nodes:
            return None
        batches = suitable_batches(self.discretization)
        if members is not None and members.count != sum(batch.count for batch in batches or ()):
            return None
        return batches

    def _level(self, found: Pattern, counts: list[int]) -> Level:
        """A level with its smoother; the coarsest one's is only used where it is not inverted."""
        k = counts.index(found.count)
        worlds, ranks = self.discretization.worlds, self.count
        if self.sweeps:
            sweeps = COARSEST_SWEEPS if k == len(counts) - 1 else self.sweeps
            return SweptLevel(found, worlds, ranks, self._free, sweeps)
        is_bounded = k > 0 and self._members is not None
        return Level(found, worlds, ranks, self._free, self._degrees[k], is_bounded)

    def _find_degrees(self, counts: list[int], roots_depth: int | None) -> list[int]:
        """The degree of each level's smoother. ``roots_depth`` is the level of the roots of subtrees, if the finest
        level goes over these."""
        degrees = [self.degree + RISE * k for k in range(len(counts))]
        if roots_depth is not None and roots_depth % 3:
            # Steps on the finest level are cheap there, and take the place of those on the level of roots.
            coarser = degrees[1:-1] if self._members is None else degrees[2:]
            degrees = [self.degree + STEPS_MORE, 0, *coarser]
        elif roots_depth is None and len(counts) > 1 and 2 * counts[1] > counts[0] and self._members is None:
            # A level that is hardly coarser helps the finest one, unless that has couplings of its own.
            degrees = [max(degree - STEPS_LESS, 1) for degree in degrees]
        degrees[-1] = COARSEST_DEGREE
        return degrees

    def _counts(self, levels: Levels, *, on_roots: bool) -> list[int]:
        """Numbers of nodes of the levels that the cycle has, finest first."""
        counts, level = [levels.node_count], levels.depth
        while level > 0 and counts[-1] > self.few_nodes:
            # Coarser levels are multiples of three: with others conjugate gradients take 10 iterations in place of 6.
            stride = 3 if on_roots and len(counts) == 1 else level % 3 or 3
            level = max(level - stride, 0)
            counts.append(levels.starts[level + 1])
        return counts
