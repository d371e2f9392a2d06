"""The data of a forest for the planner's kernels, and the tables that they share."""

from __future__ import annotations

import functools
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.discretization.frames import device_frames
from warp_corot.kernels.elements.elements import ForestElements
from warp_corot.kernels.plan.tree import Tree
from warp_corot.kernels.tables.subtree import GROUP_NODES, LEAVES, group_leaves, group_nodes
from warp_corot.mesh import TetForest
from warp_corot.mesh.bisection import corner_leaves
from warp_corot.mesh.tree import UniformTree


def tree_of(forest: TetForest, elements: ForestElements, rotation_level: int | None) -> Tree:
    """A forest that never changes, read in place if the device can.

    Args:
        elements: Its leaves on the device, in one world or more.
        rotation_level: Level at which rotations are shared; None: kernels read only the identity of elements above the
            leaves.
    """
    device, source = elements.nodes.device, forest.tree
    tree = Tree()
    counts = wp.array([len(forest.tets), forest.node_count], dtype=wp.int32, device=device)
    tree.leaf_count, tree.node_count = counts[:1], counts[1:]
    tree.named = int(forest.node_count == len(forest.lattice))
    tree.leaf_tets = elements.nodes
    tree.parent_code = device_frames(device).of_parents
    if isinstance(source, UniformTree):
        tree.uniform = 1
        level = source.depth if rotation_level is None else min(rotation_level, source.depth)
        tree.corner_leaves, tree.corner_nodes = (
            wp.vec4i(*places) for places in zip(*corner_leaves(level, source.depth), strict=True)
        )
        return tree
    tree.roots = int(np.count_nonzero(source.parent < 0))
    tree.leaves, tree.parent = (_read(values, wp.int32, device) for values in (source.leaves, source.parent))
    if source.cut is not None:
        tree.cut = _read(source.cut, wp.int32, device)
    if rotation_level is not None:
        tree.tets = _read(source.tets, wp.vec4i, device)
    return tree


class Places(NamedTuple):
    """The leaf and the local node at each place, by shape; see ``kernels.tables.subtree``.

    Attributes:
        subtree, group: Leaf and its node for each node of a subtree or group, negative past the last, vec2i [3, 10] and
            [3, 40].
        leaves, group_leaves: The inverse tables, vec4i [3, 8] and [3, 64].
    """

    subtree: wp.array
    group: wp.array
    leaves: wp.array
    group_leaves: wp.array


@functools.cache
def places_on(alias: str) -> Places:
    """The tables on a device. All its plans share them."""
    group = np.full((3, GROUP_NODES, 2), -1)
    for shape in range(3):
        given = group_nodes(shape)
        group[shape, : len(given)] = given
    tables = (
        ([subtree_nodes(shape) for shape in range(3)], wp.vec2i),
        (group, wp.vec2i),
        (LEAVES, wp.vec4i),
        ([group_leaves(shape) for shape in range(3)], wp.vec4i),
    )
    return Places(*(wp.array(np.array(values), dtype=dtype, device=alias, ndim=2) for values, dtype in tables))


def subtree_nodes(shape: int) -> list[tuple[int, int]]:
    """Where to read a subtree's ten nodes: (leaf of 8, local node of 4) for each."""
    named = [(node, (at, n)) for at, leaf in enumerate(LEAVES[shape]) for n, node in enumerate(leaf)]
    return [next(place for other, place in named if other == node) for node in range(10)]


def _read(values: npt.NDArray[np.integer], dtype: type, device: wp.Device) -> wp.array:
    """An array of integers for launches that only read it; on the CPU it shares the given array's memory."""
    values = np.ascontiguousarray(values, dtype=np.int32)
    return wp.array(values, dtype=dtype, device=device, copy=not values.flags.writeable)
