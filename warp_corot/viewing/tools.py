"""The hand that moves a rigid tool of the simulation, and may grasp tissue with it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from warp_corot.body.soft_body import SoftBody
from warp_corot.contact.grasp import Grasp
from warp_corot.contact.tool import Tool
from warp_corot.errors import InputError

Vector = npt.NDArray[np.float64]


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
        obstacles, number = self.tool.place_among_obstacles()
        for body in bodies:
            nodes = np.unique(body.surface_triangles)
            places = body.world(self.world).positions.numpy()[nodes].astype(np.float64)
            near = nodes[obstacles.gaps(places, reach, self.world)[number] < reach]
            if len(near):
                self.grasps.append(Grasp(body, near, tool=self.tool))
        if not self.grasps:
            raise InputError(f"no tissue is within {1e3 * reach:.3g} mm of the tool, which grasps nothing")

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
