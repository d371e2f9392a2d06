"""All local frames that tetrahedra of a forest can have, and what each hands on to its children."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from warp_corot.discretization.elements import frame_keys, frame_table
from warp_corot.kernels.tables.shapes import FRAME_SHIFT
from warp_corot.mesh.bisection import children, far_end, path_tetrahedra
from warp_corot.mesh.lattice import LATTICE_BITS


class FrameTable(NamedTuple):
    """Attributes:

    frames: Proper frames Q, float64 [n_frames, 3, 3].
    bits: What is in a shape code besides the level, by key of the frame (``elements.frame_keys``), int32.
    of_children: The same of both children of an element, by its frame and type, int32 [n_frames, 3, 2].
    """

    frames: npt.NDArray[np.float64]
    bits: npt.NDArray[np.int32]
    of_children: npt.NDArray[np.int32]

    def codes(self, lattice: np.ndarray, tets: np.ndarray, level: np.ndarray) -> npt.NDArray[np.int32]:
        """``elements.shape_codes`` by this table, int32 [n]."""
        return self.bits[frame_keys(lattice, tets, level)] | level


@functools.cache
def all_frames() -> FrameTable:
    """The frames of all descendants of a cube: bisected, one of each frame and type, until none is new."""
    lattice = np.indices((2, 2, 2), np.int32).reshape(3, -1).T << LATTICE_BITS
    tets = path_tetrahedra((1, 1, 1), (2, 2, 2))
    key = _keys(lattice, tets, 0)
    born: dict[tuple[int, int], tuple[int, int]] = {}
    seen = set(key.tolist())
    level = 0
    while len(tets):
        kind = level % 3
        ends = lattice[tets[:, [0, far_end(kind)]]]
        middle = len(lattice) + np.arange(len(tets), dtype=np.int32)
        lattice = np.concatenate([lattice, ends.sum(axis=1, dtype=np.int32) // 2])
        below = children(tets, middle, kind).reshape(-1, 4)
        keys_below = _keys(lattice, below, level + 1)
        for parent, (first, second) in zip(key.tolist(), keys_below.reshape(-1, 2).tolist(), strict=True):
            born[parent, kind] = (first, second)
        level += 1
        seen |= set(keys_below.tolist())
        _, one_of_each = np.unique(keys_below, return_index=True)
        new = [n for n in one_of_each.tolist() if (int(keys_below[n]), level % 3) not in born]
        tets, key = below[new], keys_below[new]
    bits, frames = frame_table(np.array(sorted(seen)))
    of_children = np.zeros((len(frames), 3, 2), np.int32)
    for (parent, kind), pair in born.items():
        of_children[bits[parent] >> FRAME_SHIFT, kind] = bits[list(pair)]
    return FrameTable(frames, bits, of_children)


def _keys(lattice: np.ndarray, tets: np.ndarray, level: int) -> np.ndarray:
    return frame_keys(lattice, tets, np.full(len(tets), level, np.int32))
