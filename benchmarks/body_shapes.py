"""Difficult bodies: thin, long, sharp, branching, nested, slit, open, overlapping, with millions of triangles.

Each is a function without arguments that gives points [N, 3] [m] and triangles [F, 3]; ``SHAPES`` has them by name. All
are about the size of organs, 5 to 25 cm, unless size is the difficulty. Organ-like and thin shapes are in
``thin_shapes.py``.
"""

from __future__ import annotations

import numpy as np
import thin_shapes  # noqa: F401
import trimesh
from shape_tools import (
    SHAPES,
    Surface,
    arrays,
    ball,
    bent,
    box,
    grid,
    inverted,
    moved,
    prism,
    shape,
    together,
    tube,
    turned,
)

__all__ = ["SHAPES"]

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
    """Half a ball with a round opening that a cap must close."""
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
