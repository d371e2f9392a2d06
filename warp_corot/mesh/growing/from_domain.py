"""The mesh of a domain: grown, cut at the surface, numbered; with a given number of tetrahedra or by given criteria.

With a number, the size of the cubes and the number of bisections are chosen together. The body is sampled once, in a
forest that is finer than the mesh. There every tetrahedron of every level has a need: the error of its piece of the
surface if it were not bisected [m], or a tenth of its edge if the body is thinner than a few elements. All tetrahedra
with a need above a threshold are bisected. The threshold is chosen to give the requested number, without another
evaluation of the body."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_device, checked_number, shown
from warp_corot.inputs.loading import MESHING, load
from warp_corot.mesh.forest import TetForest
from warp_corot.mesh.growing.fine_classification import Coarsening, Resolved
from warp_corot.mesh.growing.growth import Growing
from warp_corot.mesh.growing.labelling import labels_of, labels_of_nodes
from warp_corot.mesh.growing.refinement_criteria import GAP_ELEMENTS, THIN_NEED, Field, Wishes
from warp_corot.mesh.growing.slivers import strays, without_slivers
from warp_corot.mesh.lattice import check_levels, checked_cell_size, checked_level
from warp_corot.mesh.surfaces.bound import leaves_at
from warp_corot.mesh.surfaces.marching import Detail
from warp_corot.mesh.tree import LIVE, Tree, in_order_of_leaves, live_or_void, pruned, renumbered, with_virtual

if TYPE_CHECKING:
    import warp as wp

    from warp_corot.domain import Domain

#: The fractions of the requested number that are aimed at and that are enough; and the number of sizes of cubes after
#: which any is enough.
NEAR, NEAR_ENOUGH = 0.985, 0.905
MOST_CUBES = 4
#: Along flat sides nothing is bisected; then more sizes are tried, which takes little time.
MOST_CUBES_OF_BOXES = 7
#: A mesh with less than this share of the elements asked for gets other cubes before its elements are told apart.
FEW = 0.6
#: The assumed error of an element between such pieces, as a fraction of its edge.
GAP_NEED = 0.5
#: The thinner of two parts is bisected first: its need is larger by up to this fraction, by which a bisection shortens
#: elements. Thicknesses are rounded to this many steps, so that equally thin parts stay equal. Without, plates of two
#: layers are drawn with twice as many points, and their surfaces are farther off.
THINNEST_FIRST, THIN_STEPS = 0.26, 16
#: The forest is finer by this factor than the mesh's threshold, for the drawn surface; with many elements this is the
#: mesh's own. Thin parts have no finer elements than the mesh may need.
FINER_FOREST, FINER_THIN = 0.2, 0.4
#: The size of cubes gives this fraction of the elements when none is bisected: about six in a cube inside, four at the
#: surface. With more elements the surface needs a smaller fraction, so the fraction rises between two numbers of
#: elements.
UNBISECTED, UNBISECTED_OF_MANY = 1.0 / 6.0, 0.5
FEWER, MORE = 50_000, 1_000_000
#: If a forest of many elements has nothing left to bisect, smaller cubes should give this many times the requested
#: elements; half the size gives less than four times as many.
AMPLE, SLOW = 1.3, 2.0
#: How often cubes are bisected for the surface. Elements at the largest curvature are a fifth of a cube long; finer
#: ones would improve the rest of the surface little and shorten the time step. From this many elements on, too few are
#: at the surface for that. Thin parts may have finer ones.
MAX_LEVEL, MANY, MAX_LEVEL_THIN = 7, 300_000, 13
#: Each label of a scan gets at least this many elements, but none smaller than a voxel, before the surface gets any;
#: of all elements at most this share is for that.
LABEL_ELEMENTS, OF_LABELS = 64, 0.5
#: How finely the body is sampled: the first and the last surface error over a cube's edge, and the number of tetrahedra
#: of all levels for each requested one, or a fixed number if that is larger.
FIRST_ERROR, CLOSE_ERROR, CLOSE_LEVEL = 0.25, 0.01, 8
CLOSER_LEVELS, CLOSER_ERROR = 6, 0.2
CLOSE_ELEMENTS, CLOSE_ELEMENTS_OF_MANY = 5, 2
#: If there is room for fewer more elements than this, the body is not sampled finely, because the choice of places
#: would take too long.
LEAST_CLOSER = 1000


@dataclass(frozen=True)
class Budget:
    """The limits of a mesh with a given number of elements.

    Attributes:
        target: The largest number of elements; 0: as many as the wishes ask for.
        cell_size: Edge of a cube [m]; None: chosen.
        max_level: The largest level; None: chosen.
        min_layers: Number of elements through the thickness, if the total number allows.
        wishes: The least level, the user's functions, and the error below which the surface is not followed more
            closely, 0: as the number allows.
    """

    target: int
    cell_size: float | None
    max_level: int | None
    min_layers: float
    wishes: Wishes


def chosen_meshes(domain: Domain, budget: Budget, sliver: float, device: wp.Device) -> Coarsening | None:
    """The forest that contains a mesh with nearly the allowed number of elements, and this mesh.

    None if the coarsest has more.
    """
    best: Coarsening | None = None
    largest = 1.001 * float(np.ptp(domain.bounds, axis=0).max())
    suits = min(predicted_cell_size(domain, budget.target), largest)
    size = budget.cell_size or suits
    for trial in range(MOST_CUBES_OF_BOXES):
        last = trial >= MOST_CUBES - 1
        meshes = _of_cubes(domain, budget, size, suits, sliver, device)
        if meshes.has_more and (last or FEW * budget.target <= meshes.count < NEAR_ENOUGH * budget.target):
            meshes = meshes.told_apart(int(NEAR * budget.target))
        count = meshes.count
        if count <= budget.target and (best is None or count > best.count):
            best = meshes
        if budget.cell_size or NEAR_ENOUGH * budget.target <= count <= budget.target:
            break
        if budget.wishes.surface_error and count <= budget.target:
            break
        if last and meshes.has_more and count <= budget.target:
            break
        ratio = count / (NEAR * budget.target)
        exhausted = budget.target > MANY and not meshes.has_more
        factor = (ratio / AMPLE) ** (1.0 / SLOW) if exhausted else ratio ** (1.0 / 2.5)
        # A cube larger than the body would contain all of it.
        size = min(size * float(np.clip(factor, 0.5, 2.0)), largest)
    return best


def predicted_cell_size(domain: Domain, target: int) -> float:
    """The edge [m] of cubes that fill a body with about this number of elements."""
    from warp_corot.domain.reference import extent_of

    volume, area = extent_of(domain)
    way = float(np.clip(np.log(target / FEWER) / np.log(MORE / FEWER), 0.0, 1.0))
    unbisected = target * (UNBISECTED + way * (UNBISECTED_OF_MANY - UNBISECTED))
    low, high = 1e-6, 1.0
    longest = float(np.ptp(domain.bounds, axis=0).max())
    for _ in range(60):
        share = np.sqrt(low * high)
        size = share * longest
        if 6.0 * volume / size**3 + 4.0 * area / size**2 > unbisected:
            low = share
        else:
            high = share
    return float(high) * longest


def _of_cubes(
    domain: Domain,
    budget: Budget,
    size: float,
    suits: float,
    sliver: float,
    device: wp.Device,
) -> Coarsening:
    """The meshes of one size of cubes, with the largest allowed one chosen; if cubes are larger than the number needs,
    they have this many more levels.
    """
    target, wishes = budget.target, budget.wishes
    more = max(math.ceil(3.0 * math.log2(size / suits) - 0.5), 0)
    most = more + MAX_LEVEL + (target > MANY) if budget.max_level is None else budget.max_level
    deepest = more + MAX_LEVEL_THIN if budget.max_level is None else budget.max_level
    looked = max(min(most + 1, CLOSE_LEVEL + more), min(deepest, budget.wishes.min_level))
    error = max(CLOSE_ERROR * min(size, suits), 0.5 * budget.wishes.surface_error)
    looking = replace(
        wishes,
        surface_error=error,
        min_level=min(budget.wishes.min_level, looked),
        max_level=looked,
        layers=budget.min_layers,
        thin_level=min(deepest, looked + CLOSER_LEVELS),
    )
    growing = Growing(domain, size, looking, device)
    growing.run_until(target, FIRST_ERROR * min(size, suits))
    growing.run_finer(FINER_FOREST if target <= MANY else 1.0, FINER_THIN)
    room = (CLOSE_ELEMENTS if target <= MANY else CLOSE_ELEMENTS_OF_MANY) * target + 40_000
    if growing.growth.element_count + LEAST_CLOSER < room:
        growing.look_closer(CLOSER_LEVELS, CLOSER_ERROR, room)
    points, largest = label_floor(domain, target)
    growing.run_around(points, largest)
    resolved = Resolved(growing.grown(), size, domain)
    needs = needs_of(resolved, domain, budget.min_layers, most, deepest)
    needs = resolved.largest(np.maximum(needs, floor_needs(resolved, points, largest, deepest))).astype(np.float32)
    found = Coarsening(resolved, needs, sliver, budget.wishes.surface_error)
    found.choose(int(NEAR * target))
    return found


def label_floor(domain: Domain, target: int) -> tuple[np.ndarray, np.ndarray]:
    """Points in the labels of a scan [n, 3] [m], and the largest element at each that gives its label enough [m^3]."""
    count = max(int(min(LABEL_ELEMENTS, OF_LABELS * target / max(len(domain.label_names), 1))), 1)
    found, largest = [np.empty((0, 3))], [np.empty(0)]
    for name, volume in zip(domain.label_names, domain.label_volumes, strict=True):
        found.append(domain.points_in(name, 8 * count))
        largest.append(np.full(len(found[-1]), volume / min(count, len(found[-1])) if len(found[-1]) else 0.0))
    return np.concatenate(found), np.concatenate(largest)


def floor_needs(resolved: Resolved, points: np.ndarray, largest: np.ndarray, deepest: int) -> np.ndarray:
    """The need of tetrahedra that hold points and are larger than their limits, the more so the larger: more than any
    other need [m], float64 [M]."""
    grown, needs = resolved.grown, np.zeros(len(resolved.held))
    tree, size = grown.tree, resolved.cell_size
    at = leaves_at(tree, grown.cells, grown.origin, size, points)
    while (at >= 0).any():
        at, largest = at[at >= 0], largest[at >= 0]
        ratio = size**3 * resolved.volume[at] / largest
        chosen = (ratio > 1.0) & (tree.level[at] < deepest)
        np.maximum.at(needs, at[chosen], size * np.cbrt(ratio[chosen]))
        at = tree.parent[at]
    return needs


def needs_of(resolved: Resolved, domain: Domain, layers: float, most: int, deepest: int) -> np.ndarray:
    """The need of each tetrahedron to be bisected [m], never less than that of its descendants; float32 [M].

    Args:
        resolved: The forest.
        domain: The body.
        layers: Number of elements through the thickness.
        most: Level below which the surface needs no more bisections.
        deepest: Level below which thickness needs none either.
    """
    level, length = resolved.grown.tree.level, resolved.lengths
    needs = np.where(level < most, resolved.grown.need, 0.0)
    if layers > 0:
        missing = 1.0 - resolved.thin(domain, layers) / (layers * length)
        thin = (missing > 0.0) & (level < deepest)
        first = 1.0 + THINNEST_FIRST * np.round(missing[thin] * THIN_STEPS) / THIN_STEPS
        needs[thin] = np.maximum(needs[thin], THIN_NEED * length[thin]) * first
    gaps = resolved.gaps()
    if gaps is not None:
        # Pieces separate if elements of both, and one between them, have room; without room, bisection is in vain.
        finest = resolved.cell_size * 0.5 ** (deepest / 3.0)
        close = (GAP_ELEMENTS * length > gaps) & (gaps > GAP_ELEMENTS * finest) & (level < deepest)
        needs[close] = np.maximum(needs[close], GAP_NEED * length[close])
    return resolved.largest(np.where(resolved.held > 0.0, needs, 0.0)).astype(np.float32)


#: How often a cube is bisected by default.
MAX_LEVEL_BY_DEFAULT = 12
#: More elements are refused: their number would not fit into the arrays of a forest.
MOST_ELEMENTS = 100_000_000
#: With more root cubes in the body's box for each element that is allowed, no body fits.
CUBES_PER_ELEMENT = 1000
#: Number of meshes after which one with nearly the requested elements is good enough.
MOST_MESHES = 4
#: Without a number: the most tetrahedra of all levels in which a body is sampled below the mesh's levels.
CLOSER_ELEMENTS = 4_000_000


def mesh_domain(
    domain: Domain, budget: Budget, detail: int, sliver: float, device: str | wp.Device | None
) -> TetForest:
    """See `TetForest.from_domain`."""
    where = checked_device(domain.device if device is None else device)
    load(MESHING, where)
    _check(budget, detail, sliver)
    cell_size, wishes = None if budget.cell_size is None else float(budget.cell_size), budget.wishes
    if budget.target:
        _check_cubes(domain, cell_size, budget.target)
        return _of_size(domain, replace(budget, cell_size=cell_size), sliver, where)
    if cell_size is None:
        raise InputError("cell_size is None; it must be a length in metres where target_elements is not given")
    growing = Growing(domain, cell_size, wishes, where)
    growing.run()
    wished = growing.growth.forest.first_child[: growing.growth.element_count].numpy().copy()
    if detail:
        growing.look_closer(detail, CLOSER_ERROR, CLOSER_ELEMENTS)
    grown = growing.grown(wished)
    resolved = Resolved(grown, cell_size, domain if detail else None)
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


def _check(budget: Budget, detail: Any, sliver: Any) -> None:
    if budget.cell_size is not None:
        checked_cell_size(budget.cell_size)
    checked_level(detail, "detail")
    if not 0 <= checked_number(budget.min_layers, "min_layers") < np.inf:
        raise InputError(f"min_layers is {budget.min_layers}; it must be a number of elements, 0 for no care")
    if budget.target > MOST_ELEMENTS:
        raise InputError(f"target_elements is {budget.target}; it must be at most {MOST_ELEMENTS}")
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
