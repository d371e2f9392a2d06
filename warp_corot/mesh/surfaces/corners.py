"""Marched surfaces that meet the body's own corners.

A corner of three creases lies in one element, whose polygon may cross only two of the three planes. If the corner is
known, the triangle below it is replaced by three triangles that meet there, and edges around them are flipped if that
brings the surface nearer to the body's surface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from warp_corot.domain import Domain

Array = np.ndarray

#: Number of vertices near a corner whose triangles are tried; and the most corners: more than this would be noise, and
#: none is used.
TRIED, MOST = 4, 300
#: The surface already meets a corner that is nearer to a vertex than this fraction of the shortest edge there.
MET = 0.02
#: A triangle that is nearer to the body's surface than this fraction of that edge cuts nothing off.
FAR = 1.0e-3
#: Number of edges around a corner that are considered, and of triangles that are tried.
LOOKS, CUTTING = 24, 4
#: Sample points between a triangle and the body's surface: its centre and the midpoints of its sides.
_WITHIN = np.array([[2, 2, 2], [3, 3, 0], [3, 0, 3], [0, 3, 3]]) / 6.0


def with_corners(x: Array, triangles: Array, domain: Domain) -> tuple[Array, Array]:
    """A surface that meets the body's corners: its points [V, 3] and triangles [F, 3].

    Args:
        x: Vertices [m], float64 [V, 3].
        triangles: int32 [F, 3].
        domain: The body.
    """
    corners = domain.corners()
    if not 0 < len(corners) <= MOST or not len(triangles):
        return x, triangles
    from scipy.spatial import cKDTree

    _, near = cKDTree(x).query(corners, k=min(TRIED, len(x)))
    surface = _Surface(x, triangles, domain, near)
    for point, vertices in zip(corners, near, strict=True):
        surface.meet(point, vertices)
    return surface.arrays()


class _Surface:
    """Triangles that are replaced one by one.

    Args:
        x, triangles, domain: See `with_corners`.
        near: Vertices around which triangles may be replaced.
    """

    def __init__(self, x: Array, triangles: Array, domain: Domain, near: Array):
        self.x, self.domain, self.given = list(x), domain, triangles
        marked = np.zeros(len(x), bool)
        marked[near] = True
        # Triangles around their neighbours may be replaced, too.
        marked[triangles[marked[triangles].any(axis=1)]] = True
        self.local = {int(t): tuple(map(int, triangles[t])) for t in np.flatnonzero(marked[triangles].any(axis=1))}
        self.around: dict[int, set[int]] = {}
        for number, corners in self.local.items():
            for corner in corners:
                self.around.setdefault(corner, set()).add(number)
        self.count = self.count_before = len(triangles)
        #: The changes of the last fan: a triangle's number, its corners, and whether it was added.
        self.replaced: list[tuple[int, tuple[int, ...], bool]] = []

    def arrays(self) -> tuple[Array, Array]:
        old, new = ([t for t in self.local if (t < len(self.given)) == given] for given in (True, False))
        triangles = self.given.copy()
        triangles[old] = [self.local[t] for t in old]
        added = np.array([self.local[t] for t in sorted(new)], np.int32).reshape(-1, 3)
        return np.array(self.x), np.concatenate([triangles, added]).astype(np.int32)

    def meet(self, point: Array, vertices: Array) -> None:
        """Add a vertex at a point if that brings the surface nearer to the body's surface."""
        ring = sorted({t for v in vertices.tolist() for t in self.around[v]})
        sides = np.array([[self.x[v] for v in self.local[t]] for t in ring])
        shortest = np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2).min()
        if np.linalg.norm(self.x[vertices[0]] - point) < MET * shortest:
            return
        off = self._off(sides)
        far = off > FAR * shortest * np.linalg.norm(_normals(sides), axis=1)
        # The triangle that cuts the corner off is the one that is far from the body's surface.
        for place in [place for place in np.argsort(-off)[:CUTTING] if far[place]]:
            if off[place] + self._fan(ring[place], point) > 0.0:
                return
            self._undo()

    def _undo(self) -> None:
        """Undo the last fan."""
        for number, corners, added in reversed(self.replaced.copy()):
            if added:
                self._remove(number)
            else:
                self._add(corners, number)
        self.x.pop()
        self.count = self.count_before

    def _fan(self, triangle: int, point: Array) -> float:
        """Put a vertex above a triangle and flip edges around it.

        Returns the space that the flips save, less the space between the new triangles and the body's surface [m^3].
        """
        apex, self.count_before = len(self.x), self.count
        self.x.append(point)
        self.around[apex] = set()
        a, b, c = self.local[triangle]
        self.replaced.clear()
        self._remove(triangle)
        waiting = [self._add((apex, *ends), place) for ends, place in (((a, b), triangle), ((b, c), -1), ((c, a), -1))]
        gain = -float(self._off(np.array([[self.x[v] for v in self.local[t]] for t in waiting])).sum())
        for _ in range(LOOKS):
            if not waiting:
                break
            gain += self._turned(waiting.pop(0), apex, waiting)
        return gain

    def _turned(self, triangle: int, apex: int, waiting: list[int]) -> float:
        """Flip the edge across from the apex if that saves space, and return how much it saves [m^3]."""
        start = self.local[triangle].index(apex)
        _, a, b = (self.local[triangle][(start + k) % 3] for k in range(3))
        others = (self.around[a] & self.around[b]) - {triangle}
        if len(others) != 1:
            return 0.0
        (other,) = others
        (far,) = set(self.local[other]) - {a, b}
        if self.around[apex] & self.around[far]:
            return 0.0
        corners = np.array([self.x[k] for k in (apex, a, b, far)])
        old, new = corners[[[0, 1, 2], [3, 2, 1]]], corners[[[0, 1, 3], [0, 3, 2]]]
        gain = float(np.array([1.0, 1.0, -1.0, -1.0]) @ self._off(np.concatenate([old, new])))
        facing = (_normals(new)[:, None] * _normals(old)[None]).sum(axis=2).max(axis=1)
        if gain <= 0.0 or facing.min() <= 0.0:
            return 0.0
        self._remove(triangle)
        self._remove(other)
        waiting += [self._add((apex, a, far), triangle), self._add((apex, far, b), other)]
        return gain

    def _add(self, corners: tuple[int, ...], number: int) -> int:
        if number < 0:
            number, self.count = self.count, self.count + 1
        self.local[number] = corners
        self.replaced.append((number, corners, True))
        for corner in corners:
            self.around[corner].add(number)
        return number

    def _remove(self, number: int) -> None:
        corners = self.local.pop(number)
        self.replaced.append((number, corners, False))
        for corner in corners:
            self.around[corner].discard(number)

    def _off(self, triangles: Array) -> Array:
        """An estimate of the space between triangles [n, 3, 3] and the body's surface [m^3]."""
        off = np.abs(np.asarray(self.domain.phi((_WITHIN @ triangles).reshape(-1, 3)), np.float64))
        return np.linalg.norm(_normals(triangles), axis=1) * off.reshape(-1, len(_WITHIN)).mean(axis=1)


def _normals(triangles: Array) -> Array:
    """Normals of triangles whose lengths are proportional to their areas."""
    return 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
