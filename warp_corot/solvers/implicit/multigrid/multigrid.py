"""Geometric multigrid on the bisection tree: a symmetric V-cycle with Galerkin matrices."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization, Discretized, discretization_of
from warp_corot.discretization.levels import Levels
from warp_corot.discretization.members import Members
from warp_corot.errors import InputError
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.implicit.multigrid import cycle, pattern, shared, values
from warp_corot.kernels.tables.shapes import GRADIENT
from warp_corot.solvers.implicit.operator import LinearOperator

from .coarsest import DenseInverse
from .level import Level
from .pattern import Midpoints, Pattern, PatternFinder
from .swept import SweptLevel

#: The largest coarsest level that is inverted [nodes].
MOST_DENSE = 64
#: By how much degrees are smaller if the second level has more than half as many nodes as the finest one.
STEPS_LESS = 2
#: The smoother's degree or sweeps on a coarsest level that is not inverted, for example of a grid of many cubes.
COARSEST_DEGREE, COARSEST_SWEEPS = 24, 8


@dataclass(frozen=True, eq=False)
class Transfer:
    """Transfers between a level and the next coarser one."""

    fine: Level
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
        stride: Number of bisections from one level to the next, 1 to 3.
        degree: The degree of the smoother on the finest level, before and after.
        rise: The increase of the degree from a level to the next coarser one, which costs little.
        few_nodes: Levels with more nodes than this get a coarser one, if there is one.
        stiffening: Viscous over elastic stress at one strain [s], as in the operator's D.
        most_lambda: Lambda is at most this many times mu.
        members: Returns the groups of elements, among those below a number, that share their dilatation; None: none do.
        half: Whether the cycle uses matrices in half precision; only where lambda is less than some 64 times mu.
        sweeps: Number of Gauss-Seidel sweeps that smooth, only on the CPU; zero: Chebyshev's iteration.

    Attributes:
        discretization: The body's discretization.
        revision: Changes whenever its launches do, so that they must be recorded again.

    Raises:
        InputError: The mesh is not a forest, or a stride or degree is out of its range.
    """

    def __init__(
        self,
        body: Discretized | Discretization,
        *,
        is_turned: bool = True,
        stride: int = 3,
        degree: int = 5,
        rise: int = 2,
        few_nodes: int = MOST_DENSE,
        stiffening: float = 0.0,
        most_lambda: float = np.inf,
        members: Callable[[int], Members] | None = None,
        half: bool = False,
        sweeps: int = 0,
    ):
        if stride not in (1, 2, 3):
            raise InputError(f"stride is {stride!r}; it must be 1, 2 or 3")
        if degree < 1:
            raise InputError(f"degree is {degree!r}; it must be 1 or more")
        self.discretization = discretization_of(body)
        self.is_turned, self.stride, self.degree, self.stiffening = is_turned, stride, degree, stiffening
        self.most_lambda, self.rise, self.few_nodes = most_lambda, rise, few_nodes
        self._find_members = members
        self._is_half, self.sweeps = half, sweeps
        self.revision, self._version = -1, -1
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

    def update(self, operator: LinearOperator) -> None:
        """Launch the computation of all matrices at the operator's displacements and scales."""
        self.update_finest(operator)
        self._update_coarser()

    def update_finest(self, operator: LinearOperator) -> None:
        """Launch the computation of the finest level's matrix."""
        discretization, finest = self.discretization, self.levels[0]
        elements = cast("ForestElements", discretization.elements)
        inverse_mass, scales = operator.inverse_mass, operator.scales
        free_inputs = [self.count, self._mesh_nodes, self._nodes, inverse_mass]
        finest.launch(values.find_free, self.count, free_inputs, [self._free])
        kernel = values.write_frames(self.is_turned)
        leaves = discretization.sizes.elements
        inputs: list[Any] = [elements, operator.displacements]
        wp.launch(kernel, dim=leaves, inputs=inputs, outputs=[self._frames], device=self.device)
        found = finest.pattern
        if self._members is not None:
            inputs = [discretization.sizes.world_elements, self._members.entries, self._members.arrays, elements]
            inputs += [operator.displacements, discretization.lam, discretization.material_stride]
            finest.launch(shared.write_rows(self._members.law), self._members.count, inputs, [self._rows])
        inputs = [discretization.sizes.world_elements, found.entries, elements, self._frames, self._gradients]
        inputs += [discretization.mu, discretization.lam, discretization.material_stride, scales, self.stiffening]
        inputs += [self.most_lambda if self._members is None else 0.0]
        inputs += [found.upper, found.sum_starts, found.codes, found.places, self.count]
        inputs += [0 if self._members is None else self._members.entries, self._pairs, self._rows]
        finest.launch(values.gather_leaves, len(found.upper), inputs, [finest.blocks, self._more])
        inputs = [self.count, self._mesh_nodes, found.entries, self._nodes, inverse_mass, scales, self._free]
        inputs += [found.starts, found.columns, found.diagonal, operator.other_blocks(), self._more]
        finest.launch(values.finish_leaves, self.count, inputs, [finest.blocks, finest.inverses])

    def _update_coarser(self) -> None:
        for transfer in self._transfers:
            transfer.coarse.gather_from(transfer.fine)
        for level in self.levels if self._coarsest is None else self.levels[:-1]:
            level.pack()
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
        finest = self.levels[0]
        inputs = [self.count, self._mesh_nodes, finest.factors[0][0], self._nodes, self._free, finest.inverses, r]
        finest.launch(cycle.take_in, self.count, inputs, [finest.r, finest.z])

    def hand_out(self, r: wp.array, z: wp.array) -> None:
        """Launch z from the finest level's correction; held nodes keep their r."""
        finest = self.levels[0]
        inputs = [self.count, self._mesh_nodes, self._nodes, self._free, r, finest.z]
        finest.launch(cycle.hand_out, self.count, inputs, [z])

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _find_levels(self) -> Levels:
        return self.discretization.levels()

    def _build(self, levels: Levels) -> None:
        sizes, device = self.discretization.sizes, self.device
        self.count, self._mesh_nodes, self._nodes = levels.node_count, levels.mesh_nodes, levels.nodes
        rank = wp.empty(self.count, dtype=wp.int32, device=device)
        wp.launch(pattern.find_ranks, self.count, [levels.nodes], [rank], device=device)
        self._ends = wp.empty(self.count, dtype=wp.vec2i, device=device)
        wp.launch(pattern.rank_ends, self.count, [levels.ends, rank], [self._ends], device=device)
        self._free = wp.zeros(sizes.worlds * self.count, dtype=wp.uint8, device=device)
        self._frames = wp.zeros(sizes.elements, dtype=wp.mat33, device=device)
        weights = np.swapaxes(np.array(GRADIENT), 1, 2).reshape(12, 3)
        self._gradients = wp.array(weights, dtype=wp.vec3, device=device)
        finder = PatternFinder(self._ends)
        elements = cast("ForestElements", self.discretization.elements)
        counts = self._counts(levels)
        members = self._members = self._find_members and self._find_members(sizes.world_elements)
        found, self._pairs = finder.of_leaves(elements.nodes, sizes.world_elements, rank, members)
        rows = 0 if members is None else sizes.worlds * members.entries
        # Sweeps need no bound on eigenvalues.
        nodes = 1 if members is None or self.sweeps else sizes.worlds * self.count
        self._rows = wp.zeros(rows, dtype=wp.vec4, device=device)
        self._more = wp.zeros(nodes, dtype=wp.mat33, device=device)
        self.levels = [self._level(found, counts)]
        self._transfers = []
        for count in counts[1:]:
            fine = self.levels[-1]
            coarse = self._level(finder.of_products(fine.pattern, count), counts)
            self._transfers.append(Transfer(fine, coarse, finder.midpoints(count, fine.count)))
            self.levels.append(coarse)
        self._coarsest = DenseInverse(self.levels[-1]) if counts[-1] <= MOST_DENSE else None

    def _level(self, found: Pattern, counts: list[int]) -> Level:
        """A level with its smoother; the coarsest one's is only used where it is not inverted."""
        k = counts.index(found.count)
        is_coarsest = k == len(counts) - 1
        worlds, ranks = self.discretization.worlds, self.count
        if self.sweeps:
            return SweptLevel(found, worlds, ranks, self._free, COARSEST_SWEEPS if is_coarsest else self.sweeps)
        # A level that is hardly coarser helps the finest one, unless that has couplings of its own.
        less = STEPS_LESS if len(counts) > 1 and 2 * counts[1] > counts[0] and self._members is None else 0
        degree = COARSEST_DEGREE if is_coarsest else max(self.degree + self.rise * k - less, 1)
        is_bounded = k > 0 and self._members is not None
        return Level(found, worlds, ranks, self._free, degree, is_bounded, self._is_half)

    def _counts(self, levels: Levels) -> list[int]:
        """Numbers of nodes of the levels that the cycle has, finest first."""
        counts, level = [levels.node_count], levels.depth
        while level > 0 and counts[-1] > self.few_nodes:
            # Coarser levels are multiples of three: with others conjugate gradients take 10 iterations in place of 6.
            stride = (level % 3 or 3) if self.stride == 3 else self.stride
            level = max(level - stride, 0)
            counts.append(levels.starts[level + 1])
        return counts
