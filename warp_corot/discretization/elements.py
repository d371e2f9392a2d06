"""The arrays of a mesh on the device, in the form that kernels read."""

from __future__ import annotations

from typing import Protocol, TypeAlias, TypeVar, cast

import numpy as np
import warp as wp

from warp_corot.kernels.elements.elements import ForestElements, GeneralElements
from warp_corot.mesh import TetForest, TetMesh
from warp_corot.mesh.forest import LATTICE_BITS

from .frames import all_frames, device_frames

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
    cast("Assigned", other).assign(struct)
    return other


class Assigned(Protocol):
    """The common members of Warp structs."""

    def assign(self, other: object) -> None: ...


def _forest_elements(
    forest: TetForest, tets: np.ndarray, level: np.ndarray, device: wp.Device, worlds: int
) -> ForestElements:
    code = all_frames().codes(forest.lattice, tets, level)
    elements = ForestElements()
    elements.nodes = wp.array(in_worlds(tets, worlds, len(forest.points)), dtype=wp.vec4i, device=device)
    elements.targets = elements.nodes
    elements.code = wp.array(repeated(code, worlds), dtype=wp.int32, device=device)
    elements.frames = device_frames(device).frames
    elements.size = edge_lengths(forest, device)
    return elements


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
