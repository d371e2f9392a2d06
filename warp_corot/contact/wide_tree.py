"""The tree of the bodies' surfaces in which the CPU searches for pairs; see ``kernels.contact.wide_tree``."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.kernels.contact import wide_tree as kernels

from .surface import ContactSurface

LANES = int(kernels.LANES)
#: Leaves of a root.
OF_ROOT = LANES * LANES

Ints = npt.NDArray[np.integer]
Floats = npt.NDArray[np.float32]


def planted(surface: ContactSurface) -> kernels.WideTree:
    """The tree of surfaces whose places at rest are known; boxes are not."""
    tree, corners, sides = kernels.WideTree(), surface.triangles.numpy(), surface.sides.numpy()[:, 0]
    used = np.flatnonzero(corners[:, 0] >= 0)
    bodies, parts = surface.body_of_places(), len(surface.parts)
    group = surface.arrays.world.numpy()[corners[used, 0]] * parts + bodies[corners[used, 0]]
    leaf, leaf_group = _leaves(surface.arrays.rest.numpy()[corners[used]], group)
    # Each body in each world begins with a root.
    counts = np.bincount(leaf_group, minlength=surface.worlds * parts)
    roots = -(-counts // OF_ROOT)
    first = np.concatenate([[0], np.cumsum(roots)])
    number = OF_ROOT * first[leaf_group] + np.arange(len(leaf_group)) - (np.cumsum(counts) - counts)[leaf_group]
    of = np.full(len(corners), -1)
    of[used] = number[leaf]
    leaves = OF_ROOT * max(int(first[-1]), 1)
    of_edges = np.where(sides >= 0, of[sides], -1)
    arrays = {"root_starts": first[::parts], "root_bodies": np.repeat(np.arange(len(roots)) % parts, roots)}
    for name, of_items in (("triangle", of), ("edge", of_edges)):
        starts, items = _lanes(of_items, leaves)
        arrays |= {f"{name}_starts": starts, f"{name}s": items}
    arrays["found"] = np.zeros(len(corners) + len(sides))
    sizes = {"triangle_nodes": len(arrays["triangles"]), "edge_nodes": len(arrays["edges"]), "lower_nodes": leaves}
    sizes |= {"upper_nodes": leaves // LANES, "roots": -(-leaves // OF_ROOT // LANES) * LANES}
    for name, values in arrays.items():
        setattr(tree, name, wp.array(values.astype(np.int32), dtype=wp.int32, device=surface.device))
    empty = np.full((int(kernels.ROWS), LANES), 0.0, np.float32)
    empty[:3], empty[3:6] = kernels.FAR, -kernels.FAR
    for name, size in sizes.items():
        values = np.tile(empty.ravel(), size // LANES)
        setattr(tree, name, wp.array(values, dtype=wp.float32, device=surface.device))
    return tree


def _leaves(x: Floats, group: Ints) -> tuple[Ints, Ints]:
    """The leaf of each of some triangles with corners x, [T, 3, 3], and the group of each leaf, in the order of groups:
    halves of halves of each group, across the longest extent of centres and normals."""
    middle, normals = x.mean(axis=1), np.cross(x[:, 1] - x[:, 0], x[:, 2] - x[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    # Triangles that lie back to back differ as much as those a leaf apart.
    across = np.sqrt(LANES * areas.mean()) if len(x) else 1.0
    points = np.concatenate([middle, across * normals / np.maximum(areas, 1e-30)[:, None]], axis=1)
    order = np.argsort(group, kind="stable")
    starts = np.flatnonzero(np.diff(group[order], prepend=-1))
    while True:
        ends = np.append(starts[1:], len(order))
        if (ends - starts).max(initial=0) <= LANES:
            break
        leaf, at = np.repeat(np.arange(len(starts)), ends - starts), points[order]
        extent = np.maximum.reduceat(at, starts) - np.minimum.reduceat(at, starts)
        order = order[np.lexsort((at[np.arange(len(at)), extent.argmax(axis=1)[leaf]], leaf))]
        # Full leaves, but for the last one.
        halves = starts + LANES * -(-(ends - starts) // (2 * LANES))
        starts = np.unique(np.concatenate([starts, halves[ends - starts > LANES]]))
    found = np.empty(len(order), np.int64)
    found[order] = np.repeat(np.arange(len(starts)), ends - starts)
    return found, group[order[starts]]


def _lanes(of: Ints, leaves: int) -> tuple[Ints, Ints]:
    """The first node of each leaf, and what is in the lanes of nodes: the items of each leaf."""
    items = np.flatnonzero(of >= 0)
    items = items[np.argsort(of[items], kind="stable")]
    counts = np.bincount(of[items], minlength=leaves)
    starts = np.concatenate([[0], np.cumsum(-(-counts // LANES))])
    lanes = np.full(LANES * starts[-1], -1)
    lanes[LANES * starts[of[items]] + np.arange(len(items)) - (np.cumsum(counts) - counts)[of[items]]] = items
    return starts, lanes
