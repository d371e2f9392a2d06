"""Threading a tube over a peg."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Box, Capsule, Ground
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import tasks

from .soft_env import RATE, SoftEnv
from .task import Scene, Task, box, nodes_at

#: Edges of the tube and the width of its wall, the gripper's height above the lower end [m], and its speed [m/s].
TUBE, WALL, ABOVE, SPEED = (0.024, 0.024, 0.032), 0.008, 0.0345, 0.1
#: About which the tube is turned [m].
CENTRE = wp.vec3(0.5 * TUBE[0], 0.5 * TUBE[1], 0.0)
#: Radius of the peg, half the length between the centres of its ends, and the height of its middle [m].
PEG, HALF, MIDDLE = 0.0035, 0.012, 0.012


class Thread(SoftEnv):
    """A gripper that holds a soft tube by its upper end threads it over a peg.

    Actions: velocity of the gripper along x, y and z, over 0.1 m/s. It succeeds when the lower rim has been around the
    peg and less than 6 mm above the ground for 5 steps. Observed points: the four corners of the lower end's hole. The
    peg is observed as the second tool.
    """

    task = Task(
        ranges={
            "young": (1e4, 3e4),
            **{"shift_x": (-0.012, 0.012), "shift_y": (-0.012, 0.012), "turn": (-0.4, 0.4), "height": (0.032, 0.04)},
            **{"peg_x": (0.004, 0.02), "peg_y": (0.004, 0.02)},
        },
        begin=tasks.begin_threading,
        begun=(CENTRE, ABOVE),
        judge=tasks.judge_threading,
        judged=(4, 0.003, 0.006, MIDDLE + HALF + PEG, 5, 10.0),
        actions=3,
        speed=SPEED,
        workspace=((-0.03, -0.03, 0.03), (0.054, 0.054, 0.1)),
        notes={},
        steps=200,
        window=((-0.015, -0.015, 0.0), (0.04, 0.04, 0.09)),
        view=(30.0, 15.0),
    )

    def make_scene(self) -> Scene:
        x, y, _ = TUBE
        mesh = box((3, 3, 4), TUBE, self.cells, lambda p: np.abs(p[:, :2] - 0.5 * x).max(axis=1) < 0.5 * x - WALL)
        points = nodes_at(mesh, [(i, j, 0.0) for i in (WALL, x - WALL) for j in (WALL, y - WALL)])
        gripper = Tool(Box((0.024, 0.024, 0.004), position=(0.5 * x, 0.5 * y, 0.09)), speed=2.0 * SPEED)
        peg = Tool(Capsule(PEG, 2.0 * HALF, position=(0.5 * x, 0.5 * y, MIDDLE)))
        top = mesh.points[:, 2] > TUBE[2] - 1e-6
        return Scene(mesh, None, [gripper, peg], [Ground()], points, CENTRE, gripped=top, reach=0.1, friction=0.1)

    def scripted_actions(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        gripper, peg = (observations[:, self.columns[f"tool{k}.position"]] for k in (0, 1))
        rim = observations[:, self.columns["points"]].reshape(-1, 4, 3).mean(axis=1)
        away = np.linalg.norm((peg - rim)[:, :2], axis=1)
        # Over the peg, and down once the tube hardly swings.
        sinks = (away < 0.0015) | (rim[:, 2] < MIDDLE + HALF + PEG)
        way = np.clip((peg - gripper) * (0.5 * RATE / SPEED), -0.5, 0.5)
        way[:, 2] = np.where(sinks, -0.4, 0.0)
        return way.astype(np.float32)
