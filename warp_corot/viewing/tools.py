"""The hand that moves a rigid tool of the simulation, and may grasp tissue with it; the tools that the page offers."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.obstacles import LARGEST_SHARE
from warp_corot.contact.shapes import Capsule, Shape, Sphere, turn_from_z
from warp_corot.contact.tool import Tool
from warp_corot.cutting.blade import Blade, Edge
from warp_corot.errors import InputError
from warp_corot.inputs.checks import checked_choice, checked_vector

Vector = npt.NDArray[np.float64]

#: The shapes of the tools that a visitor may put into the scene, for a size of the bodies [m].
SHAPES: dict[str, Callable[..., Shape]] = {
    "ball": lambda size, **pose: Sphere(radius=0.1 * size, **pose),
    "rod": lambda size, **pose: Capsule(radius=0.04 * size, length=0.5 * size, **pose),
    "knife": lambda size, **pose: Edge(np.array([[0.0, 0.0, -0.4], [0.0, 0.0, 0.4]]) * size, **pose),
}
#: The highest speed of these tools over the size of the bodies [1/s].
BRISK = 5.0


def new_tool(
    name: str,
    size: float,
    up: Vector,
    place: npt.ArrayLike,
    bodies: npt.NDArray[np.floating],
    dt: float | None,
    fastest_cut: float,
) -> Tool:
    """A tool that the page offers.

    Args:
        name: A name in ``SHAPES``.
        size: The size of the bodies [m].
        up: The direction in which a rod or an edge points, [3].
        place: Its first place [m], [3]; it is moved away until it is clear of the box around the bodies.
        bodies: Points of the bodies [m], [V, 3].
        dt: The length of steps if it is given [s]; the tool is slow enough for it.
        fastest_cut: The highest speed of a knife [m/s].

    Raises:
        InputError: There is no such tool, or the place is not three finite numbers.
    """
    checked_choice(name, "name", SHAPES)
    there = checked_vector(place, "place")
    away = there - bodies.mean(axis=0) + 1e-3 * size
    reach = 1.1 * SHAPES[name](size).reach
    low, high = bodies.min(axis=0) - reach, bodies.max(axis=0) + reach
    while (low < there).all() and (there < high).all():
        there = there + 0.1 * size * away / np.linalg.norm(away)
    shape = SHAPES[name](size, position=there, quaternion=turn_from_z(up))
    speed = BRISK * size
    if isinstance(shape, Edge):
        speed = min(speed, fastest_cut)
        return Blade(shape.points, speed=speed, position=shape.position, quaternion=shape.quaternion)
    return Tool(shape, speed=speed if dt is None else min(speed, 0.99 * LARGEST_SHARE * shape.thickness / dt))


class ToolHand:
    """Moves a tool with the mouse, no faster than its speed. The tool stays where it is left.

    Args:
        tool: A tool that nothing else moves.
        world: The world in which it is seen; it moves in all of them.

    Raises:
        InputError: The tool follows keyframes or an array.
    """

    stays: ClassVar[bool] = True

    def __init__(self, tool: Tool, world: int = 0):
        if tool.keys is not None or tool.poses is not None:
            raise InputError("this tool follows keyframes or an array; the mouse moves tools that nothing else moves")
        self.tool, self.world = tool, world
        self.grasps: list[Grasp] = []
        self.begin()

    def begin(self) -> None:
        """Take hold again: motion counts from here."""
        self._before = self._target = self._place

    def grasp(self, bodies: Sequence[SoftBody], reach: float) -> None:
        """Hold the surface nodes of bodies that are nearer to the tool than ``reach`` [m], until ``release``.

        Raises:
            InputError: There are none.
        """
        if self.grasps:
            return
        if isinstance(self.tool, Blade):
            raise InputError("a knife holds no tissue; choose another hand")
        obstacles, number = self.tool.place_among_obstacles()
        for body in bodies:
            nodes = np.unique(body.surface_triangles)
            places = body.world(self.world).positions.numpy()[nodes].astype(np.float64)
            near = nodes[obstacles.gaps(places, reach, self.world)[number] < reach]
            if len(near):
                self.grasps.append(Grasp(body, near, tool=self.tool))
        if not self.grasps:
            raise InputError(
                f"no tissue is within {1e3 * reach:.3g} mm of the tool: bring it there, then press on it again"
            )

    def move(self, motion: Vector) -> None:
        """Move to the mouse's present distance from where it was pressed [m], [3]."""
        self._target = self._before + motion
        self.tool.move(self._target)

    def release(self) -> None:
        """Let the tissue go; the tool stays."""
        for grasp in self.grasps:
            grasp.release()
        self.grasps = []

    @property
    def force(self) -> Vector:
        """The force of the tool on the tissue in the last step [N], float64 [3]."""
        felt = [self.tool.wrench, *(grasp.wrench for grasp in self.grasps)]
        return -np.array([wrench.numpy()[self.world][:3] for wrench in felt], np.float64).sum(axis=0)

    @property
    def ends(self) -> tuple[Vector, Vector]:
        """Where the tool is and where it is to go [m], float64 [3] each."""
        return self._place, self._target

    @property
    def _place(self) -> Vector:
        return self.tool.present_pose[self.world][:3].copy()
