"""Lifting a soft block."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from warp_corot.contact.shapes import Box, Ground
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import episodes, tasks

from .soft_env import RATE, SoftEnv
from .task import Scene, Task, box, nodes_at

#: Edges of the block and of a finger [m], and the speed of the fingers along each axis [m/s].
BLOCK, FINGER, SPEED = (0.03, 0.024, 0.024), (0.008, 0.02, 0.02), 0.1
#: Smallest and largest distance between the fingers' centres [m].
NARROW, WIDE = 0.024, 0.06


class Lift(SoftEnv):
    """Two fingers take a soft block from the ground by friction and lift it.

    Actions: velocity of the fingers' middle along x, y and z, and with which each moves away from it along x, over 0.1
    m/s. It succeeds when the middle of the block has been 30 mm higher than at rest for 10 steps. Observed points: the
    corners of the block.
    """

    task = Task(
        ranges={
            "young": (1e4, 3e4),
            **{"shift_x": (-0.008, 0.008), "shift_y": (-0.008, 0.008), "turn": (-0.2, 0.2)},
            **{"start_x": (0.005, 0.025), "start_y": (0.002, 0.022), "start_z": (0.04, 0.055), "apart": (0.05, 0.058)},
        },
        begin=tasks.begin_lift,
        begun=(),
        judge=tasks.judge_lift,
        judged=(8, 0.5 * BLOCK[2], 0.5 * BLOCK[2] + 0.03, 10, 10.0),
        actions=4,
        speed=SPEED,
        workspace=((-0.02, -0.02, 0.012), (0.05, 0.044, 0.09)),
        notes={"height": 1},
        steps=200,
        window=((-0.02, -0.01, 0.0), (0.05, 0.035, 0.075)),
        view=(25.0, 15.0),
    )

    def make_scene(self) -> Scene:
        mesh = box((4, 3, 3), BLOCK, self.cells)
        x, y, z = BLOCK
        points = nodes_at(mesh, [(i * x, j * y, k * z) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        shapes = [Box(FINGER, position=(side, 0.5 * y, 0.05), friction=0.9) for side in (-0.01, x + 0.01)]
        # Along all axes at once, and together along x.
        fingers = [Tool(shape, speed=2.5 * SPEED) for shape in shapes]
        return Scene(mesh, None, fingers, [Ground()], points, (0.5 * x, 0.5 * y, 0.0))

    def launch_actions(self) -> None:
        self._launch(episodes.steer_fingers, self.num_envs, [*self._steering, NARROW, WIDE, self.worlds])

    def scripted_actions(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        fingers = [observations[:, self.columns[f"tool{k}.position"]] for k in (0, 1)]
        forces = [observations[:, self.columns[f"tool{k}.force"]] for k in (0, 1)]
        block = observations[:, self.columns["points"]].reshape(-1, 8, 3).mean(axis=1)
        middle, apart = 0.5 * (fingers[0] + fingers[1]), (fingers[1] - fingers[0])[:, 0]
        off = np.abs((middle - block)[:, :2]).max(axis=1)
        low = np.abs(middle - block)[:, 2] < 0.004
        holds = np.minimum(-forces[0][:, 0], forces[1][:, 0]) > 0.5
        # Over the block with open fingers, down, together, and up.
        aim = np.where((off < 0.002)[:, None], block, block * [1, 1, 0] + [0, 0, 0.04])
        way = np.clip((aim - middle) * (0.5 * RATE / SPEED), -1.0, 1.0)
        grips = low | holds | (apart < 0.042)
        way[grips] = 0.0
        way[:, 2] = np.where(grips & holds, 0.5, way[:, 2])
        opening = np.where(grips, np.where(holds, 0.0, -0.3), np.where(apart < 0.05, 1.0, 0.0))
        return np.column_stack([way, opening]).astype(np.float32)
