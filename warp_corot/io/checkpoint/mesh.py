"""Meshes in checkpoints."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from warp_corot.mesh import TetForest, TetMesh, Tree
from warp_corot.mesh.growing.detail import Detail
from warp_corot.mesh.tree import UniformTree

#: Fields of surfaces that are finer than their mesh.
DETAIL = ("points", "tets", "phi", "labels", "sharp_points", "sharp_triangles")
#: Fields of trees.
OF_TREE = tuple(field.name for field in dataclasses.fields(Tree))
#: Fields of forests that were made from a domain, or cut.
OF_DOMAIN = ("phi", "fill", "labels", "node_labels", "snap")


def pack_mesh(mesh: TetForest | TetMesh) -> dict[str, Any]:
    """A mesh as a tree of plain values and arrays."""
    if isinstance(mesh, TetMesh):
        names = ("points", "tets", "labels", "up_axis", "repaired", "label_names")
        return {"kind": "general"} | {name: getattr(mesh, name) for name in names}
    place = {"up_axis": mesh.up_axis, "cells": mesh.cells, "cell_size": mesh.cell_size, "origin": mesh.origin}
    if (level := box_level(mesh)) is not None:
        return {"kind": "box", "level": level} | place
    return place | {
        "kind": "forest",
        "lattice": mesh.lattice,
        "node_ends": mesh.node_ends,
        "tree": {name: getattr(mesh.tree, name) for name in OF_TREE},
        "detail": None if mesh.detail is None else {name: getattr(mesh.detail, name) for name in DETAIL},
        "of_domain": {name: getattr(mesh, name) for name in OF_DOMAIN},
        "label_names": mesh.label_names,
    }


def box_level(mesh: TetForest) -> int | None:
    """The level with which ``TetForest.box`` makes a forest; None: it makes no such forest."""
    if not isinstance(mesh.tree, UniformTree) or any(getattr(mesh, name) is not None for name in OF_DOMAIN):
        return None
    box = TetForest.box(mesh.cells, mesh.cell_size, mesh.tree.depth, origin=mesh.origin, up_axis=mesh.up_axis)
    same = np.array_equal(box.lattice, mesh.lattice) and np.array_equal(box.tree.leaf_tets, mesh.tree.leaf_tets)
    return mesh.tree.depth if same else None


def unpack_mesh(packed: dict[str, Any]) -> TetForest | TetMesh:
    """The mesh that ``pack_mesh`` packed."""
    up_axis = packed["up_axis"]
    if packed["kind"] == "general":
        labels = {"labels": packed["labels"], "label_names": packed["label_names"]}
        mesh = TetMesh(packed["points"], packed["tets"], up_axis=up_axis, **labels)
        mesh.repaired = packed["repaired"]
        return mesh
    cells, origin, size = tuple(packed["cells"]), tuple(packed["origin"]), packed["cell_size"]
    if packed["kind"] == "box":
        return TetForest.box(cells, size, packed["level"], origin=origin, up_axis=up_axis)
    tree, lattice, ends = Tree(**packed["tree"]), packed["lattice"], packed["node_ends"]
    _check_tree(tree, lattice, ends)
    detail = None if packed["detail"] is None else Detail(**packed["detail"])
    names = tuple(packed["label_names"])
    return TetForest(
        cells, size, origin, lattice, ends, tree, up_axis, label_names=names, detail=detail, **packed["of_domain"]
    )


def _check_tree(tree: Tree, lattice: np.ndarray, ends: np.ndarray) -> None:
    """Check that all indices are in range, since kernels do not check.

    Raises:
        ValueError: An index or a shape is wrong.
    """
    count, nodes = len(tree.tets), len(lattice)
    shapes = [tree.tets.shape, lattice.shape, ends.shape, tree.level.shape, tree.parent.shape, tree.first_child.shape]
    if shapes != [(count, 4), (nodes, 3), (nodes, 2), *[(count,)] * 3]:
        raise ValueError(f"the tree's arrays have the shapes {shapes}")
    bounds = ((tree.tets, 0, nodes), (ends, -1, nodes), (tree.parent, -1, count), (tree.first_child, -2, count - 1))
    cut = np.zeros(count, np.int32) if tree.cut is None else tree.cut
    if cut.shape != (count,):
        raise ValueError(f"the tree's cuts have the shape {cut.shape}")
    for array, least, most in (*bounds, (tree.level, 0, 64), (cut, 0, 32)):
        if array.dtype.kind != "i" or (array.size and not (array.min() >= least and array.max() < most)):
            raise ValueError("an index of the tree is out of range")
