"""The state of a changing forest at one time, kept on the device."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import warp as wp

from ..kernels import remesh as kernels
from ..kernels.remesh_state import NO_ROW
from .fields import CARRIED_BY_NODES, CARRIED_BY_TETRAHEDRA, OF_NODES, OF_TETRAHEDRA

if TYPE_CHECKING:
    from .pools import DeviceForest

#: What places hold where there is nothing, if it is not zero.
_UNUSED = {"level": int(kernels.UNUSED), "row": int(NO_ROW)}


class _Piece(NamedTuple):
    array: wp.array
    start: int
    values: wp.array

    def write(self) -> None:
        self.array[self.start : self.start + len(self.values)].assign(self.values)


class Snapshot:
    """A copy of what is in use of all arrays; ``restore`` writes it back into the same ones."""

    def __init__(self, forest: DeviceForest):
        pools, arrays = forest.pools, forest.carriage.arrays
        self._counts = pools.counts.numpy().copy()
        self._pieces: list[_Piece] = []
        used = np.flatnonzero(pools.level.numpy() != kernels.UNUSED)
        for struct, names in ((pools, OF_TETRAHEDRA), (arrays, CARRIED_BY_TETRAHEDRA)):
            self._keep(struct, names, int(used[-1]) + 1)
        for struct, names in ((pools, OF_NODES), (arrays, CARRIED_BY_NODES)):
            self._keep(struct, names, int(self._counts[kernels.NODE_TOP]))
            self._keep(struct, names, forest.virtual_count, start=pools.node_limit)
        self._keep(pools, ("free_pairs",), int(self._counts[kernels.FREE_PAIRS]))
        self._keep(pools, ("leaves", "leaf_tets"), int(self._counts[kernels.LEAVES]))
        self._keep(pools, ("void_leaves",), pools.void_count)
        self._keep(arrays, ("impulse",), 1)

    def restore(self, forest: DeviceForest) -> None:
        present = forest.pools.counts.numpy()
        leaves, known = int(present[kernels.LEAVES]), int(self._counts[kernels.LEAVES])
        if leaves > known:
            forest.pools.leaf_tets[known:leaves].assign(forest.padding(known, leaves))
        for struct, names in (
            (forest.pools, (*OF_TETRAHEDRA, *OF_NODES)),
            (forest.carriage.arrays, (*CARRIED_BY_TETRAHEDRA, *CARRIED_BY_NODES)),
        ):
            for name in names:
                getattr(struct, name).fill_(_UNUSED.get(name, 0))
        for piece in self._pieces:
            piece.write()
        counts = self._counts.copy()
        # Rounds are counted on, so that what was touched in later ones is not taken for new.
        counts[kernels.STAMP] = present[kernels.STAMP]
        forest.pools.counts.assign(counts)

    def _keep(self, struct: Any, names: tuple[str, ...], count: int, start: int = 0) -> None:
        for name in names:
            array = getattr(struct, name)
            if count and array.size:
                self._pieces.append(_Piece(array, start, wp.clone(array[start : start + count])))
