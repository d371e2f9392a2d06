"""Preconditioned conjugate gradients and line searches as launches: the host reads no scalar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.implicit import conjugate_gradients as kernels
from warp_corot.kernels.implicit import line_search as searches
from warp_corot.kernels.stepping.sums import Sums
from warp_corot.solvers.halo import ALONE, Halo

from .operator import Preconditioner, Product

if TYPE_CHECKING:
    from .operator import SolvedContact

#: Number of lanes in a warp, minimum number of nodes of a thread, and maximum number of warps of all worlds.
WARP, NODES, WARPS = 32, 4, 512


class WorldSums:
    """Arrays for sums, and the sizes of their launches.

    Args:
        worlds: Number of worlds.
        count: Number of nodes in each.
        columns: Number of sums.
        device: The device.
        ranks: The ranks with other nodes of the same worlds.
        most: Maximum number of warps of all worlds.

    Attributes:
        parts: Parts of the sums, float64 [worlds, parts, columns].
        shape: The threads of a launch over all nodes [2].
        lanes: The threads that compute a part.
        arrays: The same for kernels.
    """

    def __init__(
        self, worlds: int, count: int, columns: int, device: wp.Device, ranks: Halo = ALONE, most: int = WARPS
    ):
        self.device, self.worlds, self._ranks = device, worlds, ranks
        self.lanes = 1 if device.is_cpu or ranks.is_reproducible else WARP
        wanted = -(-count // (NODES * WARP))
        warps = 1 if device.is_cpu else max(min(wanted, most // worlds), 1)
        if ranks.is_reproducible:
            # Every node is an addend, because their sums are the same in any order.
            warps = count
        threads = warps * self.lanes
        self.parts = wp.zeros((worlds, warps, columns), dtype=wp.float64, device=device)
        self.shape, self.arrays = (worlds, threads), Sums()
        self.arrays.count, self.arrays.threads, self.arrays.lanes = count, threads, self.lanes
        self.arrays.parts = self.parts

    def launch_products(self, a: wp.array, b: wp.array, column: int) -> None:
        """Launch a . b of each world, vec4."""
        self.launch(kernels.sum_products, [a, b, column], column)

    def launch(self, kernel: wp.Kernel, arguments: list, *columns: int) -> None:
        """Launch a kernel that finds the parts of sums in these columns."""
        wp.launch(kernel, self.shape, [self.arrays, *arguments], device=self.device)
        self.take_in(*columns)

    def take_in(self, *columns: int, most: bool = False) -> None:
        """Launch the replacement of columns of new parts by those of all ranks.

        Args:
            columns: The numbers of the columns.
            most: Whether their largest parts are asked for, not their sums.
        """
        if columns and not self._ranks.is_alone:
            take_in(self.parts, list(columns), self._ranks, most=most)

    def launch_scalars(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel that adds the parts up, with the lanes of a warp for each world."""
        dim = (self.worlds, self.lanes)
        wp.launch(kernel, dim, [self.arrays, *inputs], outputs, device=self.device)


def take_in(parts: wp.array, columns: list[int], ranks: Halo, *, most: bool = False) -> None:
    """Launch the replacement of columns of partial sums, float64 [worlds, parts, columns], by those of all ranks: their
    sums, or the largest values with ``most``, are in the first part."""
    values = parts.numpy()
    own = values[:, :, columns]
    if most:
        total = ranks.max(own.max(axis=1))
    else:
        total = ranks.sum(own.sum(axis=1), np.moveaxis(own, 1, 0) if ranks.is_reproducible else None)
    values[:, :, columns] = 0.0
    values[:, 0, columns] = total
    if parts.device.is_cuda:
        parts.assign(values)


@dataclass(frozen=True)
class SolveReport:
    """How a solve ended in each world.

    Attributes:
        iterations: int32 [worlds].
        residual: Norm of b - A x over that of b, as the iteration computes it, float64 [worlds].
        converged: Whether that is within the tolerance, bool [worlds].
        negative: Whether a direction p with p . A p <= 0 ended the iteration, bool [worlds].
        broken: Whether something was not finite, or the preconditioner not positive definite, bool [worlds].
    """

    iterations: npt.NDArray[np.int32]
    residual: npt.NDArray[np.float64]
    converged: npt.NDArray[np.bool_]
    negative: npt.NDArray[np.bool_]
    broken: npt.NDArray[np.bool_]


class ConjugateGradients:
    """Solves A x = b in all worlds together, each until its own residual is small.

    A world whose A shows negative curvature keeps the iterate before that, or the preconditioned b if there is none:
    a direction of descent in either case.

    Args:
        operator: A.
        length: Entries of vectors.
        most: Maximum number of iterations.
        ranks: The ranks with other nodes of the same worlds.

    Attributes:
        r: The residual of the present solve, vec4.
        tolerance: Norm of the residual over that of b at which a world stops, float64 [worlds] on the device.
        iterations: Number of iterations of the last solve, int32 [worlds] on the device.
        scalars: Scalars of the iteration, see ``kernels.implicit.conjugate_gradients``, float64 [worlds, SCALARS] on
            the device.
        status: How the last solve ended, see there, int32 [worlds] on the device.
    """

    def __init__(self, operator: Product, length: int, *, most: int = 1000, ranks: Halo = ALONE):
        self.operator, self.device, self.worlds, self.most = operator, operator.device, operator.worlds, most
        self._count = operator.node_count
        self.r, self._z, self._p, self._q = (wp.zeros(length, dtype=wp.vec4, device=self.device) for _ in range(4))
        self._sums = WorldSums(self.worlds, self._count, kernels.COLUMNS, self.device, ranks)
        shape = (self.worlds, kernels.SCALARS)
        self.scalars = wp.zeros(shape, dtype=wp.float64, device=self.device)
        self.tolerance = wp.full(self.worlds, 1e-6, dtype=wp.float64, device=self.device)
        self.iterations, self.status = (wp.zeros(self.worlds, dtype=wp.int32, device=self.device) for _ in range(2))
        self._running = wp.zeros(1, dtype=wp.int32, device=self.device)

    def launch(
        self,
        preconditioner: Preconditioner,
        b: wp.array,
        x: wp.array,
        *,
        guessed: bool = False,
        like: wp.array | None = None,
        share: float = 0.0,
    ) -> None:
        """Launch a solve, recorded or at once, with a preconditioner that is up to date with the operator; see
        ``begin``."""
        self.begin(b, x, guessed=guessed, like=like, share=share)
        self.iterate(preconditioner.apply, x)

    def begin(
        self, b: wp.array, x: wp.array, *, guessed: bool = False, like: wp.array | None = None, share: float = 0.0
    ) -> None:
        """Launch the beginning of a solve.

        Args:
            b: Right side, zero at nodes that are not free, vec4 [worlds * nodes].
            x: The solution.
            guessed: Whether x has a first guess, zero at nodes that are not free; it is scaled so that the energy is
                least.
            like: The vector with which the residual is compared, vec4 [worlds * nodes]; None: b.
            share: The solve may end at this share of its first residual, too.
        """
        r, q, sums = self.r, self._q, self._sums
        if guessed:
            self.operator.apply(x, q)
            sums.launch(kernels.measure_guess, [b, x, q], int(kernels.PRODUCT), int(kernels.CURVATURE))
            sums.launch_scalars(kernels.take_guess, [], [self.scalars])
        arguments = [b, b if like is None else like, q, self.scalars, int(guessed), x, r]
        sums.launch(kernels.begin, arguments, int(kernels.SQUARE), int(kernels.RIGHT))
        self._running.zero_()
        outputs = [self.scalars, self.iterations, self.status, self._running]
        sums.launch_scalars(kernels.take_first, [self.tolerance, wp.float64(share)], outputs)

    def iterate(self, apply_inverse: Callable[[wp.array, wp.array], None], x: wp.array) -> None:
        """Launch iterations one by one, in the worlds that run, with the preconditioner z = B r."""
        wp.capture_while(self._running, self._iterate, apply_inverse=apply_inverse, x=x)

    def _iterate(self, apply_inverse: Callable[[wp.array, wp.array], None], x: wp.array) -> None:
        r, z, p, q, sums = self.r, self._z, self._p, self._q, self._sums
        apply_inverse(r, z)
        sums.launch_products(r, z, int(kernels.PRODUCT))
        sums.launch_scalars(kernels.take_beta, [], [self.scalars, self.status, self._running])
        self._launch(kernels.take_direction, [z, self.scalars, self._count, p])
        self.operator.apply(p, q)
        sums.launch_products(p, q, int(kernels.CURVATURE))
        outputs = [self.scalars, self.iterations, self.status, self._running]
        sums.launch_scalars(kernels.take_alpha, [], outputs)
        sums.launch(kernels.advance, [p, q, self.scalars, x, r], int(kernels.SQUARE))
        outputs = [self.scalars, self.status, self._running]
        sums.launch_scalars(kernels.judge, [self.most, self.iterations], outputs)

    def _launch(self, kernel: wp.Kernel, arguments: list) -> None:
        wp.launch(kernel, self.worlds * self._count, arguments, device=self.device)

    def report(self) -> SolveReport:
        """How the last solve ended; waits for the device."""
        status, scalars = self.status.numpy(), self.scalars.numpy()
        first = scalars[:, int(kernels.FIRST)]
        share = scalars[:, int(kernels.RR)] / np.where(first > 0.0, first, 1.0)
        return SolveReport(
            iterations=self.iterations.numpy(),
            residual=np.sqrt(share),
            converged=status == int(kernels.CONVERGED),
            negative=status == int(kernels.NEGATIVE),
            broken=status == int(kernels.BROKEN),
        )


class LineSearch:
    """Finds how much of a change of the motions to take, in each world.

    Args:
        worlds: Number of worlds.
        count: Number of entries of each world.
        contacts: The contacts that open and close.
        device: The device.
        ranks: The ranks with the other entries of each world, which find the same share.
        places: The number of a body and of its places in a world, whose powers the ranks add up.
    """

    def __init__(
        self,
        worlds: int,
        count: int,
        contacts: SolvedContact,
        device: wp.Device,
        *,
        ranks: Halo = ALONE,
        places: tuple[int, int] = (0, 0),
    ):
        self._worlds, self._count, self._contacts, self.device = worlds, count, contacts, device
        self._power, self._loss = (WorldSums(worlds, count, 1, device, ranks) for _ in range(2))
        self._search = wp.zeros((worlds, searches.COLUMNS), dtype=wp.float64, device=device)
        # The sums of worlds are in the first places.
        self._ranks, self._body = ranks, None if ranks.is_alone else places[0]
        self._addends = wp.zeros((worlds, max(places[1], 1), 1), dtype=wp.float64, device=device)
        self._slopes = self._addends[:, 0, 0]
        self._searching = wp.zeros(1, dtype=wp.int32, device=device)

    def launch(
        self, rest: wp.array, product: wp.array, change: wp.array, d: wp.array, image: wp.array | None = None
    ) -> None:
        """Launch d += share of the change.

        Args:
            rest: b - A d, where A has no contacts.
            product: A times the change.
            change: The change, zero at entries that are not free.
            d: Motions.
            image: A d, which follows.
        """
        self._power.launch_products(change, rest, 0)
        self._loss.launch_products(change, product, 0)
        outputs = [self._search, self._slopes, self._searching]
        self._power.launch_scalars(searches.begin_search, [self._loss.arrays], outputs)
        wp.capture_while(self._searching, self._try, d=d, change=change)
        for increase, grown in ((change, d), (product, image)):
            if grown is not None:
                inputs = [self._search, self._count, increase, grown]
                self._launch(searches.add_share, self._worlds * self._count, inputs)

    def _try(self, d: wp.array, change: wp.array) -> None:
        if self._body is None:
            self._contacts.add_slopes(d, change, self._search, self._slopes)
        else:
            self._addends.zero_()
            self._contacts.add_slopes(d, change, self._search, self._addends.flatten(), apart=self._body)
            take_in(self._addends, [0], self._ranks)
        self._launch(searches.take_trial, self._worlds, [self._search, self._slopes, self._searching])

    def _launch(self, kernel: wp.Kernel, dim: int, inputs: list) -> None:
        wp.launch(kernel, dim, inputs, device=self.device)
