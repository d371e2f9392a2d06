"""Tissue retraction."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Ground, Sphere
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import tasks

from .soft_env import SoftEnv
from .task import Scene, Task, box, nodes_at

#: Edges of the flap [m], the radius of the gripper, and the speed of a tool along each axis [m/s].
FLAP, RADIUS, SPEED = (0.072, 0.048, 0.008), 0.004, 0.1


class Retract(SoftEnv):
    """A gripper takes a flap of tissue by its rim and lifts it to a goal, as a surgeon retracts tissue.

    The flap lies on a ground and is held along one side. Actions: velocity of the gripper along x, y and z, over 0.1
    m/s, and whether it is closed. It succeeds when the middle of the rim has been within 5 mm of the goal for 10 steps.
    Observed points: the middle and the two corners of the rim.
    """

    task = Task(
        ranges={
            "young": (5e3, 2e4),
            **{"shift_x": (-0.005, 0.005), "shift_y": (-0.005, 0.005), "turn": (-0.15, 0.15)},
            **{"start_x": (-0.015, 0.015), "start_y": (-0.015, 0.015), "start_z": (0.015, 0.03)},
            **{"goal_x": (-0.025, -0.01), "goal_y": (-0.008, 0.008), "goal_z": (0.02, 0.035)},
        },
        begin=tasks.begin_retraction,
        begun=(wp.vec3(FLAP[0], 0.5 * FLAP[1], FLAP[2]),),
        judge=tasks.judge_retraction,
        judged=(0.005, 10, 10.0),
        actions=4,
        speed=SPEED,
        workspace=((-0.02, -0.03, 0.002), (0.11, 0.08, 0.09)),
        notes={"goal": 3, "closed": 1},
        steps=200,
        window=((0.0, -0.01, 0.0), (0.09, 0.06, 0.06)),
        view=(-35.0, 20.0),
    )

    def make_scene(self) -> Scene:
        mesh = box((9, 6, 1), FLAP, self.cells)
        x, y, z = FLAP
        points = nodes_at(mesh, [(x, 0.5 * y, z), (x, 0.0, z), (x, y, z)])
        gripper = Tool(Sphere(RADIUS, position=(x, 0.5 * y, 0.03)), speed=2.0 * SPEED)
        rim = mesh.points[:, 0] > x - 1e-6
        return Scene(mesh, "x == xmin", [gripper], [Ground()], points, (0.0, 0.5 * y, 0.0), gripped=rim, reach=0.009)

    def scripted_actions(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        gripper, goal = observations[:, self.columns["tool0.position"]], observations[:, self.columns["goal"]]
        site = observations[:, self.columns["points"]][:, :3]
        closed = observations[:, self.columns["closed"]][:, 0] > 0.0
        above = site + np.array([0.0, 0.0, 0.0045])
        near = np.linalg.norm(gripper - above, axis=1) < 0.002
        beside = np.linalg.norm((gripper - above)[:, :2], axis=1) > 0.003
        aim = np.where(beside[:, None], above + np.array([0.0, 0.0, 0.008]), above)
        way = np.where(closed[:, None], goal - site, aim - gripper)
        speed = np.where(closed[:, None], 0.6, 1.0) * np.minimum(1.0, 30.0 * np.abs(way) / SPEED)
        closing = np.where(closed | near, 1.0, -1.0)
        return np.column_stack([np.sign(way) * speed, closing]).astype(np.float32)
