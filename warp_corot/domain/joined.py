"""The pieces of the body that a closed surface encloses, by the parts of the surface that touch, cross or contain one
another.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from warp_corot.inputs.cpu_threads import launch_side_by_side
from warp_corot.kernels.meshing import measuring as kernels
from warp_corot.mesh.pieces import linked

from .winding import SurfaceParts, part_volumes

if TYPE_CHECKING:
    from .closing import ClosedSurface


def joined_parts(closed: ClosedSurface, device: wp.Device) -> tuple[int, np.ndarray, bool]:
    """Pieces of the body that a closed surface encloses: its parts, joined if they touch, cross or contain one another.

    Returns:
        The number of pieces, the piece of each triangle [T] (a cavity belongs to its surroundings), and whether parts
        overlap.
    """
    points, triangles, part = closed.points, closed.triangles.astype(np.int64), closed.parts.astype(np.int64)
    count = int(part.max()) + 1
    if count == 1:
        return 1, np.zeros(len(triangles), np.int32), False
    # Parts that share a point.
    last = np.empty(len(points), np.int64)
    last[triangles] = part[:, None]
    links = [_different(np.repeat(part, 3), last[triangles].ravel())]
    crossings = _crossings(closed, device)
    links.append(crossings)
    # Parts inside the body of others: a cavity in its surroundings, or a part buried in it.
    groups, outward = SurfaceParts(points, triangles, part), part_volumes(points, triangles, part) > 0.0
    holders = [groups.holders(groups.corners[groups.slices[own]][0, 0], own) for own in range(count)]
    overlap = len(crossings) > 0
    for own in range(count):
        around = _bounds_around(own, holders, outward)
        links.append(np.stack([np.full(len(around), own), around], axis=1))
        overlap |= len(around) > 0 and bool(outward[own])
    pairs = np.concatenate(links)
    of_part = linked(pairs, count)
    return int(of_part.max()) + 1, of_part[part].astype(np.int32), overlap


def _bounds_around(own: int, holders: list[np.ndarray], outward: np.ndarray) -> np.ndarray:
    """The parts that bound the body just outside a part: from the innermost one around it outwards, as far as the body
    reaches.
    """
    inmost_first = sorted(holders[own], key=lambda holder: -len(holders[holder]))
    depth = np.cumsum([0, *(1 if outward[holder] else -1 for holder in reversed(inmost_first))])[::-1]
    ends = np.flatnonzero(depth <= 0)
    return np.array(inmost_first[: ends[0]], np.int64)


def _crossings(closed: ClosedSurface, device: wp.Device) -> np.ndarray:
    """Pairs of parts where an edge of one passes through a triangle of the other [n, 2]."""
    edges, own = closed.edges.ends, closed.parts[closed.edges.order[closed.edges.starts] // 3]
    middle = closed.points.mean(axis=0)
    placed = wp.array(closed.points - middle, dtype=wp.vec3, device=device)
    mesh = wp.Mesh(placed, wp.array(closed.triangles.ravel(), dtype=wp.int32, device=device))
    crossed = wp.empty(len(edges), dtype=wp.int32, device=device)
    of_edges = [wp.array(edges.astype(np.int32), dtype=wp.vec2i, device=device)]
    of_edges += [wp.array(own, dtype=wp.int32, device=device)]
    of_triangles = [mesh.id, wp.array(closed.parts, dtype=wp.int32, device=device)]
    launch_side_by_side(
        kernels.find_crossed_parts,
        len(edges),
        lambda own: ([placed, *map(own, of_edges), *of_triangles], [own(crossed)]),
        device,
    )
    other = crossed.numpy()
    return _different(own[other >= 0], other[other >= 0])


def _different(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Pairs of different numbers, each once [n, 2]."""
    differ = one != other
    return np.unique(np.stack([one[differ], other[differ]], axis=1), axis=0).astype(np.int64)
