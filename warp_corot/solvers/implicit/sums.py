"""Sums over the nodes of each world, on the device."""

from __future__ import annotations

import numpy as np
import warp as wp

from warp_corot.kernels.implicit.sums import sum_products
from warp_corot.solvers.halo import ALONE, Halo

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

    Attributes:
        parts: Parts of the sums, float64 [worlds, parts, columns].
        shape: The threads of a launch over all nodes [2].
        sizes: The arguments count, threads and lanes of its kernel.
    """

    def __init__(self, worlds: int, count: int, columns: int, device: wp.Device, ranks: Halo = ALONE):
        self.device, self.worlds, self._ranks = device, worlds, ranks
        self.lanes = 1 if device.is_cpu or ranks.is_reproducible else WARP
        wanted = -(-count // (NODES * WARP))
        warps = 1 if device.is_cpu else max(min(wanted, WARPS // worlds), 1)
        if ranks.is_reproducible:
            # Every node is an addend, because their sums are the same in any order.
            warps = count
        threads = warps * self.lanes
        self.parts = wp.zeros((worlds, warps, columns), dtype=wp.float64, device=device)
        self.shape, self.sizes = (worlds, threads), [count, threads, self.lanes]

    def launch_products(self, a: wp.array, b: wp.array, column: int) -> None:
        """Launch a . b of each world, vec4."""
        inputs = [a, b, *self.sizes, column]
        wp.launch(sum_products, self.shape, inputs, [self.parts], device=self.device)
        self.take_in(column)

    def take_in(self, *columns: int, most: bool = False) -> None:
        """Launch the replacement of columns of new parts by those of all ranks.

        Args:
            columns: The numbers of the columns.
            most: Whether their largest parts are asked for, not their sums.
        """
        if not self._ranks.is_alone:
            take_in(self.parts, list(columns), self._ranks, most=most)

    def launch_scalars(self, kernel: wp.Kernel, inputs: list, outputs: list) -> None:
        """Launch a kernel that adds the parts up, with the lanes of a warp for each world."""
        dim = (self.worlds, self.lanes)
        wp.launch(kernel, dim, [self.parts, self.lanes, *inputs], outputs, device=self.device)


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
