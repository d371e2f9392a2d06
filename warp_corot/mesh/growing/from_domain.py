"""The mesh of a domain: grown, cut at the surface, numbered."""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_count, checked_number, shown
from warp_corot.inputs.device import checked_device
from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.lattice import check_levels, checked_cell_size, checked_level
from warp_corot.mesh.numbering import in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual
from warp_corot.mesh.tree import LIVE, Tree

from .adapt import Closer, grow
from .budget import NEAR, NEAR_ENOUGH, Budget, chosen_meshes
from .cut import label_shares
from .detail import Detail
from .growth import lattice_spacing
from .judging import Field, Wishes
from .resolved import LEAST, MOST_POINTS, Resolved, points_within
from .slivers import without_slivers
from .strays import strays

if TYPE_CHECKING:
    from warp_corot.domain import Domain

#: How often a cube is bisected by default.
MAX_LEVEL_BY_DEFAULT = 12
#: More elements are refused: their number would not fit into the arrays of a forest.
MOST_ELEMENTS = 100_000_000
#: With more root cubes in the body's box for each element that is allowed, no body fits.
CUBES_PER_ELEMENT = 1000
#: Number of meshes after which one with nearly the requested elements is good enough.
MOST_MESHES = 4
#: Number of points of an element at which labels are sampled, if few elements have several.
MOST_POINTS_EACH = 64
#: How finely a body is sampled below the mesh's levels: surface error over an element's edge, and tetrahedra of all
#: levels.
CLOSER_ERROR, CLOSER_ELEMENTS = 0.2, 4_000_000


def mesh_domain(
    domain: Domain,
    cell_size: float | None,
    max_level: int | None,
    surface_error: float | None,
    min_level: int,
    refine_where: Field | None,
    field: Field | None,
    field_tolerance: float,
    target_elements: int | None,
    min_layers: float,
    detail: int,
    sliver: float,
    device: str | wp.Device | None,
) -> TetForest:
    """See `TetForest.from_domain`."""
    where = checked_device(domain.device if device is None else device)
    _check(cell_size, target_elements, min_layers, detail, sliver)
    wishes = checked_wishes(max_level, surface_error, min_level, refine_where, field, field_tolerance)
    if target_elements is not None:
        size = None if cell_size is None else float(cell_size)
        _check_cubes(domain, size, target_elements)
        error = wishes.surface_error
        budget = Budget(target_elements, size, min_level, max_level, error, float(min_layers), wishes)
        return _of_size(domain, budget, sliver, where)
    if cell_size is None:
        raise InputError("cell_size is None; it must be a length in metres where target_elements is not given")
    closer = Closer(detail, CLOSER_ERROR, CLOSER_ELEMENTS) if detail else None
    grown = grow(domain, float(cell_size), wishes, where, closer)
    resolved = Resolved(grown, float(cell_size), domain if detail else None)
    forest, left_out = _finished(resolved, resolved.as_wished(), domain, sliver)
    _say(left_out)
    if not detail:
        return forest
    return replace(forest, detail=_detail(resolved, grown.tree.first_child, domain))


def _of_size(domain: Domain, budget: Budget, sliver: float, device: wp.Device) -> TetForest:
    """The mesh with at most the given number of elements."""
    meshes = chosen_meshes(domain, budget, sliver, device)
    best: TetForest | None = None
    counted, threshold, said = 0, 0.0, ""
    for _ in range(MOST_MESHES if meshes else 0):
        assert meshes is not None
        forest, left_out = _finished(meshes.resolved, meshes.child, domain, sliver)
        found = len(forest.tets)
        if found <= budget.target and (best is None or found > len(best.tets)):
            best, threshold, said = forest, meshes.threshold, left_out
        if NEAR_ENOUGH * budget.target <= found <= budget.target or meshes.count == counted:
            break
        # Slivers that were kept to connect pieces were not counted, and others may be given up in vain.
        counted = meshes.count
        meshes.choose(int(NEAR * budget.target * counted / found))
    if best is None:
        raise InputError(
            f"target_elements is {budget.target}; at the coarsest there are already more tetrahedra"
            + (f", of cells of {budget.cell_size:g} m" if budget.cell_size else "")
        )
    assert meshes is not None
    _say(said)
    return replace(best, detail=_detail(meshes.resolved, meshes.surface(threshold), domain))


def _check(cell_size: Any, target: Any, min_layers: Any, detail: Any, sliver: Any) -> None:
    if cell_size is not None:
        checked_cell_size(cell_size)
    checked_level(detail, "detail")
    if not 0 <= checked_number(min_layers, "min_layers") < np.inf:
        raise InputError(f"min_layers is {min_layers}; it must be a number of elements, 0 for no care")
    if target is not None:
        checked_count(target, "target_elements", 1)
        if target > MOST_ELEMENTS:
            raise InputError(f"target_elements is {target}; it must be at most {MOST_ELEMENTS}")
    if not 0 <= checked_number(sliver, "sliver") < 1:
        raise InputError(f"sliver is {sliver}; it must be a share of an element's volume, from 0 to below 1")


def checked_wishes(
    max_level: int | None,
    surface_error: float | None,
    min_level: int,
    refine_where: Field | None,
    field: Field | None,
    field_tolerance: float,
) -> Wishes:
    """The required fineness, of arguments of `TetForest.from_domain`.

    Raises:
        InputError: One is out of its range.
    """
    for name, function in (("refine_where", refine_where), ("field", field)):
        if function is not None and not callable(function):
            raise InputError(f"{name} is {shown(function)}; it must be a function of points [n, 3], or None")
    checked_level(min_level, "min_level")
    check_levels(min_level, max_level)
    if surface_error is not None and not 0 < checked_number(surface_error, "surface_error", "m") < np.inf:
        raise InputError(f"surface_error is {surface_error}; it must be a positive length in metres, or None")
    if not checked_number(field_tolerance, "field_tolerance") >= 0:
        raise InputError(f"field_tolerance is {field_tolerance}; it must not be negative")
    error = 0.0 if surface_error is None else float(surface_error)
    deepest = MAX_LEVEL_BY_DEFAULT if max_level is None else max_level
    return Wishes(error, min_level, deepest, refine_where, field, float(field_tolerance))


def _check_cubes(domain: Domain, size: float | None, target: int) -> None:
    """Check that cubes of a size [m] are not hopelessly many for a number of elements.

    Raises:
        InputError: They are.
    """
    cubes = 0.0 if size is None else float(np.prod(np.ceil(np.ptp(domain.bounds, axis=0) / size)))
    if cubes > CUBES_PER_ELEMENT * target:
        raise InputError(
            f"cell_size is {size:g} m, of which the body's box has {cubes:.3g} cubes; target_elements={target} is too "
            "few for them: it must be more, or cell_size larger"
        )


def _say(left_out: str) -> None:
    if left_out:
        warnings.warn(left_out, UserWarning, stacklevel=4)


def filled_tree(resolved: Resolved, child: np.ndarray) -> tuple[Tree, np.ndarray]:
    """The tree of a mesh in a grown forest without what holds nothing, and its tetrahedra's numbers in the forest."""
    tree, stays = resolved.tree_of(child)
    tree, kept = pruned(tree, (tree.first_child < 0) & (resolved.held[stays] <= 0.0))
    return tree, stays[kept]


def empty_error(domain: Domain, cell_size: float) -> InputError:
    """The error of a mesh without elements."""
    return InputError(
        f"the body comes out empty: no tetrahedron of cells of {cell_size:g} m holds any of it, "
        "with bounds " + " to ".join(str(np.round(b, 6).tolist()) for b in np.asarray(domain.bounds))
    )


def _finished(resolved: Resolved, child: np.ndarray, domain: Domain, sliver: float) -> tuple[TetForest, str]:
    """A separate mesh from a grown forest, without empty and nearly empty elements, and what else it leaves out."""
    grown, cell_size = resolved.grown, resolved.cell_size
    tree, stays = filled_tree(resolved, child)
    if not len(tree.leaves):
        raise empty_error(domain, cell_size)
    leaves = tree.leaves
    held, given_up = without_slivers(
        tree.leaf_tets, resolved.held[stays[leaves]], resolved.volume[stays[leaves]], sliver
    )
    stray, left_out = strays(tree.leaf_tets, held, given_up, domain)
    given_up |= stray
    if given_up.any():
        live = np.zeros(len(tree.level), bool)
        live[leaves[~given_up]] = True
        tree = live_or_void(tree, live)
    fill = (held / resolved.volume[stays[leaves]])[~given_up]
    order = with_virtual(in_order_of_leaves(tree), tree, grown.lattice)
    ends, renamed = renumbered(order, grown.ends, tree)
    forest = TetForest(
        grown.cells,
        cell_size,
        grown.origin,
        grown.lattice[order],
        ends,
        renamed,
        domain.up_axis,
        phi=grown.phi[order],
        fill=fill,
    )
    if domain.label_names:
        labels = _labels(resolved, child, stays[leaves[~given_up]], domain)
        node_labels = np.asarray(domain.labels_at(forest.lattice_points, nearest=True), np.int32)
        forest = replace(forest, labels=labels, node_labels=node_labels, label_names=tuple(domain.label_names))
        forest = replace(forest, labels=_with_lost(forest, domain))
    return forest, left_out


def _with_lost(forest: TetForest, domain: Domain) -> np.ndarray:
    """Labels of elements; a label that no element has, but of which a point is known, gets the element that contains
    the point.
    """
    assert forest.labels is not None
    labels = forest.labels.copy()
    count = np.bincount(labels, minlength=len(domain.label_names) + 1)
    for number, name in enumerate(domain.label_names, start=1):
        point = None if count[number] else domain.point_in(name)
        if point is not None:
            (element,), _ = forest.embed(point[None])
            if count[labels[element]] > 1:
                count[labels[element]] -= 1
                labels[element] = number
    return labels


def _detail(resolved: Resolved, child: np.ndarray, domain: Domain) -> Detail:
    """The leaves of a mesh in a grown forest that hold the surface, and borders of labels."""
    grown = resolved.grown
    tets = grown.tree.tets[child == LIVE]
    wanted = (grown.phi[tets] < 0).any(axis=1)
    if not domain.label_names:
        tets = tets[wanted & (grown.phi[tets] >= 0).any(axis=1)]
        return Detail.of(_points(resolved, slice(None)), tets, grown.phi, None).sharpened(domain)
    tets = tets[wanted]
    labels = _labels_of_nodes(resolved, tets, domain)
    own = labels[tets]
    tets = tets[(grown.phi[tets] >= 0).any(axis=1) | (own != own[:, :1]).any(axis=1)]
    return Detail.of(_points(resolved, slice(None)), tets, grown.phi, labels)


def _points(resolved: Resolved, nodes: Any) -> np.ndarray:
    return np.asarray(resolved.grown.origin) + resolved.grown.lattice[nodes] * lattice_spacing(resolved.cell_size)


def _labels_of_nodes(resolved: Resolved, tets: np.ndarray, domain: Domain) -> np.ndarray:
    """Labels of the nodes of tetrahedra, int32, as many as there are lattice points."""
    found = np.zeros(len(resolved.grown.lattice), np.int32)
    used = np.unique(tets)
    found[used] = domain.labels_at(_points(resolved, used), nearest=True)
    return found


def _labels(resolved: Resolved, child: np.ndarray, elements: np.ndarray, domain: Domain) -> np.ndarray:
    """Labels of elements of the mesh.

    An element has the label that takes most of it. A label that would be in none has the element of which it takes
    most, unless that is another's only one.
    """
    grown, count = resolved.grown, len(domain.label_names)
    tets = grown.tree.tets[resolved.leaves]
    at_nodes = _labels_of_nodes(resolved, tets, domain)
    place = np.full(len(child), -1, np.int64)
    place[elements] = np.arange(len(elements))
    owner = place[resolved.owners(child)[resolved.leaves]]
    size = resolved.volume[resolved.leaves]
    values, own = grown.phi[tets], at_nodes[tets]
    alike = (own == own[:, :1]).all(axis=1)
    mixed = np.flatnonzero(~alike)
    shares = label_shares(values[mixed], own[mixed])
    row, label, share = _sampled_labels(resolved, resolved.leaves[mixed], own[mixed], shares, domain)
    keys = np.concatenate([owner[alike] * (count + 1) + own[alike, 0], owner[mixed[row]] * (count + 1) + label])
    weights = np.concatenate([(resolved.shares * size)[alike], share * size[mixed[row]]])
    there = np.concatenate([owner[alike], owner[mixed[row]]]) >= 0
    found, index = np.unique(keys[there], return_inverse=True)
    total = np.bincount(index.ravel(), weights[there])
    whose, label = found // (count + 1), found % (count + 1)
    labels = np.zeros(len(elements), np.int32)
    order = np.argsort(total, kind="stable")
    labels[whose[order]] = label[order]
    for lost in np.setdiff1d(label[label > 0], labels):
        mine = order[label[order] == lost][::-1]
        free = np.bincount(labels, minlength=count + 1)[labels[whose[mine]]] > 1
        if free.any():
            labels[whose[mine[np.argmax(free)]]] = lost
    return labels


def _sampled_labels(
    resolved: Resolved, elements: np.ndarray, own: np.ndarray, shares: np.ndarray, domain: Domain
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The fraction of elements that each label fills, by random points; labels at corners get at least a small
    fraction.

    Args:
        resolved: The forest.
        elements: The elements in which labels vary [n].
        own: Labels of their nodes [n, 4].
        shares: The fractions if borders were halfway between nodes; see `label_shares` [n, 4].
        domain: The body.

    Returns:
        Places in ``elements``, labels and fractions, [m] each, without zero fractions.
    """
    rng, stride = np.random.default_rng(0), len(domain.label_names) + 1
    each = int(np.clip(MOST_POINTS // max(len(elements), 1), 1, MOST_POINTS_EACH))
    seen = []
    for part in np.array_split(np.arange(len(elements)), len(elements) * each // MOST_POINTS + 1):
        points = points_within(resolved.grown, elements[part], resolved.cell_size, each, rng).reshape(-1, 3)
        labels = domain.labels_at(points)
        seen.append((np.repeat(part, each) * stride + labels)[labels > 0])
    keys, counts = np.unique(np.concatenate(seen), return_counts=True)
    total = np.bincount(keys // stride, counts, len(elements))
    sampled = counts * (shares.sum(axis=1) / np.maximum(total, 1.0))[keys // stride]
    at_nodes = np.where(total[:, None] > 0, LEAST * shares, shares)
    row, node = np.nonzero(at_nodes)
    keys, place = np.unique(np.concatenate([keys, row * stride + own[row, node]]), return_inverse=True)
    found = np.zeros(len(keys))
    np.maximum.at(found, place.ravel(), np.concatenate([sampled, at_nodes[row, node]]))
    kept = found > 0.0
    return keys[kept] // stride, keys[kept] % stride, found[kept]
