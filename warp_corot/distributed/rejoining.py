"""Divided meshes put together: each rank's arrays, and the whole mesh that they make."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.mesh import TetForest, TetMesh, Tree
from warp_corot.mesh.tree import LIVE, VOID

from .divided_mesh import DividedForest, DividedTetMesh

Arrays = dict[str, npt.NDArray[Any]]


def pack_part(mesh: DividedForest | DividedTetMesh, arrays: Arrays) -> dict[str, Any]:
    """Put a rank's part of a divided mesh into arrays; returns what is the same on all ranks."""
    numbers = mesh.numbers
    counted = np.flatnonzero(numbers.counted)
    found: Arrays = {"nodes": numbers.nodes, "elements": numbers.elements[counted]}
    described: dict[str, Any] = {"up_axis": mesh.up_axis, "label_names": list(mesh.label_names)}
    described |= {"element_count": mesh.element_count, "node_count": numbers.node_count}
    if mesh.labels is not None:
        found["labels"] = mesh.labels[counted]
    if isinstance(mesh, DividedForest) and mesh.is_box:
        described |= {"level": int(mesh.tree.leaf_levels[0])}
    elif isinstance(mesh, DividedForest):
        assert numbers.tree is not None
        assert numbers.lattice is not None
        found |= pack_tree(mesh, mesh.tree.leaves[counted], numbers.tree, numbers.lattice)
        if mesh.fill is not None:
            found["fill"] = mesh.fill[counted]
    else:
        found |= {"coordinates": mesh.points, "tets": numbers.nodes[mesh.tets[counted]]}
        found |= {f"set.{name}": mask for name, mask in mesh.node_sets.items()}
    if isinstance(mesh, DividedForest):
        described |= {"cells": mesh.cells, "cell_size": mesh.cell_size, "origin": mesh.origin}
    arrays |= found
    return described


def rejoined(described: dict[str, Any], parts: Sequence[Arrays]) -> TetForest | TetMesh:
    """The whole mesh, from the arrays of all parts.

    Void tetrahedra of a forest that no part needs are not there again.
    """
    elements, nodes = described["element_count"], described["node_count"]
    names, up_axis = tuple(described["label_names"]), described["up_axis"]
    labels, fill = (_of_elements(parts, name, elements) for name in ("labels", "fill"))
    if "cells" not in described:
        points, tets = np.zeros((nodes, 3)), np.zeros((elements, 4), np.int32)
        sets = {name[4:]: np.zeros(nodes, bool) for name in parts[0] if name.startswith("set.")}
        for part in parts:
            points[part["nodes"]], tets[part["elements"]] = part["coordinates"], part["tets"]
            for name, mask in sets.items():
                mask[part["nodes"]] = part[f"set.{name}"]
        return TetMesh(points, tets, up_axis=up_axis, labels=labels, label_names=names, node_sets=sets)
    place = described["cells"], described["cell_size"], described["origin"]
    if "level" in described:
        return TetForest.box(*place[:2], described["level"], origin=place[2], up_axis=up_axis)
    lattice, ends, tree = joined_trees(parts)
    return TetForest(*place, lattice, ends, tree, up_axis, fill=fill, labels=labels, label_names=names)


def pack_tree(forest: TetForest, live: npt.NDArray[Any], rows: npt.NDArray[Any], points: npt.NDArray[Any]) -> Arrays:
    """The arrays of a forest's tree and lattice points.

    Args:
        forest: The forest.
        live: Those of its leaves that count; others become void.
        rows, points: The numbers of its tetrahedra of all levels, and of its lattice points, in the whole one.
    """
    tree, child = forest.tree, forest.tree.first_child.copy()
    child[child < 0] = VOID
    child[live] = LIVE
    return {
        "points": points,
        "lattice": forest.lattice,
        "ends": _numbered(forest.node_ends, points),
        "rows": rows,
        "tets": points[tree.tets],
        "level": tree.level,
        "parent": _numbered(tree.parent, rows),
        "child": _numbered(child, rows),
    }


def joined_trees(parts: Sequence[Arrays]) -> tuple[npt.NDArray[Any], npt.NDArray[Any], Tree]:
    """The lattice points, their ends, and the tree with the tetrahedra that any part has, each in the order of the
    numbers in the whole forest."""
    rows = np.unique(np.concatenate([part["rows"] for part in parts]))
    points = np.unique(np.concatenate([part["points"] for part in parts]))
    tets, level = np.zeros((len(rows), 4), np.int32), np.zeros(len(rows), np.int32)
    parent, child = np.full(len(rows), -1, np.int32), np.full(len(rows), VOID, np.int32)
    lattice, ends = np.zeros((len(points), 3), np.int32), np.full((len(points), 2), -1, np.int32)
    for part in parts:
        here, there = np.searchsorted(rows, part["rows"]), np.searchsorted(points, part["points"])
        tets[here], level[here] = np.searchsorted(points, part["tets"]), part["level"]
        parent[here] = _places(part["parent"], rows)
        # What one part bisects or has as a leaf is void in parts that do not need it.
        child[here] = np.maximum(child[here], _places(part["child"], rows))
        lattice[there] = part["lattice"]
        known = (part["ends"] >= 0).all(axis=1)
        ends[there[known]] = np.sort(_places(part["ends"][known], points), axis=1)
    return lattice, ends, Tree(tets, level, parent, child)


def _of_elements(parts: Sequence[Arrays], name: str, count: int) -> npt.NDArray[Any] | None:
    if name not in parts[0]:
        return None
    found = np.zeros(count, parts[0][name].dtype)
    for part in parts:
        found[part["elements"]] = part[name]
    return found


def _numbered(values: npt.NDArray[Any], numbers: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Numbers in the whole mesh in place of those in a part; negative values stay."""
    return np.where(values < 0, values, numbers[values])


def _places(values: npt.NDArray[Any], numbers: npt.NDArray[Any]) -> npt.NDArray[np.int32]:
    """Places in ascending numbers; negative values stay."""
    return np.where(values < 0, values, np.searchsorted(numbers, values)).astype(np.int32)
