"""The data between a page and its session: controls in one direction, frames in the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from .cutting import Plane

Vector: TypeAlias = npt.NDArray[np.float64]


@dataclass
class PageControls:
    """The values of the page's controls.

    Attributes:
        running: Whether the simulation runs.
        speed: Wanted simulated seconds for each second of wall time.
        fps: The most frames per second.
        hand: A name in ``HANDS``.
        radius: Radius of a hand's patch over the body's size.
        strength: Strength of a hand's spring, 0 to 1.
        colors: A name in ``Session.sources``; "" for none.
        surface: The name of the surface that is shown; bodies without it show their first.
        plane: Where bodies are cut, if they are.
        world: The number of the world that is shown.
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
    world: int = 0


@dataclass(frozen=True, eq=False)
class PageFrame:
    """The picture at one time.

    Attributes:
        number: The version of the surfaces' topology, which changes with the triangles.
        positions: The shown points of each body [m], float32 [V, 3].
        triangles: int32 [F, 3] for each body.
        shades: The number of each point's colour in a table of 256, uint8 [V] for each body; None: without colours.
        highest: The value of the last colour.
        poses: Position [m] and quaternion (x, y, z, w) of each obstacle, float64 [7].
        time: Simulated time [s].
        ratio: Simulated over wall time, lately.
        slow: Whether that is less than was requested.
        forces: The force of each hand that holds something, by its owner [N], float64 [3].
        ends: The two ends of each of these hands' springs [m].
    """

    number: int
    positions: Sequence[npt.NDArray[np.float32]]
    triangles: Sequence[npt.NDArray[np.int32]]
    shades: Sequence[npt.NDArray[np.uint8] | None]
    highest: float
    poses: Sequence[Vector]
    time: float
    ratio: float
    slow: bool
    forces: dict[Any, Vector]
    ends: dict[Any, tuple[Vector, Vector]]
