"""Marched surfaces that meet the body's own corners.

A corner of three creases lies in one element, whose polygon may cross only two of the three planes. If the corner is
known, the triangle below it is replaced by three triangles that meet there, and edges around them are flipped if that
brings the surface nearer to the body's surface.
"""

from __future__ import annotations

from collections.abc import Generator, Iterable
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

if TYPE_CHECKING:
    from typing import TypeAlias

    from warp_corot.domain import Domain

    Value = TypeVar("Value")
    #: Asks for `_off` of triangles, and goes on with the answer.
    _Step: TypeAlias = "Generator[Array, tuple[Array, Array], Value]"

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
    surface = _Surface(x, triangles, corners, near.reshape(len(corners), -1))
    surface.meet_all(domain)
    return surface.arrays()


class _Surface:
    """Triangles that are replaced one by one. Corners that need different triangles are treated together.

    Args:
        x, triangles: See `with_corners`.
        corners: The body's corners [C, 3].
        near: Vertices around which triangles may be replaced, for each corner [C, k].
    """

    def __init__(self, x: Array, triangles: Array, corners: Array, near: Array):
        self.given, self.near = triangles, near
        #: Corner n becomes vertex ``first + n``; its additional triangles are ``len(triangles) + 2 n`` and the next.
        self.first, self.x = len(x), [*x, *corners]
        marked = np.zeros(len(x), bool)
        marked[near] = True
        # Triangles around their neighbours may be replaced, too.
        marked[triangles[marked[triangles].any(axis=1)]] = True
        self.local = {int(t): tuple(map(int, triangles[t])) for t in np.flatnonzero(marked[triangles].any(axis=1))}
        self.around: dict[int, set[int]] = {self.first + n: set() for n in range(len(corners))}
        for number, ends in self.local.items():
            for end in ends:
                self.around.setdefault(end, set()).add(number)
        #: The corner that now uses each triangle.
        self.owner: dict[int, int] = {}

    def arrays(self) -> tuple[Array, Array]:
        old, new = ([t for t in self.local if (t < len(self.given)) == given] for given in (True, False))
        triangles = self.given.copy()
        triangles[old] = [self.local[t] for t in old]
        added = np.array([self.local[t] for t in sorted(new)], np.int32).reshape(-1, 3)
        triangles = np.concatenate([triangles, added])
        met = [vertex for vertex in range(self.first, len(self.x)) if self.around[vertex]]
        number = np.arange(len(self.x), dtype=np.int32)
        number[met] = self.first + np.arange(len(met), dtype=np.int32)
        return np.array([*self.x[: self.first], *(self.x[vertex] for vertex in met)]), number[triangles]

    def meet_all(self, domain: Domain) -> None:
        """Add a vertex at each corner if that brings the surface nearer to the body's surface."""
        waiting, alone = list(range(len(self.near))), False
        while waiting:
            self.owner.clear()
            steps = {}
            for corner in waiting[:1] if alone else waiting:
                ring = self._ring(self.near[corner].tolist())
                # Edges are flipped beyond the ring, too; a corner that would reach triangles of another waits.
                if self._take(self._ring(v for t in ring for v in self.local[t]), corner):
                    steps[corner] = self._meet(corner, ring)
            done = _together(steps, domain)
            # If no corner had its triangles to itself, the next one is treated alone.
            waiting, alone = [corner for corner in waiting if corner not in done], not done

    def _ring(self, vertices: Iterable[int]) -> list[int]:
        return sorted({t for v in vertices for t in self.around.get(v, ())})

    def _take(self, triangles: Iterable[int], corner: int) -> bool:
        """Whether no other corner uses these triangles; then this one does."""
        if any(self.owner.get(t, corner) != corner for t in triangles):
            return False
        self.owner.update(dict.fromkeys(triangles, corner))
        return True

    def _meet(self, corner: int, ring: list[int]) -> _Step[bool]:
        """Add a vertex at a corner; return False if that needs triangles of other corners."""
        point = self.x[self.first + corner]
        sides = np.array([[self.x[v] for v in self.local[t]] for t in ring])
        shortest = np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2).min()
        if np.linalg.norm(self.x[self.near[corner, 0]] - point) < MET * shortest:
            return True
        off, normals = yield sides
        far = off > FAR * shortest * np.linalg.norm(normals, axis=1)
        # The triangle that cuts the corner off is the one that is far from the body's surface.
        for place in [place for place in np.argsort(-off)[:CUTTING] if far[place]]:
            replaced: list[tuple[int, tuple[int, ...], bool]] = []
            gain = yield from self._fan(ring[place], corner, replaced)
            if gain is not None and off[place] + gain > 0.0:
                return True
            self._undo(replaced)
            if gain is None:
                return False
        return True

    def _undo(self, replaced: list[tuple[int, tuple[int, ...], bool]]) -> None:
        """Undo a fan: a triangle's number, its corners, and whether it was added, for each change."""
        for number, corners, added in reversed(replaced):
            if added:
                self._remove(number, [])
            else:
                self._add(number, corners, [])

    def _fan(self, triangle: int, corner: int, replaced: list[Any]) -> _Step[float | None]:
        """Put a vertex above a triangle and flip edges around it.

        Returns the space that the flips save, less the space between the new triangles and the body's surface [m^3];
        None if that needs triangles of other corners.
        """
        apex, added = self.first + corner, len(self.given) + 2 * corner
        a, b, c = self.local[triangle]
        self._remove(triangle, replaced)
        waiting = [triangle, added, added + 1]
        self._take(waiting, corner)
        for number, ends in zip(waiting, ((a, b), (b, c), (c, a)), strict=True):
            self._add(number, (apex, *ends), replaced)
        off, _ = yield np.array([[self.x[v] for v in self.local[t]] for t in waiting])
        gain = -float(off.sum())
        for _ in range(LOOKS):
            if not waiting:
                break
            turned = yield from self._turned(waiting.pop(0), corner, waiting, replaced)
            if turned is None:
                return None
            gain += turned
        return gain

    def _turned(self, triangle: int, corner: int, waiting: list[int], replaced: list[Any]) -> _Step[float | None]:
        """Flip the edge across from the apex if that saves space, and return how much it saves [m^3]; None if that
        needs triangles of other corners."""
        apex = self.first + corner
        start = self.local[triangle].index(apex)
        _, a, b = (self.local[triangle][(start + k) % 3] for k in range(3))
        others = (self.around[a] & self.around[b]) - {triangle}
        if len(others) != 1:
            return 0.0
        (other,) = others
        (far,) = set(self.local[other]) - {a, b}
        if self.around[apex] & self.around[far]:
            return 0.0
        if not self._take([other], corner):
            return None
        x = np.array([self.x[k] for k in (apex, a, b, far)])
        off, normals = yield x[[[0, 1, 2], [3, 2, 1], [0, 1, 3], [0, 3, 2]]]
        gain = float(off[0] + off[1] - off[2] - off[3])
        if gain <= 0.0 or (normals[2:] @ normals[:2].T).max(axis=1).min() <= 0.0:
            return 0.0
        self._remove(triangle, replaced)
        self._remove(other, replaced)
        self._add(triangle, (apex, a, far), replaced)
        self._add(other, (apex, far, b), replaced)
        waiting += [triangle, other]
        return gain

    def _add(self, number: int, corners: tuple[int, ...], replaced: list[Any]) -> None:
        self.local[number] = corners
        replaced.append((number, corners, True))
        for corner in corners:
            self.around[corner].add(number)

    def _remove(self, number: int, replaced: list[Any]) -> None:
        corners = self.local.pop(number)
        replaced.append((number, corners, False))
        for corner in corners:
            self.around[corner].discard(number)


def _together(steps: dict[int, _Step[bool]], domain: Domain) -> set[int]:
    """Advance all corners together, with one evaluation of the body for all of them at each step; return the corners
    that are done."""
    done, waiting = set(), {}

    def advance(corner: int, value: tuple[Array, Array] | None) -> None:
        try:
            waiting[corner] = next(steps[corner]) if value is None else steps[corner].send(value)
        except StopIteration as end:
            if end.value:
                done.add(corner)

    for corner in steps:
        advance(corner, None)
    while waiting:
        asked, waiting = waiting, {}
        off, normals = _off(np.concatenate(list(asked.values())), domain)
        start = 0
        for corner, triangles in asked.items():
            part = slice(start, start := start + len(triangles))
            advance(corner, (off[part], normals[part]))
    return done


def _off(triangles: Array, domain: Domain) -> tuple[Array, Array]:
    """An estimate of the space between triangles [n, 3, 3] and the body's surface [m^3] [n], and their `_normals`."""
    off = np.abs(np.asarray(domain.phi((_WITHIN @ triangles).reshape(-1, 3)), np.float64))
    normals = _normals(triangles)
    return np.linalg.norm(normals, axis=1) * off.reshape(-1, len(_WITHIN)).mean(axis=1), normals


def _normals(triangles: Array) -> Array:
    """Normals of triangles whose lengths are proportional to their areas."""
    return 0.5 * np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
