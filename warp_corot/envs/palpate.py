"""Palpation."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import warp as wp

from warp_corot.contact.shapes import Sphere
from warp_corot.contact.tool import Tool
from warp_corot.kernels.envs import tasks

from .soft_env import RATE, SoftEnv
from .task import Scene, Task, box, nodes_at

#: Edges of the tissue [m], the radius of the probe, and its speed along each axis [m/s].
TISSUE, RADIUS, SPEED = (0.06, 0.06, 0.02), 0.008, 0.06
#: Height of the probe while the scripted policy searches, and the rows of its search [m].
DEPTH, ROWS = 0.0245, (0.016, 0.03, 0.044)


class Palpate(SoftEnv):
    """A round probe finds a stiff lump inside tissue by the force that it feels.

    Actions: velocity of the probe along x, y and z, over 0.06 m/s. It succeeds when the probe has pressed within 8 mm
    of the lump, seen from above, with 0.1 N or more for 25 steps. The lump itself is not observed, but the largest
    force of the episode is, and where it was. Observed points: the corners of the upper side.
    """

    task = Task(
        ranges={
            "young": (4e3, 8e3),
            **{"shift_x": (-0.003, 0.003), "shift_y": (-0.003, 0.003), "turn": (-0.1, 0.1)},
            **{"lump_x": (0.016, 0.044), "lump_y": (0.016, 0.044), "lump_z": (0.011, 0.013)},
            **{"radius": (0.009, 0.011), "ratio": (7.0, 9.0)},
        },
        begin=tasks.begin_palpation,
        begun=(wp.vec3(0.5 * TISSUE[0], 0.5 * TISSUE[1], 0.035),),
        judge=tasks.judge_palpation,
        judged=(0.008, 0.1, 25, 10.0),
        actions=3,
        speed=SPEED,
        workspace=((0.0, 0.0, 0.022), (0.06, 0.06, 0.04)),
        notes={"largest_force": 1, "largest_at": 2},
        steps=300,
        window=((-0.005, -0.005, 0.0), (0.065, 0.065, 0.04)),
        view=(30.0, 25.0),
    )

    def make_scene(self) -> Scene:
        mesh = box((6, 6, 2), TISSUE, self.cells)
        x, y, z = TISSUE
        points = nodes_at(mesh, [(0.0, 0.0, z), (x, 0.0, z), (0.0, y, z), (x, y, z)])
        probe = Tool(Sphere(RADIUS, position=(0.5 * x, 0.5 * y, 0.035)), speed=2.0 * SPEED)
        return Scene(mesh, "z == zmin", [probe], [], points, (0.5 * x, 0.5 * y, 0.0), friction=0.05)

    def scripted_actions(self, observations: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        probe = observations[:, self.columns["tool0.position"]]
        step = np.rint(observations[:, self.columns["time"]][:, 0] * self.max_episode_steps)
        route = [
            (row, side) for k, row in enumerate(ROWS) for side in ((0.012, 0.048) if k % 2 == 0 else (0.048, 0.012))
        ]
        corners = np.array([(x, y, DEPTH) for y, x in route])
        # When the probe arrives at each corner, with a little time to spare.
        ways = np.abs(np.diff(np.vstack([[0.03, 0.03, 0.035], corners]), axis=0)).max(axis=1)
        arrivals = np.cumsum(np.ceil(ways / SPEED * RATE) + 2)
        at = np.searchsorted(arrivals, step, side="right")
        aim = corners[np.minimum(at, len(corners) - 1)]
        found = np.column_stack([observations[:, self.columns["largest_at"]], np.full(len(probe), DEPTH)])
        aim = np.where((at >= len(corners))[:, None], found, aim)
        return np.clip((aim - probe) * (RATE / SPEED), -1.0, 1.0).astype(np.float32)
