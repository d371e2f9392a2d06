"""One level: its matrix, the vectors of the cycle, and the launches from it to the next coarser one."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_corot.kernels.implicit.multigrid import cycle, shared, values

from .pattern import Midpoints, Pattern

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
    """

    def __init__(self, count: int, worlds: int, ranks: int, free: wp.array, degree: int):
        self.count, self.worlds, self.ranks, self.free, self.device = count, worlds, ranks, free, free.device
        self.inverses = wp.zeros(worlds * count, dtype=wp.mat33, device=self.device)
        self.r, self.z, self.other = (wp.zeros(worlds * count, dtype=wp.vec4, device=self.device) for _ in range(3))
        self.factors = smoothing_factors(degree)

    def take_in(self, mesh_nodes: int, nodes: wp.array, given: wp.array) -> None:
        """Launch the finest level's residual, and the smoother's first step.

        Args:
            mesh_nodes: Number of nodes of the mesh.
            nodes: The node number of each rank, int32.
            given: The residual by number, vec4.
        """
        inputs = [self.count, mesh_nodes, self._first_factor, nodes, self.free, self.inverses, given]
        self._move(cycle.take_in, self.count, inputs, [self.r, self.z])

    def hand_out(self, mesh_nodes: int, nodes: wp.array, given: wp.array, result: wp.array) -> None:
        """Launch the finest level's correction by number; held nodes have what is given."""
        inputs = [self.count, mesh_nodes, nodes, self.free, given, self.z]
        self._move(cycle.hand_out, self.count, inputs, [result])

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
        inputs: list[Any] = [self.ranks, self.count, fine.count, self._first_factor, self.free]
        inputs += [midpoints.starts, midpoints.midpoints, self.inverses, residual]
        self._move(cycle.restrict_residual, self.count, inputs, [self.r, self.z])

    def take_correction(self, coarse: SmoothedLevel, ends: wp.array) -> None:
        """Add the correction of the coarser level to this one's."""
        inputs = [self.ranks, coarse.count, self.count, self.free, ends, coarse.z]
        self._move(cycle.prolongate_correction, self.count, inputs, [self.z])

    @property
    def _first_factor(self) -> float:
        """The factor of the smoother's first step from zero; zero: none is made."""
        return self.factors[0][0] if self.factors else 0.0

    def _move(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        """Launch a kernel whose threads share ``count`` nodes of each world; on a CPU there is one."""
        threads = 1 if self.device.is_cpu else count
        self.launch(kernel, threads, [threads, *inputs], outputs)

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
        lanes: Number of threads that share a row.
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
        self.pattern = pattern
        # One more, since products read past the last.
        self.blocks = wp.zeros(worlds * pattern.entries + 1, dtype=wp.mat33, device=self.device)
        self.rows = cycle.Rows()
        self.rows.starts, self.rows.columns, self.rows.blocks = pattern.starts, pattern.columns, self.blocks
        self._unbounded = wp.zeros_like(self.inverses) if is_bounded else None
        rows = worlds * self.count
        self.lanes = next((lanes for most, lanes in LANES if rows > most), MOST_LANES)
        if self.device.is_cpu:
            self.lanes = 1

    def find_residual(self) -> None:
        inputs = [self.lanes, self.count, self.pattern.entries, self.rows, self.r, self.z]
        self.launch(cycle.find_residual, self.count * self.lanes, inputs, [self.other])

    def _make_step(self, step: int, *, is_first: bool) -> None:
        alpha, beta = self.factors[step]
        inputs: list[Any] = [self.lanes, self.count, self.pattern.entries]
        inputs += [alpha, beta if step else 0.0, is_first, self.rows, self.inverses, self.r, self.z]
        self.launch(cycle.smooth, self.count * self.lanes, inputs, [self.other])
        self.z, self.other = self.other, self.z

    def gather_from(self, fine: SmoothedLevel) -> None:
        """Compute the matrix P^T A P from the finer level's matrix A."""
        assert isinstance(fine, Level)
        pattern = self.pattern
        lanes = 1 if self.device.is_cpu else GATHERING_LANES
        inputs = [lanes, self.ranks, self.count, pattern.entries, fine.pattern.entries, self.free, pattern.upper]
        inputs += [pattern.sum_starts, pattern.codes, pattern.places, fine.blocks]
        self.gather(values.gather_products, inputs, lanes)

    def gather(self, kernel: wp.Kernel, inputs: list[Any], lanes: int = 1) -> None:
        """Launch a kernel that computes blocks and inverses, with some threads for each entry of the upper triangle."""
        pattern = self.pattern
        inverses = self.inverses if self._unbounded is None else self._unbounded
        self.launch(kernel, lanes * len(pattern.upper), inputs, [self.blocks, inverses])
        if self._unbounded is not None:
            inputs = [self.count, pattern.entries, pattern.starts, pattern.columns, self.blocks, inverses]
            self.launch(shared.bound_diagonal, self.count, inputs, [self.inverses])
