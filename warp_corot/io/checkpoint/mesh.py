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


def pack_mesh(mesh: TetForest | TetMesh, prefix: str, arrays: dict[str, np.ndarray]) -> dict[str, Any]:
    """Put a mesh into arrays whose names begin with ``prefix``; returns the remaining data for JSON."""
    if isinstance(mesh, TetMesh):
        arrays[prefix + "points"], arrays[prefix + "tets"] = mesh.points, mesh.tets
        if mesh.labels is not None:
            arrays[prefix + "labels"] = mesh.labels
        names = list(mesh.label_names)
        return {"kind": "general", "up_axis": mesh.up_axis, "repaired": mesh.repaired, "label_names": names}
    place = {"up_axis": mesh.up_axis, "cells": mesh.cells, "cell_size": mesh.cell_size, "origin": mesh.origin}
    if (level := box_level(mesh)) is not None:
        return {"kind": "box", "level": level} | place
    arrays[prefix + "lattice"], arrays[prefix + "node_ends"] = mesh.lattice, mesh.node_ends
    for name in OF_TREE:
        if (array := getattr(mesh.tree, name)) is not None:
            arrays[f"{prefix}tree.{name}"] = array
    if mesh.detail is not None:
        found = {name: getattr(mesh.detail, name) for name in DETAIL}
        arrays.update((f"{prefix}detail.{name}", array) for name, array in found.items() if array is not None)
    of_domain = [name for name in OF_DOMAIN if getattr(mesh, name) is not None]
    for name in of_domain:
        arrays[f"{prefix}domain.{name}"] = getattr(mesh, name)
    return {"kind": "forest", "of_domain": of_domain, "label_names": mesh.label_names} | place


def box_level(mesh: TetForest) -> int | None:
    """The level with which ``TetForest.box`` makes a forest; None: it makes no such forest."""
    if not isinstance(mesh.tree, UniformTree) or any(getattr(mesh, name) is not None for name in OF_DOMAIN):
        return None
    box = TetForest.box(mesh.cells, mesh.cell_size, mesh.tree.depth, origin=mesh.origin, up_axis=mesh.up_axis)
    same = np.array_equal(box.lattice, mesh.lattice) and np.array_equal(box.tree.leaf_tets, mesh.tree.leaf_tets)
    return mesh.tree.depth if same else None


def unpack_mesh(described: dict[str, Any], prefix: str, arrays: dict[str, np.ndarray]) -> TetForest | TetMesh:
    """Return the mesh that ``pack_mesh`` stored."""
    if described["kind"] == "general":
        mesh = TetMesh(
            arrays[prefix + "points"],
            arrays[prefix + "tets"],
            up_axis=described["up_axis"],
            labels=arrays.get(prefix + "labels"),
            label_names=described.get("label_names", ()),
        )
        mesh.repaired = described["repaired"]
        return mesh
    if described["kind"] == "box":
        cells, origin = tuple(described["cells"]), tuple(described["origin"])
        up_axis, level = described["up_axis"], described["level"]
        return TetForest.box(cells, described["cell_size"], level, origin=origin, up_axis=up_axis)
    tets, level, parent, first_child = (arrays[f"{prefix}tree.{name}"] for name in OF_TREE if name != "cut")
    tree = Tree(tets, level, parent, first_child, arrays.get(f"{prefix}tree.cut"))
    x, y, z = described["cells"]
    a, b, c = described["origin"]
    lattice, ends = arrays[prefix + "lattice"], arrays[prefix + "node_ends"]
    _check_tree(tree, lattice, ends)
    detail: dict[str, Any] = {name: arrays[key] for name in DETAIL if (key := f"{prefix}detail.{name}") in arrays}
    of_domain: dict[str, Any] = {name: arrays[f"{prefix}domain.{name}"] for name in described["of_domain"]}
    names = tuple(described["label_names"])
    up_axis = described["up_axis"]
    of_domain["detail"] = Detail(**detail) if detail else None
    return TetForest(
        (x, y, z), described["cell_size"], (a, b, c), lattice, ends, tree, up_axis, label_names=names, **of_domain
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
