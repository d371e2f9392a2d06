"""Bodies made for trouble: thin, long, sharp, branching, nested, slit, open, overlapping, in millions of triangles.

Each is a function without arguments that gives points [N, 3] [m] and triangles [F, 3]; ``SHAPES`` has them by name. All
are about as large as organs, 5 to 25 cm, unless their trouble is their size.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import trimesh

Surface = tuple[np.ndarray, np.ndarray]

SHAPES: dict[str, Callable[[], Surface]] = {}


def shape(make: Callable[[], Surface]) -> Callable[[], Surface]:
    """Put a shape into the table under its function's name."""
    SHAPES[make.__name__.replace("_", "-")] = make
    return make


# --- tools -----------------------------------------------------------------------------------------------------------


def arrays(mesh: trimesh.Trimesh) -> Surface:
    return np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)


def together(*surfaces: Surface) -> Surface:
    """Several closed surfaces as one, whether they overlap or not."""
    starts = np.cumsum([0, *(len(points) for points, _ in surfaces)])
    triangles = [tri + start for (_, tri), start in zip(surfaces, starts[:-1], strict=True)]
    return np.concatenate([points for points, _ in surfaces]), np.concatenate(triangles)


def moved(surface: Surface, by=(0.0, 0.0, 0.0), axes=None) -> Surface:
    points, triangles = surface
    return (points if axes is None else points @ np.asarray(axes).T) + np.asarray(by), triangles


def inverted(surface: Surface) -> Surface:
    return surface[0], surface[1][:, ::-1]


def box(x: float, y: float, z: float, at=(0.0, 0.0, 0.0)) -> Surface:
    return moved(arrays(trimesh.creation.box((x, y, z))), at)


def ball(radius: float, at=(0.0, 0.0, 0.0), fineness: int = 4) -> Surface:
    return moved(arrays(trimesh.creation.icosphere(fineness, radius)), at)


def capsule(radius: float, start, end) -> Surface:
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = float(np.linalg.norm(end - start))
    axis = (end - start) / length
    turn = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], axis)[:3, :3]
    points, triangles = ball(radius, fineness=3)
    points[:, 2] += length * (points[:, 2] > 0.0)
    return moved((points, triangles), start, turn)


def grid(rows: int, columns: int, *, closed_rows: bool = False, closed_columns: bool = False) -> np.ndarray:
    """Triangles of a sheet of rows × columns points, wound round rows first."""
    r = np.arange(rows if closed_rows else rows - 1)
    c = np.arange(columns if closed_columns else columns - 1)
    i, j = (a.ravel() for a in np.meshgrid(r, c, indexing="ij"))
    k, m = (i + 1) % rows, (j + 1) % columns
    a, b, d, e = (x * columns + y for x, y in ((i, j), (k, j), (k, m), (i, m)))
    return np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, e], 1)])


def tube(line: np.ndarray, radius: float | np.ndarray, *, closed: bool = False, around: int = 24) -> Surface:
    """A tube round a line [n, 3], its ends closed by caps or by one another."""
    n = len(line)
    ahead, behind = (np.roll(line, -1, 0), np.roll(line, 1, 0)) if closed else (line[1:], line[:-1])
    along = ahead - behind if closed else np.gradient(line, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.cross(along[0], np.eye(3)[np.argmin(np.abs(along[0]))])
    sides = np.empty((n, 3))
    for k in range(n):  # carried along without twist
        side = side - (side @ along[k]) * along[k]
        side /= np.linalg.norm(side)
        sides[k] = side
    if closed:  # what it has twisted by on the way round is spread
        last = sides[-1] - (sides[-1] @ along[0]) * along[0]
        twist = np.arctan2(last @ np.cross(along[0], sides[0]), last @ sides[0])
        turn = -twist * np.arange(n) / n
        sides = np.cos(turn)[:, None] * sides + np.sin(turn)[:, None] * np.cross(along, sides)
    angle = 2.0 * np.pi * np.arange(around) / around
    ring = (
        np.cos(angle)[None, :, None] * sides[:, None] + np.sin(angle)[None, :, None] * np.cross(along, sides)[:, None]
    )
    points = (line[:, None] + np.broadcast_to(radius, n)[:, None, None] * ring).reshape(-1, 3)
    triangles = grid(n, around, closed_rows=closed, closed_columns=True)[:, ::-1]
    if closed:
        return points, triangles
    first, last = len(points), len(points) + 1
    j = np.arange(around)
    m = (j + 1) % around
    caps = [np.stack([np.full(around, first), m, j], 1)]
    caps += [np.stack([np.full(around, last), (n - 1) * around + j, (n - 1) * around + m], 1)]
    return np.concatenate([points, line[[0, -1]]]), np.concatenate([triangles, *caps])


def prism(outline: np.ndarray, height: float) -> Surface:
    """A star-shaped outline [n, 2] about the origin, counter-clockwise, extruded along z."""
    n = len(outline)
    j = np.arange(n)
    k = (j + 1) % n
    low, high = (np.column_stack([outline, np.full(n, z)]) for z in (0.0, height))
    points = np.concatenate([low, high, [[0, 0, 0], [0, 0, height]]])
    walls = [np.stack([j, k, n + k], 1), np.stack([j, n + k, n + j], 1)]
    caps = [np.stack([k, j, np.full(n, 2 * n)], 1), np.stack([n + j, n + k, np.full(n, 2 * n + 1)], 1)]
    return points, np.concatenate([*walls, *caps])


def bent(surface: Surface, where: Callable[[np.ndarray], np.ndarray]) -> Surface:
    return where(surface[0]), surface[1]


def fine_box(x: float, y: float, z: float, pitch: float) -> Surface:
    """A box with triangles small enough to be bent."""
    mesh = trimesh.creation.box((x, y, z))
    points, triangles = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, pitch, max_iter=12)
    merged = trimesh.Trimesh(points, triangles, process=False)
    merged.merge_vertices()
    return arrays(merged)


def turned(degrees: float = 30.0) -> np.ndarray:
    return trimesh.transformations.rotation_matrix(np.radians(degrees), [1.0, 2.0, 3.0])[:3, :3]


# --- organs ----------------------------------------------------------------------------------------------------------


@shape
def kidney() -> Surface:
    def bend(x):
        angle = x[:, 2] / 0.06
        return np.stack([(0.06 + x[:, 0]) * np.cos(angle) - 0.06, x[:, 1], (0.06 + x[:, 0]) * np.sin(angle)], 1)

    points, triangles = ball(1.0)
    return bent((points * [0.025, 0.02, 0.055], triangles), bend)


@shape
def gall_bladder() -> Surface:
    points, triangles = ball(1.0)
    t = points[:, 2:]
    return points * np.concatenate([0.012 + 0.010 * t, 0.012 + 0.010 * t, 0.045 + 0.0 * t], 1), triangles


@shape
def liver() -> Surface:
    points, triangles = ball(1.0)
    wedge = 0.3 + 0.7 * (0.5 + 0.5 * points[:, :1])
    return points * [0.12, 0.08, 0.07] * np.concatenate([np.ones_like(wedge), wedge, wedge**2], 1), triangles


@shape
def windpipe() -> Surface:
    return arrays(trimesh.creation.annulus(0.008, 0.010, 0.12, sections=64))


@shape
def gut() -> Surface:
    s = np.linspace(0.0, 1.0, 400)
    line = np.stack([0.08 * np.sin(9 * np.pi * s), 0.25 * s, 0.03 * np.cos(4 * np.pi * s)], 1)
    return together(tube(line, 0.011), inverted(tube(line[6:-6], 0.009)))


@shape
def vessels() -> Surface:
    """A tree of six generations, each branch a capsule that overlaps its parent's."""
    rng = np.random.default_rng(3)
    parts = []

    def grow(at, towards, length, radius, left):
        end = at + length * towards
        parts.append(capsule(radius, at, end))
        for sign in (-1.0, 1.0) if left else ():
            aside = np.cross(towards, rng.normal(size=3))
            grow(end, _unit(towards + 0.7 * sign * _unit(aside)), 0.78 * length, 0.74 * radius, left - 1)

    grow(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.06, 0.008, 5)
    return together(*parts)


@shape
def hand() -> Surface:
    fingers = [capsule(0.009, [0.02 * k - 0.03, 0, 0.04], [0.026 * k - 0.039, 0, 0.12]) for k in range(4)]
    return together(box(0.085, 0.028, 0.1), *fingers, capsule(0.011, [0.04, 0, 0], [0.075, 0.02, 0.05]))


@shape
def stomach_wall() -> Surface:
    """A bag, its wall 3 mm."""
    outer = ball(1.0, fineness=5)
    return together(
        bent(outer, lambda x: x * [0.10, 0.06, 0.07]), inverted(bent(outer, lambda x: x * [0.097, 0.057, 0.067]))
    )


# --- thin ------------------------------------------------------------------------------------------------------------


@shape
def sheet_2mm() -> Surface:
    return box(0.2, 0.2, 0.002)


@shape
def sheet_half_mm() -> Surface:
    return box(0.2, 0.2, 0.0005)


@shape
def sheet_askew() -> Surface:
    return moved(box(0.2, 0.2, 0.002), axes=turned())


@shape
def bowl() -> Surface:
    u = np.linspace(0.0, 0.5 * np.pi, 60)
    outline = [np.stack([r * np.sin(u), -r * np.cos(u)], 1) for r in (0.08, 0.077)]
    return arrays(trimesh.creation.revolve(np.concatenate([outline[0], outline[1][::-1]]), sections=96))


@shape
def ribbon() -> Surface:
    def twist(x):
        a = x[:, 0] * 2.0 * np.pi / 0.25
        return np.stack(
            [x[:, 0], x[:, 1] * np.cos(a) - x[:, 2] * np.sin(a), x[:, 1] * np.sin(a) + x[:, 2] * np.cos(a)], 1
        )

    return bent(fine_box(0.25, 0.03, 0.002, 0.004), twist)


@shape
def wire() -> Surface:
    return tube(np.linspace([0.0, 0, 0], [0.25, 0.02, 0.03], 60), 0.001)


@shape
def spring() -> Surface:
    t = np.linspace(0.0, 12.0 * np.pi, 700)
    return tube(np.stack([0.03 * np.cos(t), 0.03 * np.sin(t), 0.12 * t / t[-1]], 1), 0.002)


@shape
def ring() -> Surface:
    return arrays(trimesh.creation.torus(0.06, 0.0015, major_sections=256, minor_sections=24))


@shape
def thread_of_3_m() -> Surface:
    t = np.linspace(0.0, 40.0 * np.pi, 3000)
    return tube(
        np.stack([0.06 * np.cos(t), 0.06 * np.sin(t) * np.cos(0.1 * t), 0.06 * np.sin(0.1 * t)], 1), 0.0006, around=8
    )


@shape
def dumbbell() -> Surface:
    return together(ball(0.04, [-0.06, 0, 0]), ball(0.04, [0.06, 0, 0]), capsule(0.002, [-0.06, 0, 0], [0.06, 0, 0]))


@shape
def pliers() -> Surface:
    arms = []
    for side in (-1.0, 1.0):
        line = np.array([[0.0, 0, 0], [0.03 * side, 0, -0.04], [0.035 * side, 0, -0.14]])
        arms += [capsule(0.004, a, b) for a, b in pairwise(line)]
        arms.append(moved(box(0.006, 0.012, 0.05), [-0.004 * side, 0, 0.03]))
    return together(*arms, arrays(trimesh.creation.cylinder(0.009, 0.012)))


# --- knots and spikes ------------------------------------------------------------------------------------------------


@shape
def trefoil() -> Surface:
    t = 2.0 * np.pi * np.arange(300) / 300
    line = np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], 1)
    return tube(0.03 * line, 0.008, closed=True)


@shape
def thin_knot() -> Surface:
    t = 2.0 * np.pi * np.arange(900) / 900
    r = 2.0 + np.cos(7 * t)
    return tube(0.03 * np.stack([r * np.cos(3 * t), r * np.sin(3 * t), np.sin(7 * t)], 1), 0.003, closed=True)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.linalg.norm(a)


def _directions(count: int) -> np.ndarray:
    k = np.arange(count) + 0.5
    polar, round_ = np.arccos(1.0 - 2.0 * k / count), np.pi * (1.0 + 5.0**0.5) * k
    return np.stack([np.cos(round_) * np.sin(polar), np.sin(round_) * np.sin(polar), np.cos(polar)], 1)


def _spiked(count: int, inner: float, outer: float, width: float) -> Surface:
    cones = []
    for d in _directions(count):
        cone = arrays(trimesh.creation.cone(width, outer - 0.8 * inner, sections=16))
        cones.append(moved(cone, 0.8 * inner * d, trimesh.geometry.align_vectors([0, 0, 1.0], d)[:3, :3]))
    return together(ball(inner), *cones)


@shape
def spiky_ball() -> Surface:
    return _spiked(40, 0.04, 0.07, 0.012)


@shape
def urchin() -> Surface:
    return _spiked(120, 0.025, 0.09, 0.003)


@shape
def star() -> Surface:
    angle = 2.0 * np.pi * np.arange(24) / 24
    return prism(np.where(np.arange(24) % 2, 0.025, 0.09)[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), 0.02)


@shape
def gear() -> Surface:
    tooth = np.tile([1.0, 1.0, 0.82, 0.82], 20)
    angle = 2.0 * np.pi * (np.arange(80) + np.tile([0.0, 0.35, 0.0, 0.35], 20)) / 80
    return prism(0.08 * tooth[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1), 0.015)


@shape
def needle() -> Surface:
    return arrays(trimesh.creation.cone(0.006, 0.2, sections=48))


# --- edges -----------------------------------------------------------------------------------------------------------


@shape
def cube() -> Surface:
    return box(0.1, 0.1, 0.1)


@shape
def cube_askew() -> Surface:
    return moved(box(0.1, 0.1, 0.1), axes=turned())


@shape
def wedge() -> Surface:
    return prism(np.array([[-0.06, -0.01], [0.12, -0.01], [-0.06, 0.03]]), 0.08)


@shape
def hexagonal_bar() -> Surface:
    angle = np.pi / 3 * np.arange(6)
    return moved(prism(0.02 * np.stack([np.cos(angle), np.sin(angle)], 1), 0.2), axes=turned())


@shape
def stairs() -> Surface:
    return together(*(box(0.1, 0.021, 0.02 * k + 0.02, [0, 0.02 * k, 0.01 * k]) for k in range(6)))


@shape
def comb() -> Surface:
    return together(box(0.16, 0.01, 0.03), *(box(0.003, 0.008, 0.08, [0.01 * k - 0.075, 0, 0.05]) for k in range(16)))


# --- inside one another, slit, far, open, many -----------------------------------------------------------------------


@shape
def hollow_ball() -> Surface:
    return together(ball(0.06), inverted(ball(0.056)))


@shape
def nested_shells() -> Surface:
    return together(ball(0.06), inverted(ball(0.055)), ball(0.045), inverted(ball(0.04)), ball(0.02))


@shape
def slit_box() -> Surface:
    """Two halves 0.5 mm apart, joined at one end."""
    return together(
        box(0.12, 0.03, 0.06, [0, 0.01525, 0]),
        box(0.12, 0.03, 0.06, [0, -0.01525, 0]),
        box(0.02, 0.061, 0.06, [0.06, 0, 0]),
    )


@shape
def two_balls() -> Surface:
    return together(ball(0.04), ball(0.03, [0.02, 0.0, 0.12]))


@shape
def ball_and_crumb() -> Surface:
    return together(ball(0.06), ball(0.0012, [0.07, 0, 0], 2))


@shape
def crumbs() -> Surface:
    places = np.random.default_rng(1).uniform(-0.1, 0.1, (60, 3))
    return together(*(ball(0.008, place, 2) for place in places))


@shape
def overlapping() -> Surface:
    return together(ball(0.05), ball(0.05, [0.04, 0, 0]), box(0.2, 0.02, 0.02))


@shape
def open_bowl() -> Surface:
    """Half a ball, its round opening to be closed by a cap."""
    points, triangles = ball(0.07)
    return points, triangles[(points[triangles][:, :, 2] < 1e-9).all(axis=1)]


@shape
def ball_with_holes() -> Surface:
    points, triangles = ball(0.06, fineness=5)
    centres = points[triangles].mean(axis=1) / 0.06
    return points, triangles[(centres @ _directions(12).T).max(axis=1) < 0.995]


@shape
def inside_out() -> Surface:
    return inverted(ball(0.06))


@shape
def far_away() -> Surface:
    return moved(bent(ball(1.0), lambda x: x * [0.03, 0.04, 0.05]), [40.0, -25.0, 60.0])


@shape
def rough_ball_1_7_million() -> Surface:
    """1.7 M triangles with bumps of 1 mm."""
    rows, columns = 922, 924
    polar, around = np.pi * (np.arange(rows) + 0.5) / rows, 2.0 * np.pi * np.arange(columns) / columns
    p, a = np.meshgrid(polar, around, indexing="ij")
    r = 0.07 + 0.001 * np.sin(24 * p) * np.sin(24 * a) * np.sin(p)
    points = np.stack([r * np.sin(p) * np.cos(a), r * np.sin(p) * np.sin(a), r * np.cos(p)], -1).reshape(-1, 3)
    j = np.arange(columns)
    k = (j + 1) % columns
    north, south = len(points), len(points) + 1
    last = (rows - 1) * columns
    caps = [np.stack([np.full(columns, north), j, k], 1), np.stack([np.full(columns, south), last + k, last + j], 1)]
    poles = [[0, 0, r[0].mean()], [0, 0, -r[-1].mean()]]
    return np.concatenate([points, poles]), np.concatenate([grid(rows, columns, closed_columns=True), *caps])
