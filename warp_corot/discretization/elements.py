"""The arrays of a mesh on the device, in the form that kernels read; and all possible local frames of a forest's
tetrahedra, with those of their children and parents."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.elements.elements import ForestElements, GeneralElements
from warp_corot.kernels.tables.shapes import FRAME_SHIFT, GRADIENT, MIRROR_BIT, SQRT2
from warp_corot.mesh import TetForest, TetMesh
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


def device_frames(device: wp.Device) -> tuple[wp.array, wp.array]:
    """``FrameTable.frames`` and ``of_parents`` on a device. All its forests share them."""
    return _device_frames(device.alias)


@functools.cache
def _device_frames(alias: str) -> tuple[wp.array, wp.array]:
    frames, parents = all_frames().frames, all_frames().of_parents
    return wp.array(frames, dtype=wp.mat33, device=alias), wp.array(parents, dtype=wp.int32, device=alias)


def _keys(lattice: np.ndarray, tets: np.ndarray, level: int) -> np.ndarray:
    return frame_keys(lattice, tets, np.full(len(tets), level, np.int32))


Mesh = TetForest | TetMesh
#: Structs of elements, and their kinds.
Elements: TypeAlias = "ForestElements | GeneralElements"
ElementKind: TypeAlias = type

E = TypeVar("E", bound="ForestElements | GeneralElements")
S = TypeVar("S")


def element_kind(mesh: Mesh) -> ElementKind:
    """The Warp struct that holds a mesh's elements: ``ForestElements`` or ``GeneralElements``."""
    return ForestElements if isinstance(mesh, TetForest) else GeneralElements


def device_elements(mesh: Mesh, device: wp.Device, worlds: int = 1) -> Elements:
    """The mesh's elements as an instance of its ``element_kind`` on ``device``, world after world."""
    if not isinstance(mesh, TetForest):
        return general_elements(mesh, device, worlds)
    code = all_frames().codes(mesh.lattice, mesh.tets, mesh.levels)
    elements = ForestElements()
    elements.nodes = wp.array(in_worlds(mesh.tets, worlds, len(mesh.points)), dtype=wp.vec4i, device=device)
    elements.targets = elements.nodes
    elements.code = wp.array(repeated(code, worlds), dtype=wp.int32, device=device)
    elements.frames = device_frames(device)[0]
    elements.size = edge_lengths(mesh, device)
    return elements


def in_worlds(indices: np.ndarray, worlds: int, count: int) -> np.ndarray:
    """Indices of one world repeated for all, each world's larger by ``count``; negative ones stay.

    Args:
        indices: int32 [n, …].
        worlds: Number of worlds.
        count: Number of items in one world that the indices refer to.

    Returns:
        int32 [worlds * n, …].
    """
    if worlds == 1:
        return indices
    shift = (np.arange(worlds, dtype=np.int32) * np.int32(count)).reshape(-1, *[1] * indices.ndim)
    return np.where(indices < 0, indices, indices + shift).reshape(-1, *indices.shape[1:]).astype(np.int32, copy=False)


def repeated(values: np.ndarray, worlds: int) -> np.ndarray:
    """Values of one world, [n, …], once for each: [worlds * n, …]."""
    return values if worlds == 1 else np.tile(values, (worlds, *[1] * (values.ndim - 1)))


def with_targets(elements: E, targets: wp.array) -> E:
    """The same elements, whose forces are added at other places, vec4i [T]."""
    other = copied(elements)
    other.targets = targets
    return other


def copied(struct: S) -> S:
    """Another instance of a Warp struct, with the same arrays and numbers."""
    other = type(struct)()
    cast("Any", other).assign(struct)
    return other


def edge_lengths(forest: TetForest, device: wp.Device) -> wp.array:
    """The edge length h of elements [m] by level div 3, float32."""
    return wp.array(forest.cell_size * 0.5 ** np.arange(LATTICE_BITS + 1), dtype=wp.float32, device=device)


def general_elements(mesh: TetMesh, device: wp.Device, worlds: int = 1) -> GeneralElements:
    """Elements of a general mesh, with the inverse of their rest matrix."""
    x = mesh.points[mesh.tets]
    rest = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    elements = GeneralElements()
    elements.nodes = wp.array(in_worlds(mesh.tets, worlds, len(mesh.points)), dtype=wp.vec4i, device=device)
    elements.targets = elements.nodes
    elements.rest_inverse = wp.array(repeated(np.linalg.inv(rest), worlds), dtype=wp.mat33, device=device)
    elements.volume = wp.array(repeated(mesh.volumes, worlds), dtype=wp.float32, device=device)
    return elements
