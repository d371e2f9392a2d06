"""From a mesh to what the kernels read: flat arrays on the device."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from .kernels.elements import ForestElements, GeneralElements
from .kernels.shapes import FRAME_SHIFT, MIRROR_BIT
from .mesh import TetForest, TetMesh
from .mesh.forest import LATTICE_BITS

Mesh = TetForest | TetMesh


def element_kind(mesh: Mesh) -> Any:
    """The Warp struct that holds a mesh's elements: ``ForestElements`` or ``GeneralElements``."""
    return ForestElements if isinstance(mesh, TetForest) else GeneralElements


def device_elements(mesh: Mesh, device: wp.Device) -> Any:
    """The mesh's elements as an instance of its ``element_kind`` on ``device``."""
    if isinstance(mesh, TetForest):
        return forest_elements(mesh, mesh.tree.leaves, device)
    return general_elements(mesh, device)


def forest_elements(forest: TetForest, chosen: np.ndarray, device: wp.Device) -> Any:
    """Any tetrahedra of the tree, leaves or ancestors, as forest elements.

    Args:
        chosen: Indices into the tree [n].
    """
    tets, level = forest.tree.tets[chosen], forest.tree.level[chosen]
    code, frames = shape_codes(forest.lattice[tets], level)
    elements = ForestElements()
    elements.nodes = wp.array(tets, dtype=wp.vec4i, device=device)
    elements.code = wp.array(code, dtype=wp.int32, device=device)
    elements.frames = wp.array(frames, dtype=wp.mat33, device=device)
    elements.size = wp.array(forest.cell_size * 0.5 ** np.arange(LATTICE_BITS + 1), dtype=wp.float32, device=device)
    return elements


def shape_codes(corners: np.ndarray, level: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What sets forest elements apart besides size and nodes: the local frame each was born with.

    Args:
        corners: Lattice coordinates of the four nodes, int [n, 4, 3].
        level: int [n].

    Returns:
        One integer per element (level, mirrored or not, frame), int32 [n], and the table of proper frames Q,
        float64 [n_frames, 3, 3]: columns are the axes of ``kernels.shapes.GRADIENT``, the third turned round where the
        Maubach frame is left-handed.
    """
    shape = level % 3
    half_edge = (1 << (LATTICE_BITS - 1 - level // 3))[:, None]
    x0, x1, x2, x3 = (corners[:, n] for n in range(4))
    # The columns at rest, in half edge lengths, a diagonal before its root is taken: -2, 0 or 2.
    diagonal = (shape == 2)[:, None]
    middle = (shape == 1)[:, None]
    first = np.where(diagonal, 2 * (x0 - x2), x1 - x0)
    second = np.where(diagonal, 2 * (x1 - x2), x2 - x1)
    third = np.where(diagonal, 2 * (x3 - x2), np.where(middle, 2 * x3 - x0 - x2, x3 - x2))
    signs = np.stack([first, second, third], axis=2) // (2 * half_edge[:, :, None])  # [n, row, column] of -1, 0, 1
    digits = (signs + 1).reshape(-1, 9)
    key = digits @ 3 ** np.arange(9)
    used = np.flatnonzero(np.bincount(key, minlength=3**9))
    index = np.zeros(3**9, np.int32)
    index[used] = np.arange(len(used), dtype=np.int32)
    frames = ((used[:, None] // 3 ** np.arange(9)) % 3 - 1.0).reshape(-1, 3, 3)
    frames /= np.linalg.norm(frames, axis=1, keepdims=True)
    mirrored = np.linalg.det(frames) < 0
    frames[mirrored, :, 2] *= -1.0
    which = index[key]
    code = level | (mirrored[which].astype(np.int32) << MIRROR_BIT) | (which << FRAME_SHIFT)
    return code.astype(np.int32), frames


def general_elements(mesh: TetMesh, device: wp.Device) -> Any:
    """Elements of a general mesh, with the inverse of their rest matrix."""
    x = mesh.points[mesh.tets]
    rest = np.swapaxes(x[:, 1:] - x[:, :1], 1, 2)
    elements = GeneralElements()
    elements.nodes = wp.array(mesh.tets, dtype=wp.vec4i, device=device)
    elements.rest_inverse = wp.array(np.linalg.inv(rest), dtype=wp.mat33, device=device)
    elements.volume = wp.array(mesh.volumes, dtype=wp.float32, device=device)
    return elements
