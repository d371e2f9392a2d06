"""The surfaces and pieces of a forest made from a domain."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import numpy.typing as npt
import scipy

from warp_corot.domain.units import volume
from warp_corot.errors import InputError
from warp_corot.mesh.lattice import LATTICE_BITS
from warp_corot.mesh.surfaces.marching import Detail
from warp_corot.mesh.topology import boundary_faces, pieces_of
from warp_corot.mesh.tree import VOID, in_order_of_leaves, live_or_void, renumbered, with_virtual

from .bound import SurfaceMesh, barycentric, embed
from .marching import marched, marched_cut, separated

if TYPE_CHECKING:
    from warp_corot.mesh.forest_arrays import ForestArrays

Forest = TypeVar("Forest", bound="ForestArrays")

#: A node's way to a line is in the plane of its own cut if it is off by at most this share of its length.
IN_PLANE = 0.02
#: Nodes stay where they are if a cut is so nearly parallel to the face of a box: the square of the sine of the angle.
LEAST = 0.1


def surface(forest: ForestArrays) -> SurfaceMesh:
    """See `TetForest.surface`."""
    if forest.phi is None:
        found = boundary_surface(forest)
        if forest.tree.cut is None:
            return found
        found = replace(found, is_cut=_of_cuts(forest))
        return _snapped(forest, found, found)
    if forest.tree.cut is not None:
        marched_surface = marched_cut(forest.lattice_points, _cut_apart(forest), forest.phi)
        found = _snapped(forest, _on_nodes(forest, marched_surface), marched_surface)
    elif forest.detail is not None:
        found = _embedded(forest, forest.detail.surface())
    else:
        found = _on_nodes(forest, marched(forest.lattice_points, _all_cut(forest), forest.phi))
    # A part that is thinner than the elements and lies between their nodes crosses no edge.
    return found if len(found.triangles) else boundary_surface(forest)


def separating_surface(forest: ForestArrays) -> SurfaceMesh:
    """See `TetForest.separating_surface`."""
    if forest.phi is None or forest.node_labels is None:
        raise InputError("this mesh has no labels; it must be made from a domain that has labels")
    if forest.tree.cut is not None:
        raise InputError(
            "this mesh is cut, and surfaces between labels do not come apart; surface() is closed around it"
        )
    if forest.detail is not None:
        return _embedded(forest, forest.detail.separating_surface())
    return _on_nodes(forest, separated(forest.lattice_points, _all_cut(forest), forest.phi, forest.node_labels))


def largest_piece(forest: Forest) -> Forest:
    """See `TetForest.largest_piece`."""
    kept = pieces_of(forest.tets) == 0
    if kept.all():
        return forest
    live = np.zeros(len(forest.tree.level), bool)
    live[forest.tree.leaves[kept]] = True
    tree = live_or_void(forest.tree, live)
    order = with_virtual(in_order_of_leaves(tree), tree, forest.lattice)
    ends, tree = renumbered(order, forest.node_ends, tree)
    phi = None
    if forest.phi is not None:
        phi = forest.phi.copy()
        gone = np.unique(forest.tets[~kept])
        phi[gone] = np.abs(phi[gone])
    return replace(
        forest,
        lattice=forest.lattice[order],
        node_ends=ends,
        tree=tree,
        phi=None if phi is None else phi[order],
        node_labels=None if forest.node_labels is None else forest.node_labels[order],
        fill=None if forest.fill is None else forest.fill[kept],
        labels=None if forest.labels is None else forest.labels[kept],
        detail=None if forest.detail is None else _within(forest, forest.detail, kept),
    )


def summary(forest: ForestArrays) -> list[str]:
    """See `TetForest.summary`."""
    x, y, z = forest.cells
    count = len(forest.tets)
    lines = [f"{count} tetrahedra, {forest.node_count} nodes, from {x} x {y} x {z} cubes of {forest.cell_size:g} m"]
    lowest, highest = int(forest.levels.min()), int(forest.levels.max())
    lines.append(f"levels {lowest} to {highest}" if lowest < highest else f"level {lowest}")
    if forest.fill is not None:
        inside, whole = float(np.sum(forest.fill * forest.volumes)), float(np.sum(forest.volumes))
        cut = np.count_nonzero(forest.fill != 1.0)
        lines.append(f"{volume(inside)} of body in {volume(whole)} of tetrahedra, {cut} of which are cut")
    lines += [f"label {name}: {np.count_nonzero(forest.elements_of(name))} tetrahedra" for name in forest.label_names]
    sizes = np.bincount(pieces_of(forest.tets))
    if len(sizes) > 1:
        shown = ", ".join(str(n) for n in sizes[:5]) + (", ..." if len(sizes) > 5 else "")
        lines.append(f"{len(sizes)} separate pieces, of {shown} tetrahedra")
    return lines


def _all_cut(forest: ForestArrays) -> np.ndarray:
    """Nodes of all leaves that hold a part of the body, including leaves that were left out, int32 [n, 4]."""
    assert forest.phi is not None
    tets = forest.tree.tets[forest.tree.first_child < 0]
    return tets[(forest.phi[tets] < 0).any(axis=1)]


def _cut_apart(forest: ForestArrays) -> np.ndarray:
    """As `_all_cut`, but for leaves that were left out and have nodes inside that no element joins: a cut may be
    between them."""
    assert forest.phi is not None
    is_inside = forest.phi < 0
    left_out = forest.tree.tets[forest.tree.first_child == VOID]
    left_out = left_out[is_inside[left_out].any(axis=1)]
    pairs = np.array(list(itertools.combinations(range(4), 2)))
    edges, asked = (np.sort(tets[:, pairs].astype(np.int64), axis=2) for tets in (forest.tets, left_out))
    joined = np.isin(asked[..., 0] << 32 | asked[..., 1], np.unique(edges[..., 0] << 32 | edges[..., 1]))
    whole = (joined | ~is_inside[asked].all(axis=2)).all(axis=1)
    whole &= ~(is_inside[left_out] & (left_out >= forest.node_count)).any(axis=1)
    return np.concatenate([forest.tets[is_inside[forest.tets].any(axis=1)], left_out[whole]])


def _elements_at(forest: ForestArrays, nodes: np.ndarray) -> np.ndarray:
    """An element around each node."""
    element = np.zeros(forest.node_count, np.int64)
    element[forest.tets] = np.arange(len(forest.tets))[:, None]
    return element[nodes]


def _snapped(forest: ForestArrays, found: SurfaceMesh, edges_of: SurfaceMesh) -> SurfaceMesh:
    """The surface with points on cuts where the cuts went, bound to an element on their side.

    Args:
        forest: The mesh.
        found: The surface.
        edges_of: The same surface, its points bound to the ends of their edges.
    """
    if forest.snap is None:
        return found
    moves, on_cut = _moves_to_cuts(forest, edges_of)
    if forest.phi is None:
        moves = _within_faces(forest, edges_of.nodes[:, 0], moves)
    points = np.flatnonzero(np.abs(moves).max(axis=1) > 0.0)
    if not len(points):
        return found
    ends = np.where(found.weights[points, 1:2] == 0.0, found.nodes[points, :1], found.nodes[points, :2])
    elements, is_beyond = _beside(forest, ends, found.points[points] + moves[points], moves[points])
    moved = on_cut[points] | is_beyond
    points, elements = points[moved], elements[moved]
    x, nodes, weights = found.points.copy(), found.nodes.copy(), found.weights.copy()
    x[points] += moves[points]
    if forest.phi is not None:
        rim = points[edges_of.nodes[points, 0] != edges_of.nodes[points, 1]]
        x[rim] = _on_rim(forest, x[rim], moves[rim])
    nodes[points] = forest.tets[elements]
    weights[points] = barycentric(forest, elements, x[points])
    return replace(found, points=x, nodes=nodes, weights=weights)


def _moves_to_cuts(forest: ForestArrays, edges_of: SurfaceMesh) -> tuple[np.ndarray, np.ndarray]:
    """The way from each point to the cut at the ends of its edge [V, 3], and whether it is on a face of a cut [V].

    An end and its way to the cut make a plane; if the other end has no such way, that of the point is across it.
    """
    weights = edges_of.weights[:, :2]
    snap = _shared_snaps(forest)[edges_of.nodes[:, :2]]
    squares = np.einsum("vnc,vnc->vn", snap, snap)
    shares = weights * (squares > 0.0)
    total = shares.sum(axis=1)
    ahead = forest.lattice_points[edges_of.nodes[:, :2]] + snap - edges_of.points[:, None]
    across = np.einsum("vnc,vnc->vn", ahead, snap) / np.where(squares > 0.0, squares, 1.0)
    planes = np.einsum("vn,vnc->vc", shares * across, snap) / np.where(total > 0.0, total, 1.0)[:, None]
    on_cut = np.zeros(len(snap), bool)
    on_cut[edges_of.triangles[edges_of.is_cut]] = True
    return np.where(total[:, None] < 0.999, planes, np.einsum("vn,vnc->vc", weights, snap)), on_cut


def _shared_snaps(forest: ForestArrays) -> np.ndarray:
    """The way from each node to the cuts there, float64 [N, 3]: of the nodes at one point the longest, which leads to
    all cuts that meet there, so that there are no gaps between pieces.

    Where two cuts meet too far away, nodes on one of them go their own way, so that both lips are flat.
    """
    snap = np.asarray(forest.snap, np.float64)
    _, point = np.unique(forest.lattice[: len(snap)], axis=0, return_inverse=True)
    point = point.ravel()
    order = np.argsort(np.einsum("nc,nc->n", snap, snap), kind="stable")
    longest = np.zeros(len(snap), np.int64)
    longest[point[order]] = order
    shared = snap[longest[point]]
    off = np.einsum("nc,nc->n", shared - snap, snap)
    stays = np.abs(off) <= IN_PLANE * np.linalg.norm(snap, axis=1) * np.linalg.norm(shared, axis=1)
    ways = np.unique(np.column_stack([point, snap]), axis=0)[:, 0].astype(np.int64)
    stays |= np.bincount(ways, minlength=len(snap))[point] > 2
    return np.where(stays[:, None], shared, snap)


def _within_faces(forest: ForestArrays, nodes: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Moves [n, 3] of nodes of a box, which stay in its faces and end on the same cut."""
    lattice = forest.lattice[nodes]
    is_free = (lattice > 0) & (lattice < np.array(forest.cells) << LATTICE_BITS)
    within = np.where(is_free, moves, 0.0)
    squares, kept = (np.einsum("nc,nc->n", each, moves) for each in (moves, within))
    return within * np.where(kept > LEAST * squares, squares / np.where(kept > 0.0, kept, 1.0), 0.0)[:, None]


def _of_cuts(forest: ForestArrays) -> np.ndarray:
    """Which faces of the boundary are of cuts, bool [F]."""
    assert forest.tree.cut is not None
    faces, parents = boundary_faces(forest.tets, forest.points)
    opposite = (forest.tets[parents][:, :, None] != faces[:, None, :]).all(axis=2).argmax(axis=1)
    return np.asarray((forest.tree.cut[forest.tree.leaves[parents]] >> opposite) & 1 == 1)


def _beside(forest: ForestArrays, ends: np.ndarray, x: np.ndarray, moves: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The element at an end of each point's edge [n, 2] that holds the moved point best, [n], and whether the point was
    beyond the cut.

    It is on the side of the cut on which the edge is: an element beside the point carries forces at it without a lever.
    """
    near = np.flatnonzero(np.isin(forest.tets, ends).any(axis=1))
    corners = forest.tets[near]
    rows = corners.ravel(), np.repeat(np.arange(len(near)), 4)
    around = scipy.sparse.csr_array((np.ones(corners.size), rows), shape=(forest.node_count, len(near)))
    # An edge of a leaf that was left out may be of no element: then its inner end counts.
    is_whole = around[ends[:, 0]].multiply(around[ends[:, 1]]).sum(axis=1) > 0.0
    found = (around[ends[:, 0]] + around[np.where(is_whole, ends[:, 1], ends[:, 0])]).tocoo()
    point, element = found.row, near[found.col]
    centres = forest.points[forest.tets[element]].mean(axis=1)
    side = np.einsum("nc,nc->n", centres - x[point], moves[point])
    own = np.bincount(point, np.where(found.data == 2.0, side, 0.0), len(x))
    quality = barycentric(forest, element, x[point]).min(axis=1)
    quality[side * own[point] < 0.0] -= len(x)
    order = np.lexsort((quality, point))
    return element[order[np.cumsum(np.bincount(point, minlength=len(x))) - 1]], own > 0.0


def _on_rim(forest: ForestArrays, x: np.ndarray, moves: np.ndarray) -> np.ndarray:
    """Points of the body's surface that were moved to a cut [n, 3], moved along the cut to the body's surface again."""
    elements, weights = embed(forest, x)
    corners = forest.tets[elements]
    values = np.asarray(forest.phi, np.float64)[corners]
    edges = forest.points[corners[:, 1:]] - forest.points[corners[:, :1]]
    slope = np.linalg.solve(edges, (values[:, 1:] - values[:, :1])[..., None])[..., 0]
    across = moves / np.linalg.norm(moves, axis=1, keepdims=True)
    slope -= np.einsum("nc,nc->n", slope, across)[:, None] * across
    steep = np.einsum("nc,nc->n", slope, slope)
    way = np.einsum("nv,nv->n", values, weights) / np.where(steep > 0.0, steep, np.inf)
    back = way[:, None] * slope
    far, most = np.linalg.norm(back, axis=1), np.linalg.norm(moves, axis=1)
    return x - back * np.where(far > most, most / np.where(far > 0.0, far, 1.0), 1.0)[:, None]


def _embedded(forest: ForestArrays, found: SurfaceMesh) -> SurfaceMesh:
    """The surface, bound to the nodes of a forest."""
    elements, weights = embed(forest, found.points)
    return replace(found, nodes=forest.tets[elements], weights=weights)


def _within(forest: ForestArrays, detail: Detail, kept: np.ndarray) -> Detail:
    """The part of a detail that is in the elements of a mask bool [T], or nearest to them."""
    elements, _ = embed(forest, detail.points[detail.tets].mean(axis=1))
    return Detail.of(detail.points, detail.tets[kept[elements]], detail.phi, detail.labels)


def _on_nodes(forest: ForestArrays, found: SurfaceMesh) -> SurfaceMesh:
    """The surface, with points that no nodes of the mesh carry bound to the nodes of the nearest element."""
    lost = np.flatnonzero(((found.nodes >= forest.node_count) & (found.weights != 0)).any(axis=1))
    unused = found.nodes >= forest.node_count
    nodes = np.where(unused, found.nodes.min(axis=1, keepdims=True), found.nodes)
    weights = found.weights.copy()
    if len(lost):
        elements, weights[lost] = embed(forest, found.points[lost])
        if forest.tree.cut is not None:
            # The nearest element may be across a cut; one at the inner end of the point's edge is not.
            inner = found.nodes[lost, 0]
            known = inner < forest.node_count
            elements[known] = _elements_at(forest, inner[known])
            weights[lost] = barycentric(forest, elements, found.points[lost])
        nodes[lost] = forest.tets[elements]
    return replace(found, nodes=nodes.astype(np.int32), weights=weights)


def boundary_surface(mesh: Any, of: npt.NDArray[np.bool_] | None = None) -> SurfaceMesh:
    """The boundary of any tetrahedral mesh, or of some of its elements; each point is bound to its own node."""
    faces, _ = boundary_faces(mesh.tets if of is None else mesh.tets[of], mesh.points)
    used, triangles = np.unique(faces, return_inverse=True)
    weights = np.tile([1.0, 0.0, 0.0, 0.0], (len(used), 1))
    nodes = np.repeat(used[:, None], 4, axis=1).astype(np.int32)
    return SurfaceMesh(mesh.points[used], nodes, weights, triangles.reshape(-1, 3).astype(np.int32))
