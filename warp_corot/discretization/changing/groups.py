"""Groups of the leaves outside subtrees, found again on the device whenever the mesh has changed; see ``groups``."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from warp_corot.discretization.groups import cubes_of
from warp_corot.kernels.plan import groups as kernels

from .plan import DevicePlan


class ChangingGroups:
    """Groups of a plan's leaves outside subtrees.

    Args:
        plan: The plan; launch ``launch`` after it.

    Attributes:
        starts, members: As in ``groups.Groups``, with room for the largest possible number.
        live: Number of groups, int32 [1] on the device.
    """

    def __init__(self, plan: DevicePlan):
        self._forest, self._plan, self.device = plan.forest, plan.arrays, plan.device
        source, most = plan.forest.source, len(plan.arrays.flat)
        _, cube_of_root = np.unique(
            cubes_of(source, source.tree.tets[: self._pools.roots]), axis=0, return_inverse=True
        )
        groups = self._groups = kernels.Groups()
        groups.count = self._zeros(1)
        groups.starts, groups.size = self._zeros(most + 1), self._zeros(most + 1)
        groups.members, groups.filled = self._zeros(most), self._zeros(most)
        tetrahedra = len(self._pools.level)
        groups.tally, groups.makes, groups.is_flat = (self._zeros(tetrahedra) for _ in range(3))
        count = int(cube_of_root.max()) + 1
        groups.cube_tally, groups.cube_makes = self._zeros(count), self._zeros(count)
        groups.cube_of_root = wp.array(cube_of_root.ravel(), dtype=wp.int32, device=self.device)
        self.starts, self.members, self.live = groups.starts, groups.members, groups.count

    def launch(self) -> None:
        """Launch the search for groups if the plan has just been derived; may be recorded."""
        pools, plan, groups = self._pools, self._plan, self._groups
        most, tetrahedra, cubes = len(groups.filled), len(groups.tally), len(groups.cube_tally)
        self._launch(kernels.begin_groups, max(most, tetrahedra, cubes), pools, plan)
        self._launch(kernels.mark_flat, most, pools, plan)
        self._launch(kernels.climb, tetrahedra, pools, plan)
        self._launch(kernels.number_cubes, cubes, plan)
        self._launch(kernels.count_members, most, pools, plan)
        wp.utils.array_scan(groups.size, groups.starts, inclusive=True)
        self._launch(kernels.place_members, most, pools, plan)
        self._launch(kernels.order_members, most, plan)

    @property
    def _pools(self) -> Any:
        return self._forest.pools

    def _zeros(self, count: int) -> wp.array:
        return wp.zeros(count, dtype=wp.int32, device=self.device)

    def _launch(self, kernel: wp.Kernel, dim: int, *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=[*arguments, self._groups], device=self.device)
