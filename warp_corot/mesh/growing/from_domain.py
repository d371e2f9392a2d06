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
from warp_corot.inputs.loading import MESHING, load
from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.lattice import check_levels, checked_cell_size, checked_level
from warp_corot.mesh.numbering import in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual
from warp_corot.mesh.tree import LIVE, Tree

from .adapt import Closer, grow
from .budget import NEAR, NEAR_ENOUGH, Budget, chosen_meshes
from .detail import Detail
from .judging import Field, Wishes
from .labelling import labels_of, labels_of_nodes
from .resolved import Resolved
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
    load(MESHING, where)
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
        node_labels = np.asarray(domain.labels_at(forest.lattice_points, nearest=True), np.int32)
        labels = labels_of(resolved, child, stays[leaves[~given_up]], forest, domain)
        forest = replace(forest, labels=labels, node_labels=node_labels, label_names=tuple(domain.label_names))
    return forest, left_out


def _detail(resolved: Resolved, child: np.ndarray, domain: Domain) -> Detail:
    """The leaves of a mesh in a grown forest that hold the surface, and borders of labels."""
    grown, points = resolved.grown, resolved.points(slice(None))
    tets = grown.tree.tets[child == LIVE]
    wanted = (grown.phi[tets] < 0).any(axis=1)
    if not domain.label_names:
        tets = tets[wanted & (grown.phi[tets] >= 0).any(axis=1)]
        return Detail.of(points, tets, grown.phi, None).sharpened(domain)
    tets = tets[wanted]
    labels = labels_of_nodes(resolved, tets, domain)
    own = labels[tets]
    tets = tets[(grown.phi[tets] >= 0).any(axis=1) | (own != own[:, :1]).any(axis=1)]
    return Detail.of(points, tets, grown.phi, labels)
