"""Reaching without bruising."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Capsule
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import tasks

from .soft_env import RATE, SoftEnv
from .task import Scene, Task, box, nodes_at

#: Edges of the tissue, the width of its channel, the tool's radius and half its length [m], and its speed [m/s].
TISSUE, CHANNEL, RADIUS, HALF, SPEED = (0.04, 0.024, 0.024), 0.008, 0.005, 0.02, 0.06
#: About which the tissue is turned [m].
CENTRE = wp.vec3(0.5 * TISSUE[0], 0.5 * TISSUE[1], 0.0)
#: The stress that bruises [Pa].
BRUISE = 6e3


class Reach(SoftEnv):
    """A thin tool goes down into a channel of tissue, narrower than itself, and must not bruise it.

    Actions: velocity of the tool along x, y and z, over 0.06 m/s. It succeeds when its tip has been within 2 mm of the
    goal for 5 steps; a von Mises stress of more than 6 kPa in any element ends the episode as a bruise. The largest
    stress over that bound is observed. Observed points: the four upper ends of the channel's edges.
    """

    task = Task(
        ranges={
            "young": (5e3, 1.5e4),
            **{"shift_x": (-0.005, 0.005), "shift_y": (-0.003, 0.003), "turn": (-0.25, 0.25)},
            **{"start_x": (-0.01, 0.01), "start_y": (-0.005, 0.005), "start_z": (0.0, 0.006)},
            **{"goal_y": (-0.005, 0.005), "goal_z": (0.011, 0.014)},
        },
        begin=tasks.begin_reach,
        begun=(CENTRE, CENTRE + wp.vec3(0.0, 0.0, 0.032 + HALF), HALF),
        judge=tasks.judge_reach,
        judged=(0.002, BRUISE, 5, 10.0),
        actions=3,
        speed=SPEED,
        workspace=((-0.01, -0.01, 0.03), (0.05, 0.034, 0.07)),
        notes={"goal": 3, "stress": 1},
        steps=200,
        feels_stress=True,
        window=((-0.005, -0.005, 0.0), (0.045, 0.03, 0.07)),
        view=(25.0, 20.0),
    )

    def make_scene(self) -> Scene:
        x, y, z = TISSUE
        left, right = 0.5 * (x - CHANNEL), 0.5 * (x + CHANNEL)
        mesh = box((5, 3, 3), TISSUE, self.cells, lambda p: (left < p[:, 0]) & (p[:, 0] < right) & (p[:, 2] > 0.008))
        points = nodes_at(mesh, [(left, 0.0, z), (right, 0.0, z), (left, y, z), (right, y, z)])
        tool = Tool(Capsule(RADIUS, 2.0 * HALF, position=(0.5 * x, 0.5 * y, 0.055)), speed=2.0 * SPEED)
        return Scene(mesh, "z == zmin", [tool], [], points, CENTRE, friction=0.1)

    def scripted_actions(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        tool, goal = observations[:, self.columns["tool0.position"]], observations[:, self.columns["goal"]]
        off = np.abs(tool - goal)[:, :2].max(axis=1)
        clear = TISSUE[2] + RADIUS + HALF + 0.002
        # Over the channel first, and then slowly down.
        aim = np.where((off > 0.0005)[:, None] & (tool[:, 2:] > clear - 0.001), goal * [1, 1, 0] + [0, 0, clear], goal)
        way = (aim - tool) * (RATE / SPEED)
        return np.clip(way, [-1.0, -1.0, -0.4], 1.0).astype(np.float32)
