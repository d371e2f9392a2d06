"""The state of a changing forest at one time."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.remesh import pools as kernels
from warp_corot.kernels.remesh.state import NO_ROW

from .fields import CARRIED_BY_NODES, CARRIED_BY_TETRAHEDRA, OF_NODES, OF_TETRAHEDRA

if TYPE_CHECKING:
    from .pools import DeviceForest

#: What places hold where there is nothing, if it is not zero.
_UNUSED = {"level": int(kernels.UNUSED), "row": int(NO_ROW)}

_CARRIED = (*CARRIED_BY_NODES, *CARRIED_BY_TETRAHEDRA, "impulse")


class Piece(NamedTuple):
    """One stretch of an array of ``kernels.remesh.pools.Pools`` or ``kernels.remesh.state.Carried``."""

    name: str
    start: int
    values: wp.array


@dataclass(frozen=True, eq=False)
class Snapshot:
    """A copy of what is in use of all arrays, on the device.

    Attributes:
        counts: ``Pools.counts``, int32.
        pieces: The stretches.
    """

    counts: npt.NDArray[np.int32]
    pieces: tuple[Piece, ...]

    @classmethod
    def of(cls, forest: DeviceForest) -> Snapshot:
        """The present state."""
        counts = forest.pools.counts.numpy().copy()
        stretches = ((name, start, count) for name, start, count in _in_use(forest, counts) if count)
        pieces = (
            Piece(n, start, wp.clone(array_of(forest, n)[start : start + count])) for n, start, count in stretches
        )
        return cls(counts, tuple(pieces))

    def restore(self, forest: DeviceForest) -> None:
        """Write it back into the same arrays."""
        pools = forest.pools
        present = pools.counts.numpy()
        leaves, known = int(present[kernels.LEAVES]), int(self.counts[kernels.LEAVES])
        if leaves > known:
            pools.leaf_tets[known:leaves].assign(forest.padding(known, leaves))
        for name in (*OF_TETRAHEDRA, *OF_NODES, *CARRIED_BY_TETRAHEDRA, *CARRIED_BY_NODES):
            array_of(forest, name).fill_(_UNUSED.get(name, 0))
        for name, start, values in self.pieces:
            array_of(forest, name)[start : start + len(values)].assign(values)
        counts = self.counts.copy()
        # Rounds are counted on, so that what was touched in later ones is not taken for new.
        counts[kernels.STAMP] = present[kernels.STAMP]
        pools.counts.assign(counts)


def array_of(forest: DeviceForest, name: str) -> wp.array:
    """An array of the pools or of what is carried."""
    return getattr(forest.carriage.arrays if name in _CARRIED else forest.pools, name)


def _in_use(forest: DeviceForest, counts: npt.NDArray[np.int32]) -> Iterator[tuple[str, int, int]]:
    """Names of arrays, where stretches of them that are in use begin, and how long these are."""
    used = int(np.flatnonzero(forest.pools.level.numpy() != kernels.UNUSED)[-1]) + 1
    for name in (*OF_TETRAHEDRA, *CARRIED_BY_TETRAHEDRA):
        if array_of(forest, name).size:
            yield name, 0, used
    for name in (*OF_NODES, *CARRIED_BY_NODES):
        yield name, 0, int(counts[kernels.NODE_TOP])
        yield name, forest.pools.node_limit, forest.virtual_count
    yield "free_pairs", 0, int(counts[kernels.FREE_PAIRS])
    for name in ("leaves", "leaf_tets"):
        yield name, 0, int(counts[kernels.LEAVES])
    yield "void_leaves", 0, forest.pools.void_count
    yield "impulse", 0, 1
