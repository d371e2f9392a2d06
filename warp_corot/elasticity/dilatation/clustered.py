"""A dilatation that elements in clusters share (CUDA); see ``kernels.clusters.sharing``."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.elements import Elements
from warp_corot.elasticity.paths.clusters import SUBTREE, ClusterScatter
from warp_corot.elasticity.structs import Kept
from warp_corot.kernels.clusters.sharing import LANES, SharingMaterial, find_pressures, sharing_law
from warp_corot.kernels.elements.constitutive import IsotropicMaterial
from warp_corot.kernels.elements.dilatation import Dilatation

#: Threads of a block that finds pressures.
BLOCK = 128


class ClusteredGroups:
    """Groups of elements whose forces a ``ClusterScatter`` adds; from now on it also adds the forces of their
    dilatation.

    Args:
        scatter: Adds the forces.
        elements: All elements of the mesh.
        kind: Their struct.
        batches: Groups as ``kernels.elements.shared_dilatation.share_in_groups`` takes them, and how many; together
            they have all elements that the clusters have.
        of: The shared dilatation.
        lam: Gives lambda [Pa] as the elements have it.
    """

    def __init__(
        self,
        scatter: ClusterScatter,
        elements: Elements,
        kind: type,
        batches: Sequence[tuple[wp.array, wp.array, wp.array, int]],
        of: Dilatation,
        lam: Callable[[], wp.array],
    ):
        self._elements, self._lam, self._device = elements, lam, elements.nodes.device
        parts = [_members_of(*batch) for batch in batches]
        members, sizes = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        group_of = np.zeros(len(elements.nodes), np.int32)
        group_of[members] = np.repeat(np.arange(len(sizes)), sizes)
        listed = group_of[scatter.clusters.elements.numpy()]
        starts = np.concatenate([[0], np.cumsum(sizes)])
        self._starts, self._members, self._listed = (
            wp.array(values, dtype=wp.int32, device=self._device) for values in (starts, members, listed)
        )
        self._pressures = wp.zeros(len(sizes), dtype=wp.float32, device=self._device)
        self._kernel = find_pressures(kind, of)
        made = Kept(_sharing_material)
        scatter.use_law(
            sharing_law(scatter.law, of),
            SharingMaterial,
            lambda isotropic: made(isotropic, lam(), self._listed, self._pressures),
        )

    def find_pressures(self, stride: int, u: wp.array) -> None:
        """Launch the kernel that finds the groups' pressures at displacements u, before the forces; ``stride`` is
        lambda's.
        """
        blocks = -(-LANES * len(self._pressures) // BLOCK)
        inputs = [self._starts, self._members, self._elements, stride, self._lam(), u]
        wp.launch(self._kernel, blocks * BLOCK, inputs, [self._pressures], device=self._device, block_dim=BLOCK)


def _members_of(
    starts: wp.array, members: wp.array, _live: wp.array, count: int
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """The elements of this many groups, group after group, and the number of elements of each."""
    begins = starts.numpy()
    if len(members):
        return members.numpy()[begins[0] : begins[count]], np.diff(begins[: count + 1])
    return (begins[:count, None] + np.arange(SUBTREE, dtype=np.int32)).ravel(), np.full(count, SUBTREE, np.int32)


def _sharing_material(
    isotropic: IsotropicMaterial, lam: wp.array, groups: wp.array, pressures: wp.array
) -> SharingMaterial:
    material = SharingMaterial()
    material.isotropic, material.lam, material.groups, material.pressures = isotropic, lam, groups, pressures
    return material
