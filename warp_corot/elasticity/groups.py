"""The groups of elements that share a dilatation, and such groups in clusters (CUDA)."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.changing.plan import ChangingGroups, DevicePlan
from warp_corot.discretization.discretization import Discretization
from warp_corot.discretization.groups import Batch as GroupBatch
from warp_corot.discretization.groups import Groups
from warp_corot.discretization.plan import Batch, Plan
from warp_corot.elasticity.clusters import ClusterScatter
from warp_corot.elasticity.model import Kept
from warp_corot.errors import InputError
from warp_corot.inputs.loading import LoadedKernel
from warp_corot.kernels.clusters.laws import SharingMaterial, measure_pairs, shared_pressure, sharing_law
from warp_corot.kernels.elements.dilatation import Dilatation
from warp_corot.mesh import TetForest


class ElementGroups:
    """The groups of a plan, found again whenever a forest changes.

    Args:
        discretization: The mesh.
        plan: The field's units of work.

    Attributes:
        starts, members, live: The groups of elements outside subtrees, as
            ``kernels.elements.dilatation.share_in_groups`` takes them.

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
                    "their dilatation; take dilatation='element', or the model's default rotations"
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


# --- groups in clusters (CUDA); see ``kernels.clusters.laws`` --------------------------------------------------------


class ClusteredGroups:
    """Groups of elements whose forces a ``ClusterScatter`` adds; from now on it also adds the forces of their
    dilatation.

    Args:
        scatter: Adds the forces.
        elements: Number of elements of the mesh.
        groups: The elements of each group; together they have all elements that the clusters have.
        of: The shared dilatation.
        lam: Gives lambda [Pa] as the elements have it.
    """

    def __init__(
        self,
        scatter: ClusterScatter,
        elements: int,
        groups: Sequence[npt.NDArray[np.int32]],
        of: Dilatation,
        lam: Callable[[], wp.array],
    ):
        self._scatter, self._lam, self._device = scatter, lam, scatter.clusters.elements.device
        listed = group_numbers(groups, elements)[scatter.clusters.elements.numpy()]
        self._listed = wp.array(listed, dtype=wp.int32, device=self._device)
        self._sums = wp.zeros(len(groups), dtype=wp.vec4, device=self._device)
        self._kernel = measure_pairs(scatter.Pairs, of, scatter.layout)
        made = Kept(SharingMaterial, "isotropic", "lam", "groups", "sums")
        scatter.use_law(
            sharing_law(scatter.law, of),
            SharingMaterial,
            shared_pressure(of),
            lambda isotropic: made(isotropic, lam(), self._listed, self._sums),
        )

    @property
    def kernel(self) -> LoadedKernel:
        """The kernel of the sums."""
        return self._kernel, self._scatter.layout.threads

    def add_up(self, stride: int, u: wp.array) -> None:
        """Launch the sums of the groups' dilatation at displacements u, before the forces; ``stride`` is lambda's."""
        scatter, threads = self._scatter, self._scatter.layout.threads
        self._sums.zero_()
        inputs = [scatter.clusters, scatter.pairs, self._listed, stride, self._lam(), u]
        size = scatter.count * threads
        wp.launch(self._kernel, size, inputs, [self._sums], device=self._device, block_dim=threads)
