"""Difficult bodies: shaped like organs, or thin and long."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import trimesh
from shape_tools import (
    Surface,
    arrays,
    ball,
    bent,
    box,
    capsule,
    fine_box,
    inverted,
    moved,
    shape,
    together,
    tube,
    turned,
    unit,
)

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
            grow(end, unit(towards + 0.7 * sign * unit(aside)), 0.78 * length, 0.74 * radius, left - 1)

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
