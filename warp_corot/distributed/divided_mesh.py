"""A rank's part of a mesh: cut out of the whole one, and put together with the others to the whole one again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from warp_corot.contact.skin import has_own_surface
from warp_corot.discretization.elements import Mesh
from warp_corot.errors import InputError
from warp_corot.mesh import TetForest, TetMesh, Tree
from warp_corot.mesh.tree import LIVE, VOID, in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual

from .partition import Partition

Ints = npt.NDArray[np.int32]
Bools = npt.NDArray[np.bool_]
Arrays = dict[str, npt.NDArray[Any]]


@dataclass(frozen=True, eq=False)
class Numbers:
    """The numbers that a part's nodes and elements have in the whole mesh.

    Attributes:
        nodes, elements: int32 or int64 [n] and [t] of one world; elements ascend.
        owner: The rank that moves each of the nodes, int32 [n].
        counted: Whether this rank counts the element's energy, bool [t].
        node_count: Number of nodes of the whole mesh.
        tree, lattice: The numbers that the tetrahedra of all levels and the lattice points of a forest have in the
            whole one, int32; None: they are not known.
    """

    nodes: npt.NDArray[Any]
    elements: npt.NDArray[Any]
    owner: Ints
    counted: Bools
    node_count: int
    tree: Ints | None = None
    lattice: Ints | None = None

    def in_worlds(self, worlds: int) -> npt.NDArray[np.int64]:
        """The numbers of the nodes among those of all worlds of the whole mesh, int64 [worlds * n]."""
        return (self.nodes + self.node_count * np.arange(worlds, dtype=np.int64)[:, None]).ravel()


class DividedMesh:
    """A rank's part of a mesh: the elements around the nodes that the rank moves.

    Elements and nodes are those of this part; some are copies of other ranks' elements, and the nodes of these.

    Attributes:
        numbers: Their numbers in the whole mesh.
        element_count: Number of elements of the whole mesh.
        bounds: Lowest and highest coordinates of the whole mesh [m], float64 [2, 3].
        smallest_volume: Volume of the smallest element of the whole mesh [m^3].
        is_box: Whether the whole mesh is a box, uniformly bisected.
        is_embedded: Whether the whole mesh was made from a domain, whose surface lies within the tetrahedra.
    """

    numbers: Numbers
    element_count: int
    bounds: npt.NDArray[np.float64]
    smallest_volume: float
    is_box: bool = False
    is_embedded: bool = False
    points: npt.NDArray[np.float64]
    tets: Ints
    volumes: npt.NDArray[np.float64]

    def _belong(self, of_whole: dict[str, Any]) -> None:
        """Set this part's place in the whole mesh: the attributes above."""
        self.__dict__.update(of_whole)
        if "smallest_volume" not in of_whole:
            self.__dict__["smallest_volume"] = float(np.min(self.volumes))

    def check_whole(self) -> None:
        """Check that this part is the whole, as on one rank.

        Raises:
            InputError: It is not.
        """
        if len(self.tets) < self.element_count:
            raise InputError(
                f"the mesh is a part, {len(self.tets)} of {self.element_count} elements, of a mesh that several ranks "
                "hold; only warp_corot.distributed can compute and record it"
            )

    def check_expression(self, expression: str) -> None:
        """Check that an expression can be evaluated at the nodes of one part.

        Raises:
            InputError: It asks for nearest nodes.
        """
        if "nearest" in expression:
            raise InputError("nearest needs the whole mesh, and this rank holds a part; use sphere or box")


class DividedForest(DividedMesh, TetForest):
    """A rank's part of a forest."""

    def __init__(self, *arrays: Any, of_whole: dict[str, Any], **others: Any):
        TetForest.__init__(self, *arrays, **others)
        self._belong(of_whole)

    def refine(self, leaves: npt.ArrayLike) -> TetForest:
        """A forest in parts cannot be refined, because a rank would bisect without its neighbours.

        Raises:
            InputError: Always.
        """
        raise InputError("a forest in parts cannot be refined; make it finer")


class DividedTetMesh(DividedMesh, TetMesh):
    """A rank's part of a general mesh."""

    def __init__(self, *arrays: Any, of_whole: dict[str, Any], element_groups: Ints, **others: Any):
        TetMesh.__init__(self, *arrays, **others)
        self.element_groups = element_groups
        self._belong(of_whole)


# --- cut out of the whole --------------------------------------------------------------------------------------------


def whole_of(mesh: Mesh) -> dict[str, Any]:
    """What parts of a mesh know of it, if the rank keeps nothing else: attributes of ``DividedMesh``."""
    used = mesh.points[np.unique(mesh.tets)]
    return {
        "element_count": len(mesh.tets),
        "bounds": np.stack([used.min(axis=0), used.max(axis=0)]),
        "smallest_volume": float(np.min(mesh.volumes)),
        "is_embedded": isinstance(mesh, TetForest) and has_own_surface(mesh),
    }


def divide(
    mesh: Mesh, division: Partition, rank: int, whole: dict[str, Any] | None = None
) -> DividedForest | DividedTetMesh:
    """A rank's part of a mesh: the elements that it needs, in their order.

    Args:
        mesh, division: The whole mesh, and its division.
        rank: The rank.
        whole: What ``whole_of`` gives; None: the rank keeps the whole mesh, too, and the tree keeps, as void ones,
            tetrahedra of which the part has no leaf.
    """
    kept = division.needed(mesh, rank)
    elements, groups = np.flatnonzero(kept).astype(np.int32), division.sharing[kept]
    own: dict[str, Any] = {"element_count": len(mesh.tets)} if whole is None else dict(whole)
    labels = None if mesh.labels is None else mesh.labels[kept]
    given: dict[str, Any] = {"up_axis": mesh.up_axis, "labels": labels, "label_names": mesh.label_names}

    def place(nodes: Ints, **others: Ints) -> dict[str, Any]:
        counted = division.rank_of_element[elements] == rank
        numbers = Numbers(nodes, elements, division.rank_of_node[nodes], counted, len(mesh.points), **others)
        return own | {"numbers": numbers}

    if isinstance(mesh, TetForest):
        *arrays, fill, order, stays = branches_of(mesh, kept, prunes=whole is not None)
        nodes = order[: int(arrays[2].leaf_tets.max()) + 1]
        on_grid = mesh.cells, mesh.cell_size, mesh.origin, *arrays
        of_whole = place(nodes, tree=stays, lattice=order)
        return DividedForest(*on_grid, fill=fill, leaf_groups=groups, of_whole=of_whole, **given)
    nodes = np.unique(mesh.tets[kept]).astype(np.int32)
    number = np.full(len(mesh.points), -1, np.int32)
    number[nodes] = np.arange(len(nodes), dtype=np.int32)
    given["node_sets"] = {name: mask[nodes] for name, mask in mesh.node_sets.items()}
    place_of, tets = mesh.points[nodes], number[mesh.tets[kept]]
    return DividedTetMesh(place_of, tets, element_groups=groups, of_whole=place(nodes), **given)


def branches_of(forest: TetForest, kept: Bools, *, prunes: bool) -> tuple[Any, ...]:
    """Some leaves of a forest with the tree above them.

    Args:
        forest: The whole one.
        kept: The leaves, bool [T].
        prunes: Whether the tree loses tetrahedra of which the part has no leaf; otherwise they stay as void ones.

    Returns:
        The arguments ``lattice``, ``ends`` and ``tree`` of a ``TetForest``; its fill, or None; and the numbers of its
        lattice points and of its tetrahedra of all levels in the whole one, int32.
    """
    live = np.zeros(len(forest.tree.level), bool)
    live[forest.tree.leaves[kept]] = True
    tree, stays = live_or_void(forest.tree, live), np.arange(len(live))
    if prunes:
        tree, stays = pruned(tree, tree.first_child == VOID)
    order = with_virtual(in_order_of_leaves(tree), tree, forest.lattice)
    ends, tree = renumbered(order, forest.node_ends, tree)
    fill = None if forest.fill is None else forest.fill[kept]
    return forest.lattice[order], ends, tree, fill, order.astype(np.int32), stays.astype(np.int32)


# --- put together ----------------------------------------------------------------------------------------------------


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
        live = mesh.tree.leaves[counted]
        found |= pack_tree(mesh.lattice, mesh.node_ends, mesh.tree, live, numbers.tree, numbers.lattice)
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


def pack_tree(lattice: Ints, ends: Ints, tree: Tree, live: Ints, rows: Any, points: Any) -> Arrays:
    """The arrays of a forest's tree and lattice points.

    Args:
        lattice, ends, tree: As for ``TetForest``.
        live: Those of its leaves that count; others become void.
        rows, points: The numbers of its tetrahedra of all levels, and of its lattice points, in the whole one.
    """
    child = tree.first_child.copy()
    child[child < 0] = VOID
    child[live] = LIVE
    return {
        "points": points,
        "lattice": lattice,
        "ends": _numbered(ends, points),
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
