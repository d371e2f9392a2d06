"""Cuts through a forest on the device: faces that a surface crosses, and the nodes that come apart with them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.remesh import cut as cut_kernels
from warp_corot.kernels.remesh import split as split_kernels
from warp_corot.kernels.remesh.criteria import Contents
from warp_corot.kernels.remesh.cut_surface import Surface

from .pools import DeviceForest

#: Up to this many leaves there is room for all of them in one cut; of more, for a quarter.
ALL_LEAVES = 1 << 18


class CutPass:
    """Launches that cut a forest along a surface. No array of the whole body goes to the host.

    Args:
        forest: The forest to cut.
        toughness: Energy of a cut [J/m^2], unless leaves carry "toughness".
    """

    def __init__(self, forest: DeviceForest, toughness: float = 0.0):
        self.forest, self.device = forest, forest.device
        capacity, nodes = forest.capacity, forest.node_capacity
        room = max(capacity // 4, min(capacity, ALL_LEAVES))
        cuts = self._cuts = cut_kernels.Cuts()
        cuts.counts = self._ints(cut_kernels.COUNTS, 0)
        cuts.room = room
        cuts.stars, cuts.fresh = self._ints(room, 0), self._ints(room, 0)
        cuts.slot, cuts.other, cuts.link, cuts.copy = (self._ints(4 * room, -1) for _ in range(4))
        cuts.pull = wp.zeros(4 * room, dtype=wp.float32, device=self.device)
        # Two leaves share a face; half of the table stays empty.
        size = 1 << (8 * room).bit_length()
        cuts.keys = wp.full(size, wp.int64(-1), dtype=wp.int64, device=self.device)
        cuts.owner = self._ints(size, -1)
        cuts.mark, cuts.marked, cuts.keeper = (self._ints(nodes, 0) for _ in range(3))
        cuts.former_mass = wp.zeros(nodes, dtype=wp.float64, device=self.device)
        names = forest.carriage.names
        cuts.toughness, cuts.toughness_column = toughness, names.index("toughness") if "toughness" in names else -1
        cuts.names = forest.pools.tets.view(wp.int32)

    def launch_cut(self, surface: Surface, *, goes_on: bool = False) -> None:
        """Launch a cut: which faces the surface crosses, and the separation of their nodes.

        Args:
            surface: A plane or triangles.
            goes_on: Whether it belongs to a pass that was just launched: then its counts are added to that pass's.
        """
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._once(cut_kernels.begin_cut, int(goes_on), pools, cuts)
        self._many(cut_kernels.list_near, surface, carried, pools, cuts)
        self._many(cut_kernels.cross_faces, surface, carried, pools, cuts)
        self._launch_end(surface)

    def launch_tear(self, stress: float, contents: Contents) -> None:
        """Launch a tear: the separation of faces across which the stress [Pa] is larger.

        Args:
            stress: The bound.
            contents: The material of leaves.
        """
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        surface = Surface()
        surface.stress = stress
        self._once(cut_kernels.begin_cut, 0, pools, cuts)
        self._many(cut_kernels.list_all, pools, cuts)
        self._many(cut_kernels.pull_faces, contents, carried, pools, cuts)
        self._many(cut_kernels.choose_faces, surface, pools, cuts)
        self._many(cut_kernels.tear_faces, pools, cuts)
        self._launch_end(surface)

    def launch_marks(self, surface: Surface) -> None:
        """Launch the marks of leaves at triangles that are to be refined to their levels."""
        self._many(cut_kernels.mark_near, surface, self.forest.carriage.arrays, self.forest.pools)

    def launch_after_pass(self) -> None:
        """Launch the separation of nodes that a pass has made on cut faces; may be recorded with the pass."""
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._once(cut_kernels.begin_cut, 1, pools, cuts)
        self._many(cut_kernels.mark_bisected, carried, pools, cuts)
        self._launch_split()

    @property
    def faces(self) -> int:
        """The number of faces that the last cut has separated."""
        return int(self._cuts.counts.numpy()[cut_kernels.FACES])

    # --- pieces ------------------------------------------------------------------------------------------------------

    def _launch_end(self, surface: Surface) -> None:
        """Launch what follows when faces have been cut."""
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._many(cut_kernels.join_lone, pools, cuts)
        self._many(cut_kernels.count_faces, surface, carried, pools, cuts)
        self._launch_split()

    def _launch_split(self) -> None:
        pools, carried, cuts = self.forest.pools, self.forest.carriage.arrays, self._cuts
        self._once(split_kernels.begin_stars, cuts)
        self._many(split_kernels.list_stars, pools, cuts)
        self._many(split_kernels.unite_corners, pools, cuts)
        self._many(split_kernels.choose_keepers, pools, cuts)
        self._many(split_kernels.copy_nodes, pools, carried, cuts)
        self._many(split_kernels.rename_corners, pools, carried, cuts)
        self._many(split_kernels.settle_nodes, pools, carried, cuts)
        self._many(split_kernels.rename_ancestors, pools, cuts)
        self._many(split_kernels.tear_ancestors, pools, cuts)
        self._once(split_kernels.end_cut, pools, cuts)

    def _once(self, kernel: wp.Kernel, *arguments: Any) -> None:
        wp.launch(kernel, dim=1, inputs=list(arguments), device=self.device)

    def _many(self, kernel: wp.Kernel, *arguments: Any) -> None:
        threads = self.forest.threads
        wp.launch(kernel, dim=threads, inputs=[threads, *arguments], device=self.device)

    def _ints(self, count: int, value: int) -> wp.array:
        return wp.full(max(count, 1), value, dtype=wp.int32, device=self.device)


def plane_surface(normal: npt.ArrayLike, offset: float, *, is_deformed: bool) -> Surface:
    """A plane of the points x with normal . x = offset [m]; normal of unit length."""
    surface = Surface()
    surface.is_deformed = float(is_deformed)
    surface.normal, surface.offset = wp.vec3d(*np.asarray(normal, dtype=float)), float(offset)
    return surface
