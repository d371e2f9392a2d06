"""What goes to and fro between a page and its session: controls one way, frames the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .cutting import Plane

Vector: TypeAlias = npt.NDArray[np.float64]


@dataclass
class Controls:
    """What the page's controls say.

    Attributes:
        running: Whether time goes on.
        speed: Simulated seconds that a second on the wall is to have.
        fps: Frames a second at most.
        hand: A name in ``HANDS``.
        radius: Of a hand's patch over the body's size.
        strength: Of a hand's spring, 0 to 1.
        colors: A name in ``Session.sources``; "" for none.
        surface: The name of the surface that is shown; bodies without it show their first.
        plane: Where bodies are cut, if they are.
    """

    running: bool = True
    speed: float = 1.0
    fps: float = 30.0
    hand: str = "drag"
    radius: float = 0.06
    strength: float = 1.0
    colors: str = "stress"
    surface: str = ""
    plane: Plane | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """What is seen at one time.

    Attributes:
        number: Of the surfaces' topology; other triangles have another number.
        positions: Of the shown points of each body [m], float32 [V, 3].
        triangles: int32 [F, 3] each.
        colors: uint8 [V, 3] each.
        highest: What the last colour stands for.
        poses: Of each obstacle, position [m] and quaternion (x, y, z, w), float64 [7].
        time: Simulated [s].
        ratio: Simulated time over time on the wall, lately.
        slow: Whether that is less than was asked for.
        forces: Of each hand that holds something, by its owner [N], float64 [3].
        ends: From where to where each of these pulls [m].
    """

    number: int
    positions: Sequence[npt.NDArray[np.float32]]
    triangles: Sequence[npt.NDArray[np.int32]]
    colors: Sequence[npt.NDArray[np.uint8]]
    highest: float
    poses: Sequence[Vector]
    time: float
    ratio: float
    slow: bool
    forces: dict[Any, Vector]
    ends: dict[Any, tuple[Vector, Vector]]
