"""The launches that derive a plan; see ``kernels.plan.plan``."""

from __future__ import annotations

from typing import Any

import warp as wp

from warp_corot.kernels.plan import batches as batch_kernels
from warp_corot.kernels.plan import lists
from warp_corot.kernels.plan import units as unit_kernels

from .arrays import PlanArrays

#: Threads of a launch on CUDA for each multiprocessor.
THREADS_PER_PROCESSOR = 1024


def threads_on(device: wp.Device) -> int:
    """Number of threads of a launch in which each loops over a stretch of leaves."""
    return 1 if device.is_cpu else device.sm_count * THREADS_PER_PROCESSOR


class Planner:
    """Derives a plan, in steps that may be recorded.

    Args:
        arrays: The plan's arrays; ``find`` needs only ``plan.marks``.
        threads: Threads of a launch.
    """

    def __init__(self, arrays: PlanArrays, threads: int):
        self._arrays, self._threads, self._device = arrays, threads, arrays.device
        self._rows = arrays.plan.classes + 2
        self._sums, self._ends = (wp.empty(self._rows * threads, dtype=wp.int32, device=self._device) for _ in range(2))

    def find(self) -> None:
        """Find the leaves in complete subtrees and the units, and count them."""
        made, threads = self._arrays, self._threads
        self._launch(lists.mark_leaves, threads, threads, made.tree, made.plan, self._sums)
        wp.utils.array_scan(self._sums, self._ends, inclusive=True)
        self._launch(lists.count_rows, self._rows, threads, self._ends, made.plan)

    def list(self) -> None:
        """List the leaves and the units."""
        made, threads = self._arrays, self._threads
        self._launch(lists.list_leaves, threads, threads, made.tree, self._ends, made.plan)

    def fill_batches(self) -> None:
        """Write the data of subtrees for launches."""
        made, threads = self._arrays, self._threads
        inputs = (threads, made.tree, made.plan, made.batches)
        self._launch(batch_kernels.fill_batches, (made.plan.classes, threads), *inputs)

    def fill_flat(self) -> None:
        """Write the data of leaves outside subtrees for launches."""
        made, threads = self._arrays, self._threads
        self._launch(batch_kernels.fill_flat, threads, threads, made.tree, made.plan, made.leaves)

    def pad_units(self) -> None:
        """Write padding before and after the units."""
        made, threads = self._arrays, self._threads
        self._launch(unit_kernels.pad_units, threads, threads, made.tree, made.plan)

    def repeat_units(self) -> None:
        """Write the units of all worlds but the first."""
        plan = self._arrays.plan
        self._launch(unit_kernels.repeat_units, (plan.worlds - 1, plan.world_leaves), plan)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, int], *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=list(arguments), device=self._device)
