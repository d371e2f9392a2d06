"""From a mesh to what the kernels read: flat arrays on the device."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, TypeAlias, TypeVar

import numpy as np
import warp as wp

from warp_corot.kernels.elements.elements import ForestElements, GeneralElements
from warp_corot.kernels.tables.shapes import FRAME_SHIFT, GRADIENT, MIRROR_BIT, SQRT2
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.forest import LATTICE_BITS

Mesh = TetForest | TetMesh
#: Structs of elements, and their kinds.
Elements: TypeAlias = "ForestElements | GeneralElements"
ElementKind: TypeAlias = type

E = TypeVar("E", bound="ForestElements | GeneralElements")

PART = 1 << 16


def parts(count: int) -> Iterator[slice]:
    """The elements a part at a time: what is made on the way stays in the cache, and little memory is asked for."""
    return (slice(start, min(start + PART, count)) for start in range(0, count, PART))


def element_kind(mesh: Mesh) -> ElementKind:
    """The Warp struct that holds a mesh's elements: ``ForestElements`` or ``GeneralElements``."""
    return ForestElements if isinstance(mesh, TetForest) else GeneralElements


def device_elements(mesh: Mesh, device: wp.Device, worlds: int = 1) -> Elements:
    """The mesh's elements as an instance of its ``element_kind`` on ``device``, world after world."""
    if isinstance(mesh, TetForest):
        return _forest_elements(mesh, mesh.tets, mesh.levels, device, worlds)
    return general_elements(mesh, device, worlds)


def forest_elements(forest: TetForest, chosen: np.ndarray, device: wp.Device, worlds: int = 1) -> ForestElements:
    """Any tetrahedra of the tree, leaves or ancestors, as forest elements.

    Args:
        chosen: Indices into the tree [n].
    """
    return _forest_elements(forest, *forest.tree.rows(chosen), device, worlds)


def in_worlds(indices: np.ndarray, worlds: int, count: int) -> np.ndarray:
    """Indices of one world repeated for all, each world's larger by ``count``; negative ones stay.

    Args:
        indices: int32 [n, …].
        worlds: How many worlds.
        count: How many things, of which these are indices, there are in one world.

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


def with_targets(elements: E, targets: np.ndarray) -> E:
    """The same elements with their forces added elsewhere, int32 [T, 4]."""
    other: Any = type(elements)()
    other.assign(elements)
    other.targets = wp.array(targets, dtype=wp.vec4i, device=elements.nodes.device)
    return other


def _forest_elements(
    forest: TetForest, tets: np.ndarray, level: np.ndarray, device: wp.Device, worlds: int
) -> ForestElements:
    code, frames = shape_codes(forest.lattice, tets, level)
    elements = ForestElements()
    elements.nodes = wp.array(in_worlds(tets, worlds, len(forest.points)), dtype=wp.vec4i, device=device)
    elements.targets = elements.nodes
    elements.code = wp.array(repeated(code, worlds), dtype=wp.int32, device=device)
    elements.frames = wp.array(frames, dtype=wp.mat33, device=device)
    elements.size = wp.array(forest.cell_size * 0.5 ** np.arange(LATTICE_BITS + 1), dtype=wp.float32, device=device)
    return elements


# The columns of an element's frame as sums of its nodes' positions over h, by type. For type 2 the two diagonals are
# without their root, so that all frames have entries of -1, 0 and 1.
_COLUMNS = np.array(GRADIENT)
_COLUMNS[2, :2] *= SQRT2
_KEYS = 3**9


def shape_codes(lattice: np.ndarray, tets: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What sets forest elements apart besides size and nodes: the local frame each was born with.

    Args:
        lattice: Lattice coordinates of the mesh's nodes, int32 [N, 3].
        tets: The elements' nodes, int32 [n, 4].
        level: int32 [n].

    Returns:
        One integer per element (level, mirrored or not, frame), int32 [n], and the table of proper frames Q,
        float64 [n_frames, 3, 3]: columns are the axes of ``kernels.tables.shapes.GRADIENT``, the third turned
        round where the Maubach frame is left-handed.
    """
    key = frame_keys(lattice, tets, level)
    bits, frames = frame_table(np.flatnonzero(np.bincount(key, minlength=_KEYS)))
    for part in parts(len(tets)):
        key[part] = bits[key[part]] | level[part]
    return key, frames


def frame_keys(lattice: np.ndarray, tets: np.ndarray, level: np.ndarray) -> np.ndarray:
    """A number for the Maubach frame of each element, int32 [n]. Arguments as in ``shape_codes``."""
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
    """Frames of these keys, ascending: what each puts into a shape code, by key, int32; and the proper frames Q."""
    frames = ((used[:, None] // 3 ** np.arange(9)) % 3 - 1.0).reshape(-1, 3, 3)
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    mirrored = np.linalg.det(frames) < 0
    frames[mirrored, :, 2] *= -1.0
    bits = np.zeros(_KEYS, np.int32)
    bits[used] = (mirrored.astype(np.int32) << MIRROR_BIT) | (np.arange(len(used), dtype=np.int32) << FRAME_SHIFT)
    return bits, frames


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
