"""The groups of elements that share a dilatation: complete subtrees, and groups of the other elements."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.groups import ChangingGroups
from warp_corot.discretization.changing.plan import DevicePlan
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.groups import Groups
from warp_corot.discretization.members import Batch as GroupBatch
from warp_corot.discretization.plan import Plan
from warp_corot.discretization.subtrees import Batch
from warp_corot.errors import InputError
from warp_corot.mesh import TetForest


class ElementGroups:
    """The groups of a plan, found again whenever a forest changes.

    Args:
        discretization: The mesh.
        plan: The field's units of work.

    Attributes:
        starts, members, live: The groups of elements outside subtrees, as
            ``kernels.elements.mean_dilatation.share_in_groups`` takes them.

    Raises:
        InputError: The forest changes, and the law computes forces leaf by leaf.
    """

    def __init__(self, discretization: Discretization, plan: Plan):
        device, mesh, self._plan = discretization.device, discretization.mesh, plan
        self._all = self.live = wp.empty(0, dtype=wp.int32, device=device)
        self._found: Groups | ChangingGroups
        if isinstance(plan, DevicePlan):
            if not plan.kinds:
                raise InputError(
                    "this model computes forces leaf by leaf, where elements of a body that is remeshed cannot share "
                    "their dilatation; take dilatation='element', or the model's default rotations and stiffness"
                )
            self._found = ChangingGroups(plan)
            self.live = self._found.live
        elif isinstance(mesh, TetForest):
            leaves = plan.flat.leaves.numpy()
            leaves = leaves[: len(leaves) // discretization.worlds]
            self._found = Groups.of_leaves(mesh, leaves, device, discretization.worlds)
        else:
            self._found = Groups.of_elements(mesh, device, discretization.worlds)
        self.starts, self.members = self._found.starts, self._found.members
        self.derive()

    def derive(self) -> None:
        """Launch the search for groups if the mesh changes; may be recorded."""
        if isinstance(self._found, ChangingGroups):
            self._found.launch()

    @property
    def of_others(self) -> list[GroupBatch]:
        """The groups of elements outside subtrees, and their number in launches; none without elements."""
        count = len(self._plan.flat) if isinstance(self._found, ChangingGroups) else len(self._found)
        return [(self.starts, self.members, self.live, count)] if count else []

    def of_subtrees(self, batches: Sequence[Batch]) -> list[GroupBatch]:
        """Subtrees in the same form."""
        return [(b.subtrees.first, self._all, b.live or self._all, b.count) for b in batches]

    @property
    def all(self) -> list[GroupBatch]:
        """All groups."""
        return self.of_subtrees(self._plan.batches) + self.of_others


def elements_of(starts: wp.array, members: wp.array, live: wp.array, count: int) -> list[npt.NDArray[np.int32]]:
    """The elements of each of some groups; launches over a mesh that changes go beyond these."""
    begins = starts.numpy()
    count = min(count, int(live.numpy()[0])) if len(live) else count
    if count and len(members):
        return np.split(members.numpy()[begins[0] : begins[count]], begins[1:count] - begins[0])
    return list(begins[:count, None] + np.arange(8, dtype=np.int32))


def group_numbers(groups: Sequence[npt.NDArray[np.int32]], count: int) -> npt.NDArray[np.int32]:
    """The number of the group of each of so many elements, int32 [count]; 0 for those in no group."""
    numbers = np.zeros(count, np.int32)
    numbers[np.concatenate(groups)] = np.repeat(np.arange(len(groups)), [len(group) for group in groups])
    return numbers
