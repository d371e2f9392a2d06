"""Hands: the ways in which a person acts on a body, a small class each, listed in ``HANDS``.

A hand takes hold of a picked place, is moved, and reports the force that it exerts. The hands here are springs; a hand
that moves a rigid tool needs the same few members.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import numpy.typing as npt

from .shown import Pick, Shown
from .springs import MOST_POINTS, AllSprings, HeldPatch

Vector = npt.NDArray[np.float64]


class SpringHand:
    """A spring between the mouse and a patch around the picked place.

    Args:
        springs: The simulation's springs.
        shown: The surface with the place.
        pick: The place.
        radius: Radius of the patch at rest [m].
        strength: Stiffness over the largest stable one at the time step, 0 to 1.
    """

    rigid: ClassVar[bool] = False
    stays: ClassVar[bool] = False

    def __init__(self, springs: AllSprings, shown: Shown, pick: Pick, radius: float, strength: float = 1.0):
        self.pick = pick
        self._inward = -shown.normal(pick)
        self._spring = springs.hold(pick.body, patch_around(shown, pick, radius), rigid=self.rigid, strength=strength)
        self._before: Vector = np.zeros(3)

    def begin(self) -> None:
        """Take hold again: motion counts from here."""
        self._before = self._spring.motion

    def move(self, motion: Vector) -> None:
        self._spring.move(self._before + motion)

    def release(self) -> None:
        self._spring.release()

    @property
    def force(self) -> Vector:
        return self._spring.force

    @property
    def ends(self) -> tuple[Vector, Vector]:
        return self._spring.ends


class DragHand(SpringHand):
    """Pulls the tissue after the mouse; the patch may rotate and stretch."""


class PressHand(SpringHand):
    """Pushes the rigid patch into the body, as deep as the mouse moves, like a stamp of the patch's shape."""

    rigid = True

    def move(self, motion: Vector) -> None:
        self._spring.move(float(np.linalg.norm(motion)) * self._inward)


class GraspHand(SpringHand):
    """Holds the patch rigidly, and stays where the mouse leaves it, until it is released."""

    rigid = True
    stays = True


HANDS: dict[str, type[SpringHand]] = {"drag": DragHand, "press": PressHand, "grasp": GraspHand}


def patch_around(shown: Shown, pick: Pick, radius: float) -> HeldPatch:
    """The points of the shown surface that are at rest within a radius [m] of a place, and at least the corners of its
    triangle; the nearer a point, the larger its weight."""
    corners = shown.triangles[pick.triangle]
    distance = np.linalg.norm(shown.rest - shown.at(pick, shown.rest), axis=1)
    near = np.flatnonzero(distance < radius)
    near = near[np.argsort(distance[near], kind="stable")]
    # Evenly thinned: the nearest points would be a smaller patch.
    near = near[:: -(-len(near) // (MOST_POINTS - 3))] if len(near) > MOST_POINTS - 3 else near
    points, place = np.unique(np.concatenate([corners, near]), return_inverse=True)
    shares = np.concatenate([pick.place, (1.0 - (distance[near] / max(radius, 1e-300)) ** 2) ** 2])
    total = np.bincount(place, shares, len(points))
    there = np.zeros(len(shown.rest), bool)
    there[points] = there[distance < radius] = True
    a, b, c = np.moveaxis(shown.rest[shown.triangles], 1, 0)
    areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
    area = float(areas @ there[shown.triangles].mean(axis=1))
    return HeldPatch(points.astype(np.int32), total / total.sum(), area)
