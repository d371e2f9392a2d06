"""The levels of multigrid: matrices, the vectors of the cycle, smoothers, and the launches from one to the next."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any, cast

import numpy as np
import warp as wp

from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.groups import Members
from warp_corot.elasticity.model import isotropic_material
from warp_corot.inputs.cpu_threads import Regions, launch
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.elements.mean_dilatation_rows import NO_LIMIT, GroupRows, write_rows
from warp_corot.kernels.implicit.multigrid import cycle, dense, values
from warp_corot.kernels.implicit.multigrid import pattern as kernels
from warp_corot.kernels.tables.shapes import GRADIENT
from warp_corot.solvers.implicit.tangent import TangentOperator

from .pattern import Midpoints, Pattern, PatternFinder

#: A bound on the eigenvalues of D^-1 A: every part of A is positive semidefinite and couples four nodes.
LARGEST_EIGENVALUE = 4.0
#: Lanes that share a row of a matrix on CUDA: of levels with more rows than this, and of others. Many rows keep the
#: card busy; a small level takes no longer than its longest sum.
LANES, MOST_LANES = ((100_000, 4), (5_000, 8)), 32
#: Number of threads that share the sum of an entry of a coarser level's matrix on CUDA.
GATHERING_LANES = 8


def smoothing_factors(degree: int) -> list[tuple[float, float]]:
    """The factors of the preconditioned residual, and of the step before, in each step of Chebyshev's iteration.

    The iteration reduces the upper part of the eigenvalues of D^-1 A; with more steps this part is larger. Degree zero
    has none.
    """
    if degree == 0:
        return []
    largest, least = LARGEST_EIGENVALUE, LARGEST_EIGENVALUE / max(2.0 * degree**2, 4.0)
    middle, half = 0.5 * (largest + least), 0.5 * (largest - least)
    factors, rho = [(1.0 / middle, 0.0)], half / middle
    for _ in range(degree - 1):
        following = 1.0 / (2.0 * middle / half - rho)
        factors.append((2.0 * following / half, rho * following))
        rho = following
    return factors


class SmoothedLevel:
    """A level's vectors, and the launches from it to the next coarser one.

    Args:
        count: Number of its nodes, n.
        worlds: Number of worlds.
        ranks: Number of nodes of all levels, M.
        free: Nonzero for free nodes, by rank, uint8 [worlds * M].
        degree: The degree of the smoother; zero: the level does not smooth.

    Attributes:
        inverses: Inverses of the diagonal blocks, mat33 [worlds * n].
        r, z, other: Residual, correction, and a vector to work with, vec4 [worlds * n].
        factors: The factors of the smoother's steps; none: the level only passes its residual on.
        arrays: The arguments of kernels.
    """

    def __init__(self, count: int, worlds: int, ranks: int, free: wp.array, degree: int):
        self.count, self.worlds, self.ranks, self.free, self.device = count, worlds, ranks, free, free.device
        self.inverses = wp.zeros(worlds * count, dtype=wp.mat33, device=self.device)
        self.r, self.z, self.other = (wp.zeros(worlds * count, dtype=wp.vec4, device=self.device) for _ in range(3))
        self.factors = smoothing_factors(degree)
        self.arrays = cycle.LevelArrays()
        self.arrays.count, self.arrays.ranks, self.arrays.free = count, ranks, free
        self.arrays.inverses, self.arrays.r = self.inverses, self.r

    def take_in(self, mesh_nodes: int, nodes: wp.array, given: wp.array) -> None:
        """Launch the finest level's residual, and the smoother's first step.

        Args:
            mesh_nodes: Number of nodes of the mesh.
            nodes: The node number of each rank, int32.
            given: The residual by number, vec4.
        """
        self._move(cycle.TAKE_IN, mesh_nodes, given, alpha=self._first_factor, places=nodes)

    def hand_out(self, mesh_nodes: int, nodes: wp.array, given: wp.array, result: wp.array) -> None:
        """Launch the finest level's correction by number; held nodes have what is given."""
        self._move(cycle.HAND_OUT, mesh_nodes, given, places=nodes, result=result)

    def smooth_before(self) -> None:
        """Smooth from zero; ``z`` already has the first step."""
        self.smooth(1)

    def smooth_after(self) -> None:
        """Smooth ``z`` further, by the transpose of ``smooth_before``."""
        self.smooth()

    def smooth(self, from_step: int = 0) -> None:
        """Continue with ``z`` from a step of the smoother."""
        for step in range(from_step, len(self.factors)):
            self._make_step(step, is_first=step == from_step)

    def _make_step(self, step: int, *, is_first: bool) -> None:
        """Launch a step from ``z`` and, unless it is the first, from ``other`` before it; the result is in ``z``."""
        raise NotImplementedError

    def find_residual(self) -> None:
        """Launch other = r - A z after ``smooth_before``."""
        raise NotImplementedError

    def restrict_from(self, fine: SmoothedLevel, midpoints: Midpoints) -> None:
        """Restrict the finer level's residual, and make the smoother's first step."""
        if fine.factors:
            fine.find_residual()
        residual = fine.other if fine.factors else fine.r
        lists = {"starts": midpoints.starts, "places": midpoints.midpoints}
        self._move(cycle.RESTRICT, fine.count, residual, alpha=self._first_factor, **lists)

    def take_correction(self, coarse: SmoothedLevel, ends: wp.array) -> None:
        """Add the correction of the coarser level to this one's."""
        self._move(cycle.PROLONGATE, coarse.count, coarse.z, ends=ends)

    def coarser_pattern(self, finder: PatternFinder, count: int) -> Pattern:
        """The pattern of the next level, of ``count`` nodes."""
        raise NotImplementedError

    def gather_into(self, coarse: Level, midpoints: Midpoints) -> None:
        """Compute the coarser level's matrix P^T A P."""
        raise NotImplementedError

    @property
    def _first_factor(self) -> float:
        """The factor of the smoother's first step from zero; zero: none is made."""
        return self.factors[0][0] if self.factors else 0.0

    def _move(self, kind: int, count: int, given: wp.array, **others: Any) -> None:
        """Launch a transfer, whose threads share the nodes of each world; on a CPU there is one."""
        transfer, threads = cycle.Transfer(), 1 if self.device.is_cpu else self.count
        known = {"kind": kind, "threads": threads, "count": count, "given": given, "z": self.z}
        for name, value in (known | others).items():
            setattr(transfer, name, value)
        self.launch(cycle.move, threads, [self.arrays, transfer], [])

    def launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel with ``count`` threads for each world."""
        wp.launch(kernel, dim=(self.worlds, count), inputs=inputs, outputs=outputs, device=self.device)


class Level(SmoothedLevel):
    """A level with a matrix.

    Args:
        pattern: The pattern of its matrix.
        worlds, ranks, free, degree: As for every level.
        is_bounded: Whether the bound on the eigenvalues of D^-1 A must be kept by smaller inverses, as where groups of
            more than four nodes share a dilatation.

    Attributes:
        blocks: Values of the entries, transposed, mat33 [worlds * entries + 1].
    """

    def __init__(
        self,
        pattern: Pattern,
        worlds: int,
        ranks: int,
        free: wp.array,
        degree: int,
        is_bounded: bool = False,
    ):
        super().__init__(pattern.count, worlds, ranks, free, degree)
        self.pattern, arrays = pattern, self.arrays
        # One more, since products read past the last.
        self.blocks = wp.zeros(worlds * pattern.entries + 1, dtype=wp.mat33, device=self.device)
        rows = worlds * self.count
        lanes = next((lanes for most, lanes in LANES if rows > most), MOST_LANES)
        arrays.entries, arrays.lanes, arrays.diagonal = pattern.entries, lanes, pattern.diagonal
        if self.device.is_cpu:
            arrays.lanes = 1
        arrays.rows.starts, arrays.rows.columns, arrays.rows.blocks = pattern.starts, pattern.columns, self.blocks
        self._unbounded = wp.zeros_like(self.inverses) if is_bounded else None

    def find_residual(self) -> None:
        self.launch_rows(cycle.find_residual, [self.z], [self.other])

    def _make_step(self, step: int, *, is_first: bool) -> None:
        alpha, beta = self.factors[step]
        self.launch_rows(cycle.smooth, [alpha, beta if step else 0.0, is_first, self.z], [self.other])
        self.z, self.other = self.other, self.z

    def launch_rows(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel with the threads of each row."""
        self.launch(kernel, self.count * self.arrays.lanes, [self.arrays, *inputs], outputs)

    def coarser_pattern(self, finder: PatternFinder, count: int) -> Pattern:
        return finder.of_products(self.pattern, count)

    def gather_into(self, coarse: Level, midpoints: Midpoints) -> None:
        lanes = 1 if self.device.is_cpu else GATHERING_LANES
        coarse.gather(values.gather_products, [lanes, coarse.arrays, coarse.pattern.sums, self.arrays], lanes)

    def gather(self, kernel: wp.Kernel, inputs: list[Any], lanes: int = 1) -> None:
        """Launch a kernel that computes blocks and inverses, with some threads for each entry of the upper triangle."""
        inverses = self.inverses if self._unbounded is None else self._unbounded
        self.launch(kernel, lanes * len(self.pattern.sums.upper), inputs, [inverses])
        if self._unbounded is not None:
            self.launch(kernels.bound_diagonal, self.count, [self.arrays, inverses], [])


class SweptLevel(Level):
    """A level with sweeps in place of Chebyshev's iteration. Smoothing after is the transpose of smoothing before.

    Args:
        pattern, worlds, ranks, free: As for every level.
        sweeps: With one, a sweep forward before and one back after; with more, so many pairs of a sweep forward and one
            back, before and after.
    """

    def __init__(self, pattern: Pattern, worlds: int, ranks: int, free: wp.array, sweeps: int):
        super().__init__(pattern, worlds, ranks, free, degree=1)
        self._is_one = sweeps == 1
        self._ways = [cycle.BACKWARD] if self._is_one else [cycle.FORWARD, cycle.BACKWARD] * sweeps

    def smooth_before(self) -> None:
        self._sweep(cycle.FROM_ZERO, *([] if self._is_one else self._ways[1:]))

    def smooth_after(self) -> None:
        self._sweep(*self._ways)

    def find_residual(self) -> None:
        self._sweep(cycle.RESIDUAL_LEFT if self._is_one else cycle.RESIDUAL)

    @property
    def _first_factor(self) -> float:
        """Zero: sweeps begin by themselves."""
        return 0.0

    def _sweep(self, *kinds: int) -> None:
        for kind in kinds:
            inputs = [kind, self.arrays, self.z, self.other]
            wp.launch(cycle.sweep, self.worlds, inputs, device=self.device)


class DenseInverse:
    """The inverse of a level's matrix, float32 [worlds, 3 n, 3 n]."""

    def __init__(self, level: Level):
        self.level = level
        size, worlds, device = 3 * level.count, level.worlds, level.device
        self._matrix = wp.zeros((worlds, size, size), dtype=wp.float64, device=device)
        self._scale, self._rows = (wp.zeros((worlds, size), dtype=wp.float64, device=device) for _ in range(2))
        self.inverse = wp.zeros((worlds, size, size), dtype=wp.float32, device=device)

    def update(self) -> None:
        """Launch the inversion of the present matrix."""
        level = self.level
        self._matrix.zero_()
        level.launch_rows(dense.fill_dense, [], [self._matrix, self._scale])
        if level.device.is_cuda:
            kernel, block = dense.invert_in_registers, dense.SWEEPERS
            wp.launch(kernel, level.worlds * block, [self._matrix], device=level.device, block_dim=block)
        else:
            wp.launch(dense.invert_dense, level.worlds, [self._matrix, self._rows], device=level.device)
        shape = self.inverse.shape
        inputs = [self._matrix, self._scale]
        wp.launch(dense.store_inverse, dim=shape, inputs=inputs, outputs=[self.inverse], device=level.device)

    def solve(self) -> None:
        """Launch z = inverse r."""
        self.level.launch_rows(dense.apply_dense, [self.inverse], [self.level.z])


class LeafMatrix:
    """What the matrix is computed from, and the launches that compute it.

    Args:
        discretization: The mesh and the material.
        finder: Finds the pattern.
        nodes: The number of each row's node, int32 [rows].
        rank: The row of each node number, int32.
        mesh_nodes: Number of nodes of the mesh.
        free: Nonzero for free nodes, by row, uint8 [worlds * rows].
        members: The groups of elements that share their dilatation, or None.
        is_turned: Whether elements turn; False: linear elasticity.
        is_bounded: Whether the inverses of diagonal blocks keep the bound of ``kernels.implicit.multigrid.pattern``.

    Attributes:
        pattern: Where entries are.
    """

    def __init__(
        self,
        discretization: Discretization,
        finder: PatternFinder,
        nodes: wp.array,
        rank: wp.array,
        mesh_nodes: int,
        free: wp.array,
        members: Members | None,
        *,
        is_turned: bool = True,
        is_bounded: bool = False,
    ):
        self._discretization, self.device, sizes = discretization, discretization.device, discretization.sizes
        self._nodes, self._rank, self._mesh_nodes, self._free, self._members = nodes, rank, mesh_nodes, free, members
        self.is_turned, self._write_frames = is_turned, values.write_frames(is_turned)
        self._regions = Regions(discretization.team, self.device)
        self.pattern, self._pairs = finder.of_leaves(self._elements.nodes, sizes.world_elements, rank, members)
        self._frames = wp.zeros(sizes.elements, dtype=wp.mat33, device=self.device)
        weights = np.swapaxes(np.array(GRADIENT), 1, 2).reshape(12, 3)
        self._gradients = wp.array(weights, dtype=wp.vec3, device=self.device)
        rows = 0 if members is None else sizes.worlds * members.entries
        self._rows = GroupRows()
        self._rows.rows = wp.zeros(rows, dtype=wp.vec4, device=self.device)
        self._no_elements = wp.zeros(0, dtype=wp.vec4, device=self.device)
        more = sizes.worlds * len(nodes) if is_bounded else 1
        self._more = wp.zeros(more, dtype=wp.mat33, device=self.device)

    @property
    def kernels(self) -> list[wp.Kernel]:
        """Kernels that it launches, beside those of ``loading.IMPLICIT_ON_FORESTS``."""
        found = [self._write_frames, values.gather_leaves]
        return found if self._members is None else [*found, write_rows(ForestElements, self._members.law)]

    @property
    def _elements(self) -> ForestElements:
        return cast("ForestElements", self._discretization.elements)

    def gather(
        self,
        operator: TangentOperator,
        blocks: wp.array,
        inverses: wp.array,
        *,
        stiffening: float = 0.0,
        most_lambda: float = NO_LIMIT,
        most_shared: float = NO_LIMIT,
        holds: bool = False,
    ) -> None:
        """Launch the matrix at the operator's displacements and scales; its ``other_blocks`` are on the diagonal.

        Args:
            operator: The operator.
            blocks: The entries, transposed, mat33 [worlds * entries].
            inverses: The inverses of the diagonal blocks, mat33 [worlds * rows].
            stiffening: Viscous over elastic stress at one strain [s].
            most_lambda, most_shared: Lambda is at most this many times mu, and that of groups.
            holds: Whether the stiffness of elements that are held from turning over counts.
        """
        body, members, found, count = self._discretization, self._members, self.pattern, len(self._nodes)
        sizes, elements, u, scales = body.sizes, self._elements, operator.displacements, operator.scales
        self._regions.launch_over(
            self._write_frames, sizes.elements, lambda _, own: ([own(elements), u], [own(self._frames)]), u.ptr
        )
        if members is not None:
            material = isotropic_material([body.mu, body.lam, body.material_stride])
            inputs: list[Any] = [sizes.world_elements, members.entries, members.arrays, elements, u, material]
            kernel, outputs = write_rows(ForestElements, members.law), [self._rows, self._no_elements]
            self._launch(kernel, members.count, [*inputs, most_shared], outputs, u.ptr, most_shared)
        leaves = self._leaves(operator, blocks, stiffening, most_lambda)
        threads = 1 if self.device.is_cpu else len(found.sums.upper)
        parts = threads * self._regions.team.parts
        self._regions.launch(
            (blocks.ptr, scales.ptr, stiffening, most_lambda),
            lambda part: launch(
                values.gather_leaves, (sizes.worlds, threads), [part, parts, leaves], [], device=self.device
            ),
        )
        if holds and members is not None and members.law.is_held:
            inputs = [sizes.world_elements, count, found.entries, elements, u, body.lam, body.material_stride]
            inputs += [scales, self._rank, found.starts, found.columns]
            wp.launch(kernels.add_held_blocks(members.law), sizes.elements, inputs, [blocks], device=self.device)
        inputs = [leaves, found.starts, found.columns, found.diagonal]
        key = [blocks.ptr, leaves.others.ptr, scales.ptr, operator.inverse_mass.ptr]
        self._launch(values.finish_leaves, count, inputs, [blocks, inverses], *key)

    def _leaves(
        self, operator: TangentOperator, blocks: wp.array, stiffening: float, most_lambda: float
    ) -> values.Leaves:
        body, found, leaves = self._discretization, self.pattern, values.Leaves()
        leaves.elements, leaves.world_elements = self._elements, body.sizes.world_elements
        leaves.frames, leaves.gradients = self._frames, self._gradients
        leaves.mu, leaves.lam, leaves.stride = body.mu, body.lam, body.material_stride
        leaves.sums, leaves.entries, leaves.ranks = found.sums, found.entries, len(self._nodes)
        leaves.mesh_nodes, leaves.nodes, leaves.free = self._mesh_nodes, self._nodes, self._free
        leaves.pairs, leaves.rows, leaves.more, leaves.blocks = self._pairs, self._rows.rows, self._more, blocks
        leaves.scales, leaves.stiffening, leaves.inverse_mass = operator.scales, stiffening, operator.inverse_mass
        leaves.others, leaves.most_lambda = operator.other_blocks(), most_lambda
        if operator.tension is not None and self.is_turned:
            leaves.taut, leaves.twists = operator.tension.taut, operator.tension.twists
            leaves.swells = operator.tension.swells
        if self._members is not None:
            leaves.row_entries, leaves.most_lambda = self._members.entries, 0.0
        return leaves

    def _launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any], *key: Hashable) -> None:
        """Launch a kernel with ``count`` threads for each world, in parts."""
        self._regions.launch_from(kernel, (self._discretization.sizes.worlds, count), [0, *inputs], outputs, *key)
