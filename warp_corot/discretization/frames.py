"""All possible local frames of a forest's tetrahedra, and the frames of their children and parents."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.tables.shapes import FRAME_SHIFT, GRADIENT, MIRROR_BIT, SQRT2
from warp_corot.mesh.bisection import children, far_end, path_tetrahedra
from warp_corot.mesh.lattice import LATTICE_BITS

PART = 1 << 16


def parts(count: int) -> Iterator[slice]:
    """The elements a part at a time, so that intermediate arrays stay in the cache and take little memory."""
    return (slice(start, min(start + PART, count)) for start in range(0, count, PART))


# The columns of an element's frame as sums of its nodes' positions over h, by type. For type 2 the two diagonals are
# without their root, so that all frames have entries of -1, 0 and 1.
_COLUMNS = np.array(GRADIENT)
_COLUMNS[2, :2] *= SQRT2
_KEYS = 3**9


def frame_keys(lattice: np.ndarray, tets: np.ndarray, level: np.ndarray) -> np.ndarray:
    """A number for the Maubach frame of each element, int32 [n]. Arguments as in ``FrameTable.codes``."""
    # A frame's nine entries of -1, 0, 1 are the digits of one number, a weighted sum of one number for each node. Those
    # wrap around in 32 bits, but their sum does not: it is at most 2**16 * 3**9 / 2.
    place = lattice @ np.array([1, 27, 729], np.int32)
    weights = np.rint(np.array([1, 3, 9]) @ _COLUMNS).astype(np.int32)
    key = np.empty(len(tets), np.int32)
    for part in parts(len(tets)):
        kind, halvings = level[part] % 3, level[part] // 3
        total = np.einsum("tn,tn->t", place[tets[part]], weights[kind])
        key[part] = (total >> (LATTICE_BITS - halvings)) + _KEYS // 2
    return key


def frame_table(used: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For frames with these ascending keys: the part of a shape code by key, int32; and the proper frames Q."""
    frames = ((used[:, None] // 3 ** np.arange(9)) % 3 - 1.0).reshape(-1, 3, 3)
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    mirrored = np.linalg.det(frames) < 0
    frames[mirrored, :, 2] *= -1.0
    bits = np.zeros(_KEYS, np.int32)
    bits[used] = (mirrored.astype(np.int32) << MIRROR_BIT) | (np.arange(len(used), dtype=np.int32) << FRAME_SHIFT)
    return bits, frames


class FrameTable(NamedTuple):
    """Attributes:

    frames: Proper frames Q, float64 [n_frames, 3, 3].
    bits: The part of a shape code besides the level, by key of the frame (``elements.frame_keys``), int32.
    of_children: The same of both children of an element, by its frame and type, int32 [n_frames, 3, 2].
    of_parents: The same of its parent, by its frame and type, and whether it is the first or second child, int32
        [n_frames, 3, 2].
    """

    frames: npt.NDArray[np.float64]
    bits: npt.NDArray[np.int32]
    of_children: npt.NDArray[np.int32]
    of_parents: npt.NDArray[np.int32]

    def codes(self, lattice: np.ndarray, tets: np.ndarray, level: np.ndarray) -> npt.NDArray[np.int32]:
        """The shape codes of forest elements: level, and the local frame that bisection gave each.

        Args:
            lattice: Lattice coordinates of the mesh's nodes, int32 [N, 3].
            tets: The elements' nodes, int32 [n, 4].
            level: int32 [n].

        Returns:
            One integer per element (level, mirrored or not, frame), int32 [n].
        """
        key = frame_keys(lattice, tets, level)
        for part in parts(len(tets)):
            key[part] = self.bits[key[part]] | level[part]
        return key


@functools.cache
def all_frames() -> FrameTable:
    """The frames of all descendants of a cube: one element of each frame and type is bisected until no frame is new."""
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
    of_children, of_parents = np.zeros((2, len(frames), 3, 2), np.int32)
    for (parent, kind), pair in born.items():
        of_children[bits[parent] >> FRAME_SHIFT, kind] = bits[list(pair)]
        for which, child in enumerate(pair):
            of_parents[bits[child] >> FRAME_SHIFT, (kind + 1) % 3, which] = bits[parent]
    return FrameTable(frames, bits, of_children, of_parents)


class DeviceFrames(NamedTuple):
    """``FrameTable.frames`` and ``of_parents`` on a device."""

    frames: wp.array
    of_parents: wp.array


def device_frames(device: wp.Device) -> DeviceFrames:
    """The tables on a device. All its forests share them."""
    return _device_frames(device.alias)


@functools.cache
def _device_frames(alias: str) -> DeviceFrames:
    table = all_frames()
    return DeviceFrames(
        wp.array(table.frames, dtype=wp.mat33, device=alias), wp.array(table.of_parents, dtype=wp.int32, device=alias)
    )


def _keys(lattice: np.ndarray, tets: np.ndarray, level: int) -> np.ndarray:
    return frame_keys(lattice, tets, np.full(len(tets), level, np.int32))
