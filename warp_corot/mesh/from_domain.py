"""The mesh of a domain: grown, cut at the surface, numbered."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..checks import checked_count
from ..device import checked_device
from ..errors import InputError
from .adapt import Grown, Wishes, grow
from .cut import inside_shares, label_shares, merged
from .forest import Field, TetForest
from .lattice import checked_cell_size, checked_level, volume_shares
from .numbering import in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual
from .tree import Tree

if TYPE_CHECKING:
    from ..domain import Domain

#: What share of the number of tetrahedra asked for is aimed at, which is enough, and after how many meshes any is.
NEAR, NEAR_ENOUGH = 0.95, 0.8
MOST_MESHES = 8


def mesh_domain(
    domain: Domain,
    cell_size: float,
    max_level: int,
    surface_error: float | None,
    min_level: int,
    refine_where: Field | None,
    field: Field | None,
    field_tolerance: float,
    target_elements: int | None,
    sliver: float,
    device: str | wp.Device | None,
) -> TetForest:
    """See `TetForest.from_domain`."""
    where = checked_device(domain.device if device is None else device)
    _check(cell_size, min_level, max_level, surface_error, field_tolerance, target_elements, sliver)
    error = 0.0 if surface_error is None else float(surface_error)

    def meshed(level: int, surface_error: float) -> TetForest:
        lowest = min(min_level, level)
        wishes = Wishes(surface_error, lowest, level, refine_where, field, float(field_tolerance))
        return _finished(grow(domain, float(cell_size), wishes, where), domain, float(cell_size), sliver)

    if target_elements is None:
        return meshed(max_level, error)
    return _of_size(meshed, target_elements, min_level, max_level, error, float(cell_size))


def _of_size(
    meshed: Callable[[int, float], TetForest],
    target: int,
    min_level: int,
    max_level: int,
    error: float,
    cell_size: float,
) -> TetForest:
    """The mesh of at most so many tetrahedra whose surface is off by no more than need be."""
    found = _by_error(lambda surface_error: meshed(max_level, surface_error), target, error, cell_size)
    return _by_level(meshed, target, min_level, max_level, error, cell_size) if found is None else found


def _by_error(meshed: Callable[[float], TetForest], target: int, least: float, cell_size: float) -> TetForest | None:
    """The same among meshes of one greatest level; None if all have more.

    Begins with few, for which a mesh takes no time, and goes on by the secant of the logarithms: the number goes about
    inversely with the surface error, and less where the levels end.
    """
    best: TetForest | None = None
    tried: list[tuple[float, float]] = []  # logarithms of the error and of the number over the one asked for
    low, high = np.log(least) if least > 0 else -np.inf, np.log(0.5 * cell_size)
    slope, error = -1.0, max(high, low)
    for _ in range(MOST_MESHES):
        try:
            mesh = meshed(float(np.exp(error)))
        except _EmptyError:
            return None
        count = len(mesh.tets)
        if count <= target:
            high = error
            best = mesh if best is None or count > len(best.tets) else best
            if count >= NEAR_ENOUGH * target or error <= low:
                break
        else:
            low = error
        if best is None:
            return None
        tried.append((error, float(np.log(count / (NEAR * target)))))
        if len(tried) > 1:
            (e0, n0), (e1, n1) = tried[-2:]
            if e1 < e0 and abs(n1 - n0) < 0.01:  # all of the surface is at the last level
                break
            slope = float(np.clip((n1 - n0) / (e1 - e0), -2.0, -0.25))
        error = max(error - tried[-1][1] / slope, low)
        if not low <= error < high:
            error = 0.5 * (low + high) if np.isfinite(low) else high - 1.0
    return best


def _by_level(
    meshed: Callable[[int, float], TetForest],
    target: int,
    min_level: int,
    max_level: int,
    error: float,
    cell_size: float,
) -> TetForest:
    """The finest of meshes of fewer levels, for numbers so small that curvature says nothing yet."""
    found: TetForest | None = None
    for level in range(min_level, max_level + 1):
        try:
            finer = meshed(level, error)
        except _EmptyError:
            if level == max_level:
                raise
            continue
        if len(finer.tets) > target:
            break
        found = finer
    if found is None:
        raise InputError(
            f"target_elements is {target}; at the coarsest, level {level} of cells of {cell_size:g} m, there are "
            f"already {len(finer.tets)} tetrahedra"
        )
    return found


class _EmptyError(InputError):
    """No element holds anything of the body."""


def _check(cell_size, min_level, max_level, surface_error, field_tolerance, target, sliver) -> None:
    checked_cell_size(cell_size)
    checked_level(min_level, "min_level")
    checked_level(max_level, "max_level")
    if min_level > max_level:
        raise InputError(f"min_level is {min_level}, above max_level, which is {max_level}")
    if surface_error is not None and not (np.isfinite(surface_error) and surface_error > 0):
        raise InputError(f"surface_error is {surface_error}; it must be a positive length in metres, or None")
    if not field_tolerance >= 0:
        raise InputError(f"field_tolerance is {field_tolerance}; it must not be negative")
    if target is not None:
        checked_count(target, "target_elements", 1)
    if not 0 <= sliver < 1:
        raise InputError(f"sliver is {sliver}; it must be a share of an element's volume, from 0 to below 1")


def _finished(grown: Grown, domain: Domain, cell_size: float, sliver: float) -> TetForest:
    holds = (grown.phi[grown.tree.tets] < 0).any(axis=1)
    tree = live_or_void(grown.tree, holds)
    tree, _ = pruned(tree, (tree.first_child < 0) & ~holds)
    if not len(tree.leaves):
        raise _EmptyError(
            f"the body comes out empty: no tetrahedron of cells of {cell_size:g} m holds any of it, "
            "with bounds " + " to ".join(str(np.round(b, 6).tolist()) for b in np.asarray(domain.bounds))
        )
    tree, fill = _without_slivers(tree, grown.phi, sliver)
    order = with_virtual(in_order_of_leaves(tree), tree, grown.lattice)
    ends, tree = renumbered(order, grown.ends, tree)
    phi = grown.phi[order]
    forest = TetForest(
        grown.cells, cell_size, grown.origin, grown.lattice[order], ends, tree, domain.up_axis, phi=phi, fill=fill
    )
    if not domain.label_names:
        return forest
    node_labels = np.asarray(domain.labels_at(forest.lattice_points, nearest=True), np.int32)
    labels = _element_labels(phi[forest.tets], node_labels[forest.tets], len(domain.label_names))
    return replace(forest, labels=labels, node_labels=node_labels, label_names=tuple(domain.label_names))


def _without_slivers(tree: Tree, phi: np.ndarray, sliver: float) -> tuple[Tree, np.ndarray]:
    """The tree with leaves that hold too little made void, and what share of itself each other leaf stands for."""
    leaves = tree.leaves
    volume = volume_shares(tree.leaf_levels)
    share = inside_shares(phi[tree.leaf_tets])
    small = share < sliver
    if not small.any():
        return tree, share
    held, given_up = merged(tree.leaf_tets, share * volume, small)
    live = np.zeros(len(tree.level), bool)
    live[leaves[~given_up]] = True
    return live_or_void(tree, live), (held / volume)[~given_up]


def _element_labels(values: np.ndarray, labels: np.ndarray, count: int) -> np.ndarray:
    """The label that takes most of each element."""
    first_inside = np.argmax(values < 0, axis=1)
    found = labels[np.arange(len(labels)), first_inside]
    mixed = np.flatnonzero(((labels != found[:, None]) & (values < 0)).any(axis=1))
    found[mixed] = np.argmax(label_shares(values[mixed], labels[mixed], count), axis=1)
    return found.astype(np.int32)
