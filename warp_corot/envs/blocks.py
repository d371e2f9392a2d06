"""Tasks with soft blocks and two fingers: lifting and stacking."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Box, Ground
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import episodes, tasks
from warp_corot.mesh.tetmesh import TetMesh

from .soft_env import SoftEnv
from .task import Actions, Scene, Task, box, nodes_at, symmetric

#: Edges of the block and of a finger [m]; the smallest and the largest distance between the fingers' centres [m].
BLOCK, FINGER, NARROW, WIDE = (0.03, 0.024, 0.024), (0.008, 0.02, 0.02), 0.024, 0.06
#: Edges of the block below, and its lowest corner [m].
BASE, PLACE = (0.036, 0.036, 0.02), (-0.003, 0.05, 0.0)
#: Numbers that are drawn for the fingers.
START = {"start_x": (0.005, 0.025), "start_y": (0.002, 0.022), "start_z": (0.04, 0.055), "apart": (0.05, 0.058)}


def corners(mesh: TetMesh, edges: tuple[float, float, float], low: tuple[float, float, float] = (0.0, 0.0, 0.0)):
    """The nodes at the corners of a box, [8]."""
    x, y, z = edges
    places = [(i * x, j * y, k * z) for i in (0, 1) for j in (0, 1) for k in (0, 1)]
    return nodes_at(mesh, np.add(places, low).tolist())


class Lift(SoftEnv):
    """Two fingers take a soft block from the ground by friction and lift it.

    Actions: velocity of the fingers' middle along x, y and z, and with which each moves away from it along x, over 0.1
    m/s. It succeeds when the middle of the block has been 30 mm higher than at rest for 10 steps. Observed points: the
    corners of the block.
    """

    task = Task(
        ranges={"young": (1e4, 3e4), **symmetric(shift_x=0.008, shift_y=0.008, turn=0.2), **START},
        begin=tasks.begin_lift,
        begun=(),
        judge=tasks.judge_lift,
        judged=(8, 0.5 * BLOCK[2], 0.5 * BLOCK[2] + 0.03, 10, 10.0),
        actions=4,
        speed=0.1,
        workspace=((-0.02, -0.02, 0.012), (0.05, 0.044, 0.09)),
        notes={"height": 1},
        window=((-0.02, -0.01, 0.0), (0.05, 0.035, 0.075)),
        view=(25.0, 15.0),
    )

    def make_scene(self) -> Scene:
        mesh = box((4, 3, 3), BLOCK, self.cells)
        return Scene(mesh, None, self.make_fingers(), [Ground()], corners(mesh, BLOCK), (0.015, 0.012, 0.0))

    def make_fingers(self) -> list[Tool]:
        """Two fingers beside the block."""
        shapes = [Box(FINGER, position=(side, 0.012, 0.05), friction=0.9) for side in (-0.01, BLOCK[0] + 0.01)]
        # Along all axes at once, and together along x.
        return [Tool(shape, speed=2.5 * self.task.speed) for shape in shapes]

    def launch_actions(self) -> None:
        self._launch(episodes.steer_fingers, self.num_envs, [*self._steering, NARROW, WIDE, self.worlds])

    def scripted_actions(self, observations: Actions) -> Actions:
        block = self.middles(observations)[0]
        return self.picking(observations, block, np.tile([0.0, 0.0, 0.5], (len(block), 1)))

    def middles(self, observations: Actions) -> Actions:
        """Middles of the blocks [m], [blocks, n, 3]."""
        (points,) = self.seen(observations, "points")
        return points.reshape(len(points), -1, 8, 3).mean(axis=2).swapaxes(0, 1)

    def picking(
        self, observations: Actions, block: npt.NDArray[np.floating], carries: npt.NDArray[np.floating]
    ) -> Actions:
        """Actions that take a block and then carry it: over the block with open fingers, down, together, and away.

        Args:
            block: The middle of the block [m], [n, 3].
            carries: Velocities of the fingers' middle while they hold the block, [n, 3].
        """
        left, right, push, pull = self.seen(
            observations, "tool0.position", "tool1.position", "tool0.force", "tool1.force"
        )
        middle, apart = 0.5 * (left + right), (right - left)[:, 0]
        off, low = np.abs((middle - block)[:, :2]).max(axis=1), np.abs(middle - block)[:, 2] < 0.004
        holds = np.minimum(-push[:, 0], pull[:, 0]) > 0.5
        grips = low | holds | (apart < 0.042)
        aim = np.where((off < 0.002)[:, None], block, block * [1, 1, 0] + [0, 0, 0.04])
        way = np.where(grips[:, None], np.where(holds[:, None], carries, 0.0), self.toward(aim - middle, 0.5))
        opening = np.where(grips, np.where(holds, 0.0, -0.3), np.where(apart < 0.05, 1.0, 0.0))
        return np.column_stack([way, opening]).astype(np.float32)


class Stack(Lift):
    """Two fingers put a soft block on another one and let go.

    Actions as for ``Lift``. It succeeds when the middle of the upper block has been within 6 mm of the place above the
    lower one for 10 steps, while no finger touches it. Observed points: the corners of the upper and of the lower
    block.
    """

    task = Task(
        ranges={
            "young": (1e4, 3e4),
            **symmetric(shift_x=0.005, shift_y=0.005, turn=0.2),
            **START,
            **symmetric(base_x=0.006, base_y=0.006, base_turn=0.3),
        },
        begin=tasks.begin_stacking,
        begun=(wp.vec3(0.015, 0.068, 0.0),),
        judge=tasks.judge_stacking,
        judged=(8, 0.5 * (BASE[2] + BLOCK[2]), 0.006, 10, 10.0),
        actions=4,
        speed=0.1,
        workspace=((-0.02, -0.02, 0.012), (0.05, 0.085, 0.09)),
        notes={"goal": 3},
        steps=300,
        window=((-0.02, -0.01, 0.0), (0.05, 0.09, 0.075)),
        view=(60.0, 15.0),
    )

    def make_scene(self) -> Scene:
        upper, lower = box((4, 3, 3), BLOCK, self.cells), box((3, 3, 2), BASE, self.cells)
        count = len(upper.points)
        points = np.concatenate([upper.points, lower.points + PLACE])
        mesh = TetMesh(points, np.concatenate([upper.tets, np.asarray(lower.tets) + count]), up_axis="Z")
        parts = (np.arange(len(points)) >= count).astype(np.int32)
        seen = np.concatenate([corners(mesh, BLOCK), corners(mesh, BASE, PLACE)])
        return Scene(mesh, None, self.make_fingers(), [Ground()], seen, (0.015, 0.012, 0.0), parts)

    def scripted_actions(self, observations: Actions) -> Actions:
        block = self.middles(observations)[0]
        (goal,) = self.seen(observations, "goal")
        off = np.abs((goal - block)[:, :2]).max(axis=1)
        # Up, over the other block, and slowly down.
        carries = self.toward(goal - block, 0.3)
        carries[:, 2] = np.where(off < 0.002, -0.3, np.where(block[:, 2] < goal[:, 2] + 0.012, 0.5, 0.0))
        carries[:, :2] *= ((off < 0.004) | (block[:, 2] > goal[:, 2] + 0.009))[:, None]
        actions = self.picking(observations, block, carries)
        # Apart where it lies, and away.
        left, right = self.seen(observations, "tool0.position", "tool1.position")
        lies = (off < 0.005) & (block[:, 2] < goal[:, 2] + 0.001)
        leaves = lies & ((right - left)[:, 0] > 0.05)
        actions[lies] = [0.0, 0.0, 0.0, 1.0]
        actions[leaves, 2] = 0.5
        return actions
